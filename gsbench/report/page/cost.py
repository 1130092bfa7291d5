"""Write the sections of the HTML report on cost: the best model within each budget, and PSNR against cost."""

import math
from dataclasses import dataclass

from gsbench.measure.record import Record
from gsbench.report import frontier as f
from gsbench.report import paper
from gsbench.report.configurations import Configuration, Group, without
from gsbench.report.family import Family
from gsbench.report.frontier import FrontierPoint
from gsbench.report.page import charts, messages
from gsbench.report.page.content import Canvas, Column, DataTable, PageFigure, PageSection, Runs, Tab, Value
from gsbench.report.page.palette import Style
from gsbench.report.paper_protocol import has_images_of_paper

AXES = (("seconds", "training seconds"), ("ms", "ms a frame"), ("mb", "MB of the model"))
MOST_RUNS = 300  # single runs that are drawn in a figure
MOST_NAMED = 3  # models that a sentence names
INTERVALS = (
    "The 95 % interval of a model's own PSNR is over seeds: what other seeds would give on these scenes and views. "
    "It does not tell whether two models differ; the section “Is it a difference?” does."
)


@dataclass(frozen=True)
class BudgetAnswer:
    """The best model within a budget of time, as text for the HTML report."""

    budget: str
    model: str  # empty if no model is within the budget
    value: str
    interval: str
    detail: str


def answers(group: Group, family: Family) -> list[BudgetAnswer]:
    """Return which model is best for each budget of training time, and for rendering 60 frames per second.

    Args:
        group: the run records of one experiment.
        family: the adjusted p-values of all comparisons in the report.
    """
    points = f.points(group, group.basis)
    return [_answer(points, family, cost, budget) for cost, budget in f.BUDGETS]


def basis_words(group: Group, family: Family) -> str:
    """Describe on which scenes and views the best model for each budget was chosen, and how models are compared."""
    scenes = group.basis
    if not scenes:
        return "Nothing has finished yet."
    points = f.points(group, scenes)
    where = scenes[0] if len(scenes) == 1 else f"the mean of {len(scenes)} scenes"
    split = _split(group)
    chosen = "on val" if f.has_val(points) else f"on {split}, as some runs have no PSNR on val"
    text = f"Chosen {chosen} among the finished runs that fit; shown is the PSNR on {split}, {where}. "
    if split == "val" or not f.has_val(points):
        text += "The same views choose and show, so the highest PSNR is a little too high. "
    if family.size():
        many = messages.count(family.size(), "comparison")
        text += f"Models are told apart after Holm's correction for all {many} on this page. "
    alone = group.variant if len({c.variant for c in group.configurations}) == 1 else ""
    text += f"Every run with {alone}. " if alone else ""
    return text + _lengths(points)


def _split(group: Group) -> str:
    return messages.shorten(group.finished[0].protocol.get("eval_split", "evaluated"), 20)


def _answer(points: list[FrontierPoint], family: Family, cost: str, budget: float) -> BudgetAnswer:
    timed = cost == "seconds"
    title = f"{messages.budget(budget)} of training" if timed else f"{1000 / budget:g} frames a second"
    known = [p.cost[cost] for p in points if not math.isnan(p.cost[cost])]
    if not known:
        return BudgetAnswer(title, "", "not measured", "", "No finished run tells.")
    write = messages.duration if timed else lambda ms: f"{messages.plain(ms)} ms a frame"
    choice = f.choose(points, cost, budget, family)
    if choice is None:
        return BudgetAnswer(title, "", "none fits", "", f"The quickest took {write(min(known))}.")
    point = choice.point
    detail = f"{_told(point.configuration)}{write(point.cost[cost])}. {_compared(choice)}"
    if timed and budget > 2 * max(known):
        detail += f" No run here trained longer than {write(max(known))}."
    return BudgetAnswer(
        title, point.series, f"{messages.plain(point.psnr.mean)} dB", messages.interval(point.psnr), detail
    )


def _compared(choice: f.BudgetChoice) -> str:
    """Say whether the chosen model is significantly better than each other model within the budget."""
    others = choice.others
    if not others:
        return "No other model fits."
    if len(choice.unknown) == others:
        return "One seed: whether it is ahead is not known."
    if len(choice.ahead) == others:
        return f"Ahead of {choice.ahead[0].series}." if others == 1 else "Ahead of every other model that fits."
    said = [f"Ahead of {len(choice.ahead)} of {messages.count(others, 'other model')}."] if choice.ahead else []
    said += [f"Not told apart from {_named(choice.level)}."] if choice.level else []
    said += [f"On the views shown {_named(choice.behind)} did better."] if choice.behind else []
    said += [f"No spread is known of the difference to {_named(choice.unknown)}."] if choice.unknown else []
    return " ".join(said)


def _named(points: list[FrontierPoint]) -> str:
    names = [p.series for p in points]
    more = [f"{len(names) - MOST_NAMED} more"] if len(names) > MOST_NAMED else []
    return messages.listing(names[:MOST_NAMED] + more)


def _told(configuration: Configuration) -> str:
    """Describe the settings of a model: its number of training iterations, and what else differs from the default."""
    length = f"{configuration.iterations:,} iterations, " if configuration.iterations else ""
    is_gated = configuration.series != configuration.model
    told = [name for name, known in (("iterations", length), ("gate", is_gated)) if known]
    rest = without(configuration.variant, *told) if configuration.name != configuration.model else ""
    return length + (f"{rest.replace(',', ', ')}, " if rest else "")


def frontier_section(group: Group, canvas: Canvas) -> PageSection:
    """Make the section that draws PSNR against training seconds, milliseconds per frame and megabytes of the model.

    The figures show the mean over scenes and each scene.
    """
    scenes = group.basis
    points = f.points(group, scenes)
    tabs = [_frontier_tab(group, canvas, "f0", _title(scenes), scenes)] if points else []
    single = [s for s in group.scenes if [s] != scenes and any(s in c.runs for c in group.configurations)]
    drawn = single[: canvas.scenes]
    tabs += [_frontier_tab(group, canvas, f"f{i}", s, [s]) for i, s in enumerate(drawn, 1)]
    columns = [Column("scene"), Column("model"), Column("variant"), Column("seeds"), Column("PSNR dB", 2)]
    columns += [Column("95 % low", 2), Column("95 % high", 2), Column("PSNR val dB", 2), Column("training s", 1)]
    columns += [Column("ms a frame", 2), Column("MB", 2), Column("beaten in seconds")]
    rows = [row for where in [scenes, *([s] for s in single)] for row in _rows(group, where)]
    table = DataTable("frontier.csv", columns, rows) if rows else None
    theirs = any(_paper(r, "ms") for r in group.finished)
    notes = [INTERVALS] if any(p.psnr.over for p in points) else []
    notes += ["×: the paper's own number, which was measured on other hardware by another protocol."] if theirs else []
    if len(drawn) < len(single):
        notes.append(f"Of {len(single)} scenes {len(drawn) or 'none'} are drawn singly; the table has all.")
    return PageSection(
        "frontier", "What accuracy costs", _frontier_words(group, points), tabs, table, legend=bool(tabs), notes=notes
    )


def _title(scenes: list[str]) -> str:
    return scenes[0] if len(scenes) == 1 else f"mean of {len(scenes)} scenes"


def _rows(group: Group, scenes: list[str]) -> list[list[Value]]:
    """Return a table row for every model and setting that finished the given scenes."""
    points = f.points(group, scenes)
    beaten = f.beaten(points, "seconds")
    return [
        [
            _title(scenes),
            p.configuration.model,
            p.configuration.variant or "none",
            p.psnr.seeds,
            p.psnr.mean,
            p.psnr.low,
            p.psnr.high,
            p.val,
            p.cost["seconds"],
            p.cost["ms"],
            p.cost["mb"],
            "yes" if p in beaten else "no",
        ]
        for p in points
    ]


def _frontier_tab(group: Group, canvas: Canvas, key: str, label: str, scenes: list[str]) -> Tab:
    """Draw three figures for the given scenes: PSNR against training seconds, ms per frame, and MB of the model."""
    points = f.points(group, scenes)
    drawings = []
    for cost, title in AXES:
        curves = [
            _curve(group, canvas.runs, style, [p for p in points if p.series == name], cost, scenes)
            for name, style in canvas.look.items()
        ]
        drawn = [c for c in curves if c.best]
        if drawn:
            named = messages.listing([p.configuration.name for p in points][:20])
            alt = f"PSNR in dB against {title} of {named}, {label}"
            panel = charts.frontier(drawn, title)
            drawings.append(PageFigure(f"PSNR against {title}", panel, canvas.name + key + cost, alt))
    return Tab(label, drawings)


def _curve(
    group: Group, runs: Runs, style: Style, points: list[FrontierPoint], cost: str, scenes: list[str]
) -> charts.FrontierCurve:
    """Collect the points of one model for a figure of PSNR against a cost."""
    best = f.frontier(points, cost)
    beaten = [p for p in points if p not in best and not math.isnan(p.cost[cost])]
    of = {id(p): runs.of_configuration(group, p.configuration, scenes) for p in points}
    mark = lambda p: charts.Mark(p.cost[cost], p.psnr.mean, of[id(p)], p.psnr.low, p.psnr.high)  # noqa: E731
    single: list[charts.Mark] = []
    theirs: list[charts.Mark] = []
    if len(scenes) == 1:
        gated = any(p.configuration.on_demand for p in points)  # models of the paper keep all effects
        own = [r for p in points for r in p.configuration.runs[scenes[0]]]
        if len(own) > len(points) and len(own) <= MOST_RUNS // max(1, len(group.series)):
            pairs = [(group.value(r, cost), group.value(r, "psnr"), runs.of_record(group, r)) for r in own]
            single = [charts.Mark(x, y, run) for x, y, run in pairs if not math.isnan(x + y)]
        theirs = [charts.Mark(*at, runs.of_paper(r)) for r in own[:1] if not gated and (at := _paper(r, cost))]
    return charts.FrontierCurve(style, [mark(p) for p in best], [mark(p) for p in beaten], single, theirs)


def _paper(record: Record, cost: str) -> tuple[float, float] | None:
    """Return the cost and the PSNR of a model in the 7DGS paper, or None if the run used other data or image sizes.

    The paper measured the cost on other hardware.
    """
    row = paper.paper_row(record.dataset, record.scene, record.model)
    if row is None or not has_images_of_paper(record):
        return None
    if cost == "seconds":
        return (row.train_min * 60, row.psnr) if row.train_min else None
    return (1000 / row.fps, row.psnr) if cost == "ms" else None


def _frontier_words(group: Group, points: list[FrontierPoint]) -> list[str]:
    """Say which model has the highest PSNR, and which points are dominated by a cheaper and better one."""
    if not points:
        return ["No run has finished, so there is nothing to compare."]
    best, scenes, split = f.ranked(points)[0], group.basis, _split(group)
    where = (
        f"On {scenes[0]}"
        if len(scenes) == 1
        else f"On the mean of {len(scenes)} scenes ({messages.listing(scenes[:6])})"
    )
    reached = f"{messages.plain(best.psnr.mean)} dB ({messages.interval(best.psnr)})"
    took = f" in {messages.duration(best.cost['seconds'])}" if not math.isnan(best.cost["seconds"]) else ""
    leads = f"{best.configuration.name} is highest{' on val' if f.has_val(points) else ''}"
    text = f"{where}, {leads}: it has {reached} on {split}{took}. {_beaten_words(points)}"
    return [text, _lengths(points)]


def _beaten_words(points: list[FrontierPoint]) -> str:
    """Say how many points are dominated by a cheaper and better point.

    Only means are compared, so some of these differences may not be significant.
    """
    timed = [p for p in points if not math.isnan(p.cost["seconds"])]
    beaten = f.beaten(timed, "seconds")
    if len(points) == 1:
        return "It is the only point."
    if not beaten:
        return (
            "By their means no point is beaten: each step in PSNR costs more training time." if len(timed) > 1 else ""
        )
    if len(beaten) > 1:
        return (
            f"By their means {len(beaten)} of {len(timed)} points are beaten: another point has at least the PSNR in "
            "at most the seconds. Some of these differences may be chance."
        )
    rivals = [p for p in timed if p not in beaten and f.beats(p, beaten[0], "seconds")]
    by = min(rivals, key=lambda p: p.cost["seconds"])
    return (
        f"By their means {beaten[0].configuration.name} is beaten by {by.configuration.name}, which has at least the "
        "PSNR in at most the seconds; the difference may be chance."
    )


def _lengths(points: list[FrontierPoint]) -> str:
    """Say which training lengths the runs have."""
    lengths = sorted({n for p in points if (n := p.configuration.iterations)})
    if len(lengths) > 1:
        return f"Each point is a finished run: {len(lengths)} lengths, {lengths[0]:,} to {lengths[-1]:,} iterations."
    if any(r.length_choice for p in points for runs in p.configuration.runs.values() for r in runs):
        return "Each point is a finished run, whose length was chosen on val (train.lengths)."
    length = f"{lengths[0]:,} iterations" if lengths else "one length"
    return f"All runs are of one length ({length}): what a shorter or longer run would give is not known."
