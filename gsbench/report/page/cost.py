"""Write the sections of the HTML report on cost: the best model within each budget, and PSNR against cost."""

import math
from dataclasses import dataclass

from gsbench.measure.record import Record
from gsbench.report import frontier as f
from gsbench.report import paper
from gsbench.report.configurations import Configuration, Group, is_beside_others, without
from gsbench.report.family import Family
from gsbench.report.frontier import FrontierPoint
from gsbench.report.page import charts, messages
from gsbench.report.page.content import (
    Canvas,
    Column,
    DataTable,
    PageFigure,
    PageSection,
    Runs,
    Tab,
    Value,
    scenes_title,
)
from gsbench.report.page.palette import Style
from gsbench.report.paper_protocol import has_images_of_paper

AXES = (("seconds", "training seconds"), ("ms", "ms a frame"), ("mb", "MB of the model"))
MOST_RUNS = 300  # single runs that are drawn in a figure
MOST_NAMED = 3  # models that a sentence names
INTERVALS = (
    "The 95 % interval of a model's PSNR is for other seeds on these scenes and views. Whether two models differ is "
    "tested in the section “Is it a difference?”."
)
BESIDE = " (beside other work)"  # after a time that was not measured on a quiet machine


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
        return "No run has finished yet."
    points = f.points(group, scenes)
    split = _split(group)
    chosen = "on val" if f.has_val(points) else f"on {split}, because some runs have no PSNR on val"
    text = f"Each answer is the model with the highest PSNR {chosen}, of those within the budget. "
    text += f"Its PSNR is that on {split}, {'the ' * (len(scenes) > 1)}{scenes_title(scenes)}. "
    if split == "val" or not f.has_val(points):
        text += "The same views choose and measure, so the highest PSNR is a little too high. "
    if family.size():
        many = messages.count(family.size(), "comparison")
        text += f"A difference is significant if p < 5 % after Holm's correction for the {many} on this page. "
    alone = without(group.variant, "iterations") if len({c.variant for c in group.configurations}) == 1 else ""
    text += f"All runs have {alone}. " if alone else ""
    if any(_beside(p.configuration) for p in points):
        text += f"A time{BESIDE} was measured while the machine was busy. It may be shorter on a quiet machine. "
    return text + _lengths(points)


def seeds_words(group: Group) -> tuple[str, str]:
    """Say which models have one seed only, and give the command that runs more; both are "" if all have several."""
    single = [c for c in group.configurations if max(map(len, c.runs.values())) == 1]
    if not single:
        return "", ""
    whole = len(single) == len(group.configurations)
    which = "One seed" if whole else f"{len(single)} of {len(group.configurations)} models have one seed"
    common = [c for c in single if c.variant == single[0].variant]
    command = messages.more_seeds([r for c in common for runs in c.runs.values() for r in runs])
    text = f"{which}: no interval is known, and no difference is tested."
    return f"{text} Run more seeds:" if command else text, command


def _beside(configuration: Configuration) -> bool:
    """Tell whether a run of a configuration was measured while the machine had other work."""
    return any(is_beside_others(r) for runs in configuration.runs.values() for r in runs)


def _split(group: Group) -> str:
    return messages.shorten(group.finished[0].protocol.get("eval_split", "evaluated"), 20)


def _answer(points: list[FrontierPoint], family: Family, cost: str, budget: float) -> BudgetAnswer:
    timed = cost == "seconds"
    title = f"{messages.budget(budget)} of training" if timed else f"{1000 / budget:g} frames a second"
    known = [p.cost[cost] for p in points if not math.isnan(p.cost[cost])]
    if not known:
        return BudgetAnswer(title, "", "not measured", "", "No finished run has this time.")
    write = messages.duration if timed else lambda ms: f"{messages.plain(ms)} ms a frame"
    choice = f.choose(points, cost, budget, family)
    if choice is None:
        return BudgetAnswer(title, "", "no model", "", f"The fastest needs {write(min(known))}.")
    point = choice.point
    beside = BESIDE if _beside(point.configuration) else ""
    detail = f"{_told(point.configuration)}{write(point.cost[cost])}{beside}. {_compared(choice)}"
    if timed and budget > 2 * max(known):
        detail += f" The longest training took {write(max(known))}."
    interval = messages.interval(point.psnr)
    return BudgetAnswer(title, point.series, f"{messages.plain(point.psnr.mean)} dB", interval, detail.strip())


def _compared(choice: f.BudgetChoice) -> str:
    """Say whether the chosen model is significantly better than each other model within the budget.

    The text is empty if no difference could be tested, for lack of seeds.
    """
    others = choice.others
    if not others:
        return "No other model is within this budget."
    if len(choice.unknown) == others:
        return ""
    if len(choice.ahead) == others:
        every = choice.ahead[0].series if others == 1 else "every other model within this budget"
        return f"Significantly better than {every}."
    said = [f"Significantly better than {len(choice.ahead)} of {others} other models."] if choice.ahead else []
    said += [f"No significant difference to {_named(choice.level)}."] if choice.level else []
    said += [f"Significantly worse than {_named(choice.behind)} on the views shown."] if choice.behind else []
    said += [f"Not tested against {_named(choice.unknown)}: too few seeds."] if choice.unknown else []
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
    tabs = [_frontier_tab(group, canvas, "f0", scenes_title(scenes), scenes)] if points else []
    single = [s for s in group.scenes if [s] != scenes and any(s in c.runs for c in group.configurations)]
    drawn = single[: canvas.scenes]
    tabs += [_frontier_tab(group, canvas, f"f{i}", s, [s]) for i, s in enumerate(drawn, 1)]
    columns = [Column("scene"), Column("model"), Column("variant"), Column("seeds"), Column("PSNR dB", 2)]
    columns += [Column("95 % low", 2), Column("95 % high", 2), Column("PSNR val dB", 2), Column("training s", 1)]
    columns += [Column("ms a frame", 2), Column("MB", 2), Column("slower and worse than another")]
    rows = [row for where in [scenes, *([s] for s in single)] for row in _rows(group, where)]
    table = DataTable("frontier.csv", columns, rows) if rows else None
    theirs = any(_paper(r, "ms") for r in group.finished)
    notes = [INTERVALS] if any(p.psnr.over for p in points) else []
    notes += ["×: the paper's number, on other hardware and as the best on test during training."] if theirs else []
    if len(drawn) < len(single):
        notes.append(f"{len(drawn) or 'None'} of {len(single)} scenes have figures of their own; the table has all.")
    return PageSection(
        "frontier", "What accuracy costs", _frontier_words(group, points), tabs, table, legend=bool(tabs), notes=notes
    )


def _rows(group: Group, scenes: list[str]) -> list[list[Value]]:
    """Return a table row for every model and setting that finished the given scenes."""
    points = f.points(group, scenes)
    beaten = f.beaten(points, "seconds")
    return [
        [
            scenes_title(scenes),
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
    named = messages.in_brackets(messages.listing(scenes[:6]) if len(scenes) > 1 else "")
    reached = f"{messages.plain(best.psnr.mean)} dB{messages.in_brackets(messages.interval(best.psnr))}"
    seconds = best.cost["seconds"]
    took = "" if math.isnan(seconds) else f" after {messages.duration(seconds)} of training"
    where = f"On {'the ' * (len(scenes) > 1)}{scenes_title(scenes)}{named}, {best.configuration.name}"
    if len(points) == 1:
        return [f"{where} has {reached} on {split}{took}. No other model has finished there."]
    on_val = f.has_val(points) and split != "val"
    leads = f"{where} has the highest PSNR on {'val' if on_val else split}"
    text = f"{leads}. Its PSNR on {split} is {reached}" if on_val else f"{leads}: {reached}"
    return [f"{text}{took}. {_beaten_words(points)}".strip()]


def _beaten_words(points: list[FrontierPoint]) -> str:
    """Say how many points are dominated by a cheaper and better point.

    Only means are compared, so some of these differences may not be significant.
    """
    timed = [p for p in points if not math.isnan(p.cost["seconds"])]
    beaten = f.beaten(timed, "seconds")
    what = "model" if len({p.series for p in points}) == len(points) else "configuration"
    if not beaten:
        return f"No {what} is both slower and worse than another." if len(timed) > 1 else ""
    if len(beaten) > 1:
        many = f"{len(beaten)} of {len(timed)} {what}s are both slower and worse than another"
        return f"{many}, by their means. Some of these differences may be chance."
    rivals = [p for p in timed if p not in beaten and f.beats(p, beaten[0], "seconds")]
    by = min(rivals, key=lambda p: p.cost["seconds"])
    names = f"{beaten[0].configuration.name} is both slower and worse than {by.configuration.name}"
    return f"{names}, by their means. The difference may be chance."


def _lengths(points: list[FrontierPoint]) -> str:
    """Say which training lengths the runs have."""
    lengths = sorted({n for p in points if (n := p.configuration.iterations)})
    if len(lengths) > 1:
        return f"The runs have {len(lengths)} lengths, from {lengths[0]:,} to {lengths[-1]:,} iterations."
    if any(r.length_choice for p in points for runs in p.configuration.runs.values() for r in runs):
        return "The length of each run was chosen on val (train.lengths)."
    length = messages.count(lengths[0], "iteration") if lengths else "one length"
    return f"All runs have {length}. With other lengths the models may rank differently."
