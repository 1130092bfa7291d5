"""Write the sections of the HTML report on effects, training time by stage, and differences between models.

The effects are time, view direction and AGR (the neural refinement of Gaussians). Their section shows what each effect
gains in PSNR and what it costs.
"""

import math
from dataclasses import replace
from statistics import fmean

from gsbench.report import compare
from gsbench.report.compare import Cube, Pair, Price
from gsbench.report.configurations import Group
from gsbench.report.family import Family
from gsbench.report.intervals import Estimate
from gsbench.report.page import charts, messages
from gsbench.report.page.content import Canvas, Column, DataTable, PageFigure, PageSection, Swatch, Tab, Value

UNITS = (("psnr", "dB", 2), ("seconds", "training s", 1), ("ms", "ms a frame", 2), ("mb", "MB", 2))
STAGES = ("slice", "raster", "loss", "backward", "density", "optimizer", "screen", "gate", "compare")  # with colours
REST = "other"
MOST_PAIRS = 28  # pairs that are drawn, as many as eight models have
PARAMETRISATION = (
    "4dgs is another parametrisation of a Gaussian than 7dgs without direction, so direction given time is priced "
    "across the two."
)
NOT_NESTED = "The nested comparison, with model=7dgs_nodir, needs runs that are not among these records."
NESTED = "Nested: 7dgs_nodir, which is 7dgs less direction and nothing else, in the place of 4dgs."


def effects_section(group: Group, family: Family, canvas: Canvas) -> PageSection:
    """Make the section on what time, view direction and AGR (neural refinement) gain in PSNR and cost.

    The section includes interactions of these effects. It leaves out effects for which a model was not run.
    """
    cube = compare.cube(group, family)
    notes = []
    if cube.missing:
        notes.append(f"Not run, so not priced: models with {messages.listing(cube.missing, 'or')}.")
    if cube.left_out:
        notes.append(f"Left out, as another model has the same effects: {messages.listing(cube.left_out)}.")
    if cube.on_demand:
        notes.append(
            f"Left out, as their Gaussians keep only the effects that pay: {messages.listing(cube.on_demand)}."
        )
    if {"4dgs", "7dgs_noagr"} <= {c.model for c in cube.cells.values()}:
        notes.append(f"{PARAMETRISATION} {NESTED if cube.nested else NOT_NESTED}")
    if not cube.prices:
        text = "No two finished models differ in one effect alone, so no effect can be priced."
        return PageSection("effects", "The price of each effect", [text], notes=notes)
    shown = cube.prices + [replace(price, name=f"{price.name}, nested") for price in cube.nested]
    drawings = []
    for unit, title, digits in UNITS:
        rows = [_row(price, unit, digits) for price in shown if price.costs[unit].scenes]
        if rows:
            alt = f"Change in {title} of {messages.listing([row.label for row in rows])}"
            panel = charts.differences(rows, title)
            drawings.append(PageFigure(f"in {title}", panel, f"{canvas.name}e{unit}", alt))
    columns = [Column("effect"), Column("computed from")]
    for _, title, digits in UNITS:
        columns += [Column(title, digits), Column(f"{title}: 95 % low", digits), Column(f"{title}: high", digits)]
        columns.append(Column(f"{title}: told from nothing"))
    columns += [Column("interval of dB over"), Column("dB: half width over scenes like these", 2)]
    columns += [Column("scenes that gain", 0), Column("scenes that lose", 0)]
    priced: list[list[Value]] = [
        [
            p.name,
            p.models,
            *(v for unit, _, _ in UNITS for v in _cells(p, unit)),
            *_over_scenes(p.costs["psnr"]),
        ]
        for p in shown
    ]
    table = DataTable("effects.csv", columns, priced)
    first, *rule = _scope(cube, family)
    said = [first, *_effect_words(cube)]
    return PageSection("effects", "The price of each effect", said, [Tab("", drawings)], table, notes=[*rule, *notes])


def _row(price: Price, unit: str, digits: int) -> charts.Difference:
    of = price.costs[unit]
    return charts.Difference(price.name, of.mean, of.low, of.high, price.told[unit], messages.signed(of.mean, digits))


def _cells(price: Price, unit: str) -> tuple[Value, ...]:
    of = price.costs[unit]
    told = "yes" if price.told[unit] else "no" if of.over else "not known"
    return of.mean, of.low, of.high, told


def _over_scenes(gain: Estimate) -> tuple[Value, ...]:
    """Return what an interval is over, its half width over scenes, and how many scenes gain and lose PSNR."""
    losses = sum(mean < 0 for mean in gain.each)
    return messages.over(gain), gain.half_over_scenes, gain.gaining, losses


def _scope(cube: Cube, family: Family) -> list[str]:
    """Say if the intervals of the gains by time, direction and AGR hold for other scenes or only for other seeds.

    The text also says for how many comparisons the p-values are adjusted.
    """
    fewest = min((price.costs["psnr"] for price in cube.prices), key=lambda of: of.scenes)
    if not family.size():
        return [messages.scope(fewest)]
    many = messages.count(family.size(), "comparison")
    return [
        messages.scope(fewest),
        f"Filled points are told from nothing after Holm's correction, in dB for all {many} on this page. An interval "
        "is of its price alone, so one that leaves out zero may still be chance among so many.",
    ]


def _effect_words(cube: Cube) -> list[str]:
    """Say which effect (time, view direction, the network AGR) raises PSNR most, and what it costs.

    The text also says which effects are not significant and how effects interact.
    """
    single = [p for p in cube.prices if compare.is_single(p.name)]
    best = max(single, key=lambda p: p.costs["psnr"].mean)
    gain, seconds = best.costs["psnr"], best.costs["seconds"]
    text = f"Worth most: {best.name}, {messages.signed(gain.mean)} dB ({messages.interval(gain, sign=True)}"
    text += f"{_scene_words(gain)})"
    text += f", for {messages.signed(seconds.mean, 1)} s of training." if seconds.scenes else "."
    if gain.mean <= 0:
        text = f"No effect raises PSNR here; {best.name} lowers it least: {messages.signed(gain.mean)} dB."
    unclear = [p.name for p in single if p.costs["psnr"].over and not p.told["psnr"]]
    said = [text, f"Not told from nothing in dB: {'; '.join(unclear)}." if unclear else ""]
    for price in cube.nested:
        if price.name.startswith("direction"):
            of = price.costs["psnr"]
            told = f", {'' if price.told['psnr'] else 'not '}told from nothing" if of.over else ""
            said.append(f"{messages.sentence(price.name)}, within one parametrisation: {messages.signed(of.mean)} dB "
                        f"({messages.interval(of, sign=True)}{_scene_words(of)}){told}.")  # fmt: skip
    for price in cube.prices:
        of = price.costs["psnr"]
        if price.order == 2 and price.told["psnr"]:
            side = (
                f"{messages.plain(abs(of.mean))} dB {'less' if of.mean < 0 else 'more'} than the sum of each by itself"
            )
            said.append(
                f"{messages.sentence(price.name)}: together they bring {side} ({messages.interval(of, sign=True)})."
            )
    return [s for s in said[:5] if s]


def _scene_words(gain: Estimate) -> str:
    """Say on how many scenes PSNR gains, and how wide the interval over scenes like these is; "" for one scene."""
    if len(gain.each) < 2:
        return ""
    wide = "" if gain.over in ("", "scenes") else f"; ± {messages.plain(gain.half_over_scenes)} over scenes like these"
    return f"{wide}; {gain.gaining} of {messages.count(len(gain.each), 'scene')} gain"


def stages_section(group: Group, canvas: Canvas) -> PageSection:
    """Make the section that draws the training seconds of each model by stage, such as loss or backward pass."""
    parts = {c.model: found for c in group.main_configurations if (found := _stage_seconds(group, c.model))}
    if not parts:
        return PageSection("stages", "Where the seconds go", ["No finished run tells its seconds by stage."])
    every = {name for stages in parts.values() for name in stages}
    names = [name for name in (*STAGES, REST) if name in every]
    panel = charts.stages(list(parts.items()), names, [_colour(name) for name in names])
    alt = f"Seconds of training by stage for {messages.listing(list(parts))}"
    rows: list[list[Value]] = [
        [m, *(stages.get(s, 0.0) for s in names), sum(stages.values())] for m, stages in parts.items()
    ]
    columns = [Column("model"), *(Column(f"{s} s", 2) for s in names), Column("training s", 2)]
    share = {s: fmean(stages.get(s, 0.0) / sum(stages.values()) for stages in parts.values()) for s in names}
    first, *others = sorted(names, key=lambda s: -share[s])
    text = f"The largest share of training, on the mean of the models, is {first} with {100 * share[first]:.0f} %"
    text += f", then {others[0]} with {100 * share[others[0]]:.0f} %." if others else "."
    text += _slowest_words(parts, names)
    table = DataTable("stages.csv", columns, rows)
    drawing = PageFigure("Seconds of training by stage", panel, f"{canvas.name}s", alt)
    return PageSection(
        "stages",
        "Where the seconds go",
        [text],
        [Tab("", [drawing])],
        table,
        beside=True,
        swatches=[Swatch(name, f"stage-{_colour(name)}") for name in names],
    )


def _colour(stage: str) -> int:
    """Return the colour number of a training stage, which is the same in every figure."""
    return (*STAGES, REST).index(stage)


def _slowest_words(parts: dict[str, dict[str, float]], names: list[str]) -> str:
    """Say how much longer the slowest model trains than the fastest, and which stage causes most of the difference."""
    slow, quick = (pick(parts, key=lambda m: sum(parts[m].values())) for pick in (max, min))
    took, least = sum(parts[slow].values()), sum(parts[quick].values())
    if took == least:
        return ""
    more = {name: parts[slow].get(name, 0.0) - parts[quick].get(name, 0.0) for name in names}
    most = max(names, key=lambda name: more[name])
    share = 100 * more[most] / (took - least)
    rest = f"{share:.0f} % of the difference is in {most}" if share < 100 else f"all of the difference is in {most}"
    return f" {slow} takes {took / least:.2g} times the seconds of {quick}; {rest}."


def _stage_seconds(group: Group, model: str) -> dict[str, float]:
    """Return the seconds of a model in each stage of training and in all other work, averaged over scenes and seeds."""
    (configuration,) = (c for c in group.main_configurations if c.model == model)
    scenes = [s for s in group.covered or configuration.runs if s in configuration.runs]
    runs = [[r for r in configuration.runs[s] if r.cost and not math.isnan(group.value(r, "seconds"))] for s in scenes]
    if not runs or not all(runs):
        return {}
    costs = [[r.cost for r in seeds if r.cost] for seeds in runs]
    names = [name for name in STAGES if any(name in cost.stage_s for seeds in costs for cost in seeds)]
    found = {n: fmean(fmean(c.stage_s.get(n, 0.0) for c in seeds) for seeds in costs) for n in names}
    total = fmean(fmean(c.train_s for c in seeds) for seeds in costs)
    rest = total - sum(found.values())
    return found | ({REST: rest} if rest > 0.005 * total else {}) if total > 0 else {}


def pairs_section(group: Group, family: Family, canvas: Canvas) -> PageSection:
    """Make the section that draws the PSNR difference of every two models with its interval."""
    found = compare.pairs(group, family)
    if not found:
        text = "Fewer than two models have finished the same scene, so there is no pair to compare."
        return PageSection("pairs", "Is it a difference?", [text])
    rows = [
        charts.Difference(
            _pair_name(group, p), p.difference.mean, p.difference.low, p.difference.high,
            p.differs, messages.signed(p.difference.mean),
        )
        for p in found[:MOST_PAIRS]
    ]  # fmt: skip
    alt = f"Differences in PSNR of {messages.count(len(rows), 'pair')} of models with 95 % intervals"
    columns = [Column("pair"), Column("dB", 2), Column("95 % low", 2), Column("95 % high", 2)]
    columns += [Column("ahead on % of views", 0), Column("p, Holm"), Column("told apart")]
    table = DataTable("pairs.csv", columns, [_pair_row(group, p) for p in found])
    drawing = PageFigure("Difference in PSNR", charts.differences(rows, "dB"), f"{canvas.name}p", alt)
    first = found[0].difference
    notes = [
        f"Paired over the seeds and views that both have; each interval, over {messages.over(first)}, is of its pair "
        f"alone. p is adjusted after Holm for all {messages.count(family.size(), 'comparison')} of this page (pairs, "
        "prices, answers to budgets); filled points are told apart, which is p below 5 %. Ahead: how likely a run of "
        "the first beats one of the second on a view."
        if first.over
        else f"{messages.NO_SPREAD.capitalize()}: no interval and no p-value is given."
    ]
    if len(found) > MOST_PAIRS:
        notes.append(
            f"Of {len(found)} pairs the {MOST_PAIRS} with the largest differences are drawn; the file has all."
        )
    said = [*([messages.scope(first)] if first.over else []), *_pair_words(group, found)]
    return PageSection("pairs", "Is it a difference?", said, [Tab("", [drawing])], table, beside=True, notes=notes)


def _pair_name(group: Group, pair: Pair) -> str:
    return f"{group.label(pair.better)} − {group.label(pair.other)}"


def _pair_row(group: Group, pair: Pair) -> list[Value]:
    d = pair.difference
    told = "not known" if math.isnan(pair.p_holm) else "yes" if pair.differs else "no"
    return [
        _pair_name(group, pair),
        d.mean,
        d.low,
        d.high,
        100 * pair.improvement,
        messages.probability(pair.p_holm),
        told,
    ]


def _pair_words(group: Group, found: list[Pair]) -> list[str]:
    """Say how many pairs of models differ significantly, and name the pairs that do not."""
    if all(math.isnan(p.p_holm) for p in found):
        first = found[0]
        by = f"by {messages.plain(first.difference.mean)} dB"
        ahead = f"{group.label(first.better)} is ahead of {group.label(first.other)} {by}"
        return [f"{messages.NO_SPREAD.capitalize()}. The largest difference: {ahead}."]
    level = [
        f"{group.label(p.better)} from {group.label(p.other)}"
        for p in found
        if not p.differs and not math.isnan(p.p_holm)
    ]
    tested = sum(not math.isnan(p.p_holm) for p in found)
    if not level:
        return [
            "The pair is told apart at 95 %."
            if tested == 1
            else f"All {tested} pairs are told apart at 95 %, after Holm."
        ]
    if tested == 1:
        return ["The pair is not told apart at 95 %."]
    named = messages.listing(level[:4]) + (f" and {len(level) - 4} more" if len(level) > 4 else "")
    told = f"{tested - len(level)} of {messages.count(tested, 'pair')} are told apart at 95 %, after Holm"
    return [f"{told}. Not told apart: {named}."]
