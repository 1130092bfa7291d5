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
from gsbench.report.page.content import (
    Canvas,
    Column,
    DataTable,
    PageFigure,
    PageSection,
    Swatch,
    Tab,
    Value,
    shown_runs,
)

UNITS = (("psnr", "dB", 2), ("seconds", "training s", 1), ("ms", "ms a frame", 2), ("mb", "MB", 2))
STAGES = ("slice", "raster", "loss", "backward", "density", "optimizer", "screen", "gate", "compare")  # with colours
REST = "other"
MOST_PAIRS = 28  # pairs that are drawn, as many as eight models have
PARAMETRISATION = (
    "“direction, with time” compares 4dgs with 7dgs_noagr, which also differ in how they parametrise a Gaussian."
)
NOT_NESTED = "To compare direction alone, run model=7dgs_nodir, which is 7dgs without direction."
CHANCE = "The intervals are not corrected, so an interval without zero may still be chance."
NESTED = "Rows with “nested” compare direction alone: they have 7dgs_nodir (7dgs without direction) in place of 4dgs."


def effects_section(group: Group, family: Family, canvas: Canvas) -> PageSection:
    """Make the section on what time, view direction and AGR (neural refinement) gain in PSNR and cost.

    The section includes interactions of these effects. It leaves out effects for which a model was not run.
    """
    cube = compare.cube(group, family)
    notes = []
    if cube.missing:
        notes.append(f"No model of the runs shown has these effects: {'; '.join(cube.missing)}.")
    if cube.left_out:
        notes.append(f"Left out, because another model has the same effects: {messages.listing(cube.left_out)}.")
    if cube.on_demand:
        notes.append(
            f"Left out, because each Gaussian keeps only the effects that it needs: {messages.listing(cube.on_demand)}."
        )
    if {"4dgs", "7dgs_noagr"} <= {c.model for c in cube.cells.values()}:
        notes.append(f"{PARAMETRISATION} {NESTED if cube.nested else NOT_NESTED}")
    if not cube.prices:
        text = "No two finished models differ in exactly one effect, so no effect can be measured."
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
        columns.append(Column(f"{title}: significant"))
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
    scope, rule = _scope(cube, family)
    said = [*scope, *_effect_words(cube)]
    notes = [*shown_runs(group, group.main_configurations), *rule, *notes]
    return PageSection("effects", "The price of each effect", said, [Tab("", drawings)], table, notes=notes)


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


def _scope(cube: Cube, family: Family) -> tuple[list[str], list[str]]:
    """Say if the intervals of the gains by time, direction and AGR hold for other scenes or only for other seeds.

    The second text is the rule by which a gain is significant. Both are empty if no interval is known.
    """
    fewest = min((price.costs["psnr"] for price in cube.prices), key=lambda of: of.scenes)
    if not family.size():
        return [], []
    many = messages.count(family.size(), "comparison")
    rule = f"Filled points are significant after Holm's correction (in dB, for the {many} on this page)."
    return [messages.scope(fewest)], [f"{rule} {CHANCE}"]


def _effect_words(cube: Cube) -> list[str]:
    """Say which effect (time, view direction, the network AGR) raises PSNR most, and what it costs.

    The text also says which effects are not significant and how effects interact.
    """
    single = [p for p in cube.prices if compare.is_single(p.name)]
    best = max(single, key=lambda p: p.costs["psnr"].mean)
    gain, seconds = best.costs["psnr"], best.costs["seconds"]
    text = f"The largest gain: {best.name}, {messages.signed(gain.mean)} dB{_details(gain)}"
    text += f", for {messages.signed(seconds.mean, 1)} s of training." if seconds.scenes else "."
    if gain.mean <= 0:
        text = f"No effect raises PSNR here. The smallest loss: {best.name}, {messages.signed(gain.mean)} dB."
    unclear = [p.name for p in single if p.costs["psnr"].over and not p.told["psnr"]]
    said = [text, f"Not significant in dB: {'; '.join(unclear)}." if unclear else ""]
    for price in cube.nested:
        if price.name.startswith("direction"):
            of = price.costs["psnr"]
            told = f", {'' if price.told['psnr'] else 'not '}significant" if of.over else ""
            said.append(f"{messages.sentence(price.name)}, nested: {messages.signed(of.mean)} dB{_details(of)}{told}.")
    for price in cube.prices:
        of = price.costs["psnr"]
        if price.order == 2 and price.told["psnr"]:
            side = f"{messages.plain(abs(of.mean))} dB {'less' if of.mean < 0 else 'more'} than the sum of their gains"
            interval = messages.in_brackets(messages.interval(of, sign=True))
            said.append(f"{messages.sentence(price.name)}: together they gain {side}{interval}.")
    return [s for s in said[:5] if s]


def _details(gain: Estimate) -> str:
    """Return the interval of a gain, how wide it is over scenes like these, and how many scenes gain, in brackets."""
    several = len(gain.each) > 1
    over = several and gain.over not in ("", "scenes")
    return messages.in_brackets(
        messages.interval(gain, sign=True),
        f"± {messages.plain(gain.half_over_scenes)} over scenes like these" if over else "",
        f"{gain.gaining} of {messages.count(len(gain.each), 'scene')} gain" if several else "",
    )


def stages_section(group: Group, canvas: Canvas) -> PageSection:
    """Make the section that draws the training seconds of each model by stage, such as loss or backward pass."""
    parts = {c.model: found for c in group.main_configurations if (found := _stage_seconds(group, c.model))}
    if not parts:
        return PageSection("stages", "Where the seconds go", ["No finished run has seconds by stage."])
    every = {name for stages in parts.values() for name in stages}
    names = [name for name in (*STAGES, REST) if name in every]
    panel = charts.stages(list(parts.items()), names, [_colour(name) for name in names])
    alt = f"Seconds of training by stage for {messages.listing(list(parts))}"
    rows: list[list[Value]] = [
        [m, sum(stages.values()), *(stages.get(s, 0.0) for s in names)] for m, stages in parts.items()
    ]
    columns = [Column("model"), Column("total s", 2), *(Column(f"{s} s", 2) for s in names)]
    share = {s: fmean(stages.get(s, 0.0) / sum(stages.values()) for stages in parts.values()) for s in names}
    first, *others = sorted(names, key=lambda s: -share[s])
    mean = ", in the mean over models" if len(parts) > 1 else ""
    text = f"The longest stage of training is {first} ({100 * share[first]:.0f} % of the time{mean})"
    text += f", then {others[0]} ({100 * share[others[0]]:.0f} %)." if others else "."
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
        notes=shown_runs(group, group.main_configurations),
        swatches=[Swatch(name, f"stage-{_colour(name)}") for name in names],
    )


def _colour(stage: str) -> int:
    """Return the colour number of a training stage, which is the same in every figure."""
    return (*STAGES, REST).index(stage)


def _slowest_words(parts: dict[str, dict[str, float]], names: list[str]) -> str:
    """Say how much longer the slowest model trains than the fastest, and which stage causes most of the difference."""
    slow, quick = (pick(parts, key=lambda m: sum(parts[m].values())) for pick in (max, min))
    took, least = sum(parts[slow].values()), sum(parts[quick].values())
    if f"{took / least:.2g}" == "1":
        return ""
    more = {name: parts[slow].get(name, 0.0) - parts[quick].get(name, 0.0) for name in names}
    most = max(names, key=lambda name: more[name])
    share = 100 * more[most] / (took - least)
    rest = f"{share:.0f} %" if share < 100 else "All"
    return f" {slow} takes {took / least:.2g} times as long as {quick}. {rest} of the difference is in {most}."


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
        text = "No two models have finished the same scene, so there is no pair to compare."
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
    columns += [Column("better on % of views", 0), Column("p, Holm"), Column("significant")]
    table = DataTable("pairs.csv", columns, [_pair_row(group, p) for p in found])
    drawing = PageFigure("Difference in PSNR", charts.differences(rows, "dB"), f"{canvas.name}p", alt)
    notes = shown_runs(group, group.compared)
    if family.size():
        many = messages.count(family.size(), "comparison")
        notes.append(
            f"Filled points are significant: p < 5 % after Holm's correction for the {many} on this page. {CHANCE} "
            "Runs are paired by seed and view. “Better on % of views” is the probability that a run of the first model "
            "has a higher PSNR than a run of the second on the same view."
        )
    if len(found) > MOST_PAIRS:
        notes.append(f"The figure has the {MOST_PAIRS} largest of {len(found)} differences; the table has all.")
    scopes = [messages.scope(p.difference) for p in found if p.difference.over]
    said = [*scopes[:1], *_pair_words(group, found)]
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
        by = f"{messages.plain(first.difference.mean)} dB"
        return [f"The largest difference: {group.label(first.better)} is {by} above {group.label(first.other)}."]
    level = [
        f"{group.label(p.better)} and {group.label(p.other)}"
        for p in found
        if not p.differs and not math.isnan(p.p_holm)
    ]
    tested = sum(not math.isnan(p.p_holm) for p in found)
    if tested == 1:
        return [f"The difference is {'not ' * len(level)}significant."]
    if not level:
        return [f"All {tested} differences are significant."]
    if len(level) == tested:
        return [f"None of {tested} differences is significant."]
    more = f"; {len(level) - 4} more" if len(level) > 4 else ""
    return [f"{tested - len(level)} of {tested} differences are significant. Not significant: "
            f"{'; '.join(level[:4])}{more}."]  # fmt: skip
