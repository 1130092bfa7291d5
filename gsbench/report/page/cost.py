"""Write what accuracy costs: which model to use for a budget, and the frontier of every model."""

import math
from dataclasses import dataclass

from gsbench.measure.record import Record
from gsbench.report import frontier as f
from gsbench.report import paper
from gsbench.report.arms import Arm, Group, without
from gsbench.report.frontier import Point
from gsbench.report.page import charts, words
from gsbench.report.page.content import Canvas, Column, Drawing, Runs, Section, Tab, Table, Value
from gsbench.report.page.palette import Style

BUDGETS = (10.0, 60.0, 600.0)  # seconds of training
FRAMES = 60.0  # a second
AXES = (("seconds", "training seconds"), ("ms", "ms a frame"), ("mb", "MB of the model"))
MOST_RUNS = 300  # that are drawn singly in a panel


@dataclass(frozen=True)
class Answer:
    """Which model to use for a budget."""

    budget: str
    model: str  # empty: none fits
    value: str
    interval: str
    detail: str


def basis(group: Group) -> list[str]:
    """Return the scenes that the answers are means of: those all models finished, or the one with most arms."""
    if group.covered or not group.arms:
        return group.covered
    return [max(group.scenes, key=lambda s: sum(s in arm.runs for arm in group.arms))]


def answers(group: Group) -> list[Answer]:
    """Answer which model to use for each budget of training, and for 60 frames a second."""
    points = f.points(group, basis(group))
    asked = [("seconds", b, f"{words.budget(b)} of training") for b in BUDGETS]
    return [_answer(group, points, *one) for one in [*asked, ("ms", 1000 / FRAMES, f"{FRAMES:g} frames a second")]]


def basis_words(group: Group) -> str:
    """Say what the answers are from."""
    scenes = basis(group)
    if not scenes:
        return "Nothing has finished yet."
    where = scenes[0] if len(scenes) == 1 else f"the mean of {len(scenes)} scenes"
    text = f"Highest PSNR on {where} among the finished runs that fit, with the 95 % interval of seeds. "
    alone = group.variant if len({arm.variant for arm in group.arms}) == 1 else ""
    text += f"Every run with {alone}. " if alone else ""
    return text + _lengths(f.points(group, scenes))


def _answer(group: Group, points: list[Point], cost: str, budget: float, title: str) -> Answer:
    known = [p.cost[cost] for p in points if not math.isnan(p.cost[cost])]
    if not known:
        return Answer(title, "", "not measured", "", "No finished run tells.")
    write = words.duration if cost == "seconds" else lambda ms: f"{words.plain(ms)} ms a frame"
    choice = f.choose(group, points, cost, budget)
    if choice is None:
        return Answer(title, "", "none fits", "", f"The quickest took {write(min(known))}.")
    point = choice.point
    detail = f"{_told(point.arm)}{write(point.cost[cost])}. "
    others = {p.series for p in points if p.cost[cost] <= budget} - {point.series}
    if choice.level:
        detail += f"Not told apart from {words.listing([p.series for p in choice.level])}."
    elif choice.unknown:
        detail += "One seed: whether it is ahead is not known."
    elif others:
        detail += "Ahead of every other model that fits." if len(others) > 1 else f"Ahead of {others.pop()}."
    else:
        detail += "No other model fits."
    if cost == "seconds" and budget > 2 * max(known):
        detail += f" Nothing here trained longer than {write(max(known))}."
    value = f"{words.plain(point.psnr.mean)} dB"
    return Answer(title, point.series, value, words.interval(point.psnr), detail)


def _told(arm: Arm) -> str:
    """Say what sets an arm apart from the others of its series: its length, and the rest of its variant."""
    length = f"{arm.iterations:,} iterations, " if arm.iterations else ""
    told = [name for name, known in (("iterations", length), ("gate", arm.series != arm.model)) if known]
    rest = without(arm.variant, *told) if arm.name != arm.model else ""
    return length + (f"{rest.replace(',', ', ')}, " if rest else "")


def frontier_section(group: Group, canvas: Canvas) -> Section:
    """Draw quality against seconds, milliseconds and megabytes, for the mean of scenes and for each scene."""
    scenes = basis(group)
    points = f.points(group, scenes)
    tabs = [_frontier_tab(group, canvas, "f0", _title(scenes), scenes)] if points else []
    single = [s for s in group.scenes if [s] != scenes and any(s in arm.runs for arm in group.arms)]
    drawn = single[: canvas.scenes]
    tabs += [_frontier_tab(group, canvas, f"f{i}", s, [s]) for i, s in enumerate(drawn, 1)]
    columns = [Column("scene"), Column("model"), Column("variant"), Column("seeds"), Column("PSNR dB", 2)]
    columns += [Column("95 % low", 2), Column("95 % high", 2), Column("training s", 1), Column("ms a frame", 2)]
    columns += [Column("MB", 2), Column("dominated in seconds")]
    rows = [row for where in [scenes, *([s] for s in single)] for row in _rows(group, where)]
    table = Table("frontier.csv", columns, rows) if rows else None
    theirs = any(_paper(r, "ms") for r in group.finished)
    notes = ["×: the paper's own number, which was measured on other hardware by another protocol."] if theirs else []
    if len(drawn) < len(single):
        notes.append(f"Of {len(single)} scenes {len(drawn) or 'none'} are drawn singly; the table has all.")
    return Section(
        "frontier", "What accuracy costs", _frontier_words(group, points), tabs, table, legend=bool(tabs), notes=notes
    )


def _title(scenes: list[str]) -> str:
    return scenes[0] if len(scenes) == 1 else f"mean of {len(scenes)} scenes"


def _rows(group: Group, scenes: list[str]) -> list[list[Value]]:
    """Return a row of the table for every point."""
    points = f.points(group, scenes)
    beaten = f.dominated(points, "seconds")
    return [
        [
            _title(scenes),
            p.arm.model,
            p.arm.variant or "none",
            p.psnr.seeds,
            p.psnr.mean,
            p.psnr.low,
            p.psnr.high,
            p.cost["seconds"],
            p.cost["ms"],
            p.cost["mb"],
            "yes" if p in beaten else "no",
        ]
        for p in points
    ]


def _frontier_tab(group: Group, canvas: Canvas, key: str, label: str, scenes: list[str]) -> Tab:
    """Draw the three panels of some scenes."""
    points = f.points(group, scenes)
    drawings = []
    for cost, title in AXES:
        curves = [
            _curve(group, canvas.runs, style, [p for p in points if p.series == name], cost, scenes)
            for name, style in canvas.look.items()
        ]
        drawn = [c for c in curves if c.best]
        if drawn:
            alt = f"PSNR in dB against {title} of {words.listing([p.arm.name for p in points][:20])}, {label}"
            drawings.append(
                Drawing(f"PSNR against {title}", charts.frontier(drawn, title).svg(canvas.name + key + cost, alt))
            )
    return Tab(label, drawings)


def _curve(group: Group, runs: Runs, style: Style, points: list[Point], cost: str, scenes: list[str]) -> charts.Curve:
    """Gather what a panel shows of one model."""
    best = f.frontier(points, cost)
    beaten = [p for p in points if p not in best and not math.isnan(p.cost[cost])]
    of = {id(p): runs.of_arm(group, p.arm, scenes) for p in points}
    mark = lambda p: charts.Mark(p.cost[cost], p.psnr.mean, of[id(p)], p.psnr.low, p.psnr.high)  # noqa: E731
    single: list[charts.Mark] = []
    theirs: list[charts.Mark] = []
    if len(scenes) == 1:
        gated = any(p.arm.on_demand for p in points)  # the paper's models are not
        own = [r for p in points for r in p.arm.runs[scenes[0]]]
        if len(own) > len(points) and len(own) <= MOST_RUNS // max(1, len(group.series)):
            pairs = [(group.value(r, cost), group.value(r, "psnr"), runs.of_record(group, r)) for r in own]
            single = [charts.Mark(x, y, run) for x, y, run in pairs if not math.isnan(x + y)]
        theirs = [charts.Mark(*at, runs.of_paper(r)) for r in own[:1] if not gated and (at := _paper(r, cost))]
    return charts.Curve(style, [mark(p) for p in best], [mark(p) for p in beaten], single, theirs)


def _paper(record: Record, cost: str) -> tuple[float, float] | None:
    """Return where the paper's row stands, which was measured on other hardware, if the data are the paper's."""
    row = paper.paper_row(record.dataset, record.scene, record.model)
    if record.protocol.get("paper_dataset") != record.dataset or row is None:
        return None
    if cost == "seconds":
        return (row.train_min * 60, row.psnr) if row.train_min else None
    return (1000 / row.fps, row.psnr) if cost == "ms" else None


def _frontier_words(group: Group, points: list[Point]) -> list[str]:
    """Say what is best, what is dominated, and what the points are from."""
    if not points:
        return ["No run has finished, so there is nothing to compare."]
    best = max(points, key=lambda p: p.psnr.mean)
    scenes = basis(group)
    where = (
        f"On {scenes[0]}" if len(scenes) == 1 else f"On the mean of {len(scenes)} scenes ({words.listing(scenes[:6])})"
    )
    split = words.cut(group.finished[0].protocol.get("eval_split", "evaluated"), 20)
    reached = f"{words.plain(best.psnr.mean)} dB ({words.interval(best.psnr)})"
    took = f" in {words.duration(best.cost['seconds'])}" if not math.isnan(best.cost["seconds"]) else ""
    text = f"{where}, {split} split, {best.arm.name} reaches most: {reached}{took}. "
    timed = [p for p in points if not math.isnan(p.cost["seconds"])]
    beaten = f.dominated(timed, "seconds")
    if len(points) == 1:
        text += "It is the only point."
    elif len(beaten) == 1:
        by = min(
            (p for p in timed if p not in beaten and f.dominates(p, beaten[0], "seconds")),
            key=lambda p: p.cost["seconds"],
        )
        text += (
            f"{beaten[0].arm.name} is dominated: {by.arm.name} is no worse and no slower, and ahead in one of the two."
        )
    elif beaten:
        text += f"{len(beaten)} of {len(timed)} points are dominated, as another is no worse and no slower."
    elif len(timed) > 1:
        text += "No point is dominated: each step in PSNR costs more training time."
    return [text, _lengths(points)]


def _lengths(points: list[Point]) -> str:
    """Say of which lengths of training the points are."""
    lengths = sorted({n for p in points if (n := p.arm.iterations)})
    if len(lengths) > 1:
        return f"Each point is a finished run: {len(lengths)} lengths, {lengths[0]:,} to {lengths[-1]:,} iterations."
    length = f"{lengths[0]:,} iterations" if lengths else "one length"
    return f"All runs are of one length ({length}): what a shorter or longer run would give is not known."
