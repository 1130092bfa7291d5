"""Write the section of the HTML report on effects on demand: which effects the Gaussians keep, and why.

The effects are time, view direction and AGR (the neural refinement of Gaussians). A Gaussian keeps only the effects
that it needs.
"""

import math
from collections import Counter
from pathlib import Path
from statistics import fmean

from gsbench.effects.messages import EFFECT_SETS, of_comparison, reason
from gsbench.measure.record import Record, TimeScreen
from gsbench.report.configurations import Group
from gsbench.report.intervals import Estimate
from gsbench.report.on_demand import DEGREES, REMOVED, Decided, decided
from gsbench.report.page import charts, gallery, messages
from gsbench.report.page.content import Canvas, Column, DataTable, Image, PageFigure, PageSection, Swatch, Tab, Value
from gsbench.report.page.palette import EFFECT_SET_LIKE, MODELS
from gsbench.report.page.svg import LINE, model_colour, stage_colour

PICTURE, OLD_PICTURE = "effect_sets.png", "classes.png"  # older runs have the old name
MOST_SAID = 12  # scenes and models that are described in a sentence
MOST_BARS = 24
MOST_NOTES = 12
LONGEST_REASON = 200
LONGEST_LABEL = 32  # characters of the label of a bar, which has a number beside it
LABEL_END = 15  # characters at its end, which differ between training lengths and sizes
IN_TRAINING = (
    "The changes in dB and ms are those of the gate after training. A gate during training changes the training too: "
    "compare runs with and without gates in “What accuracy costs”."
)
KEPT = {"on": "kept time", "off": "removed time", "undecided": "kept time, because the test cannot decide"}
NAMES = EFFECT_SETS | {REMOVED: "removed"}


def on_demand_section(group: Group, canvas: Canvas, folder: Path) -> PageSection | None:
    """Make the section on which effects the Gaussians keep; None if no run chose effects.

    The effects are time, view direction and the network AGR. The figures show how many Gaussians keep which effects,
    and the degrees of their spherical harmonics.
    """
    found = decided(group)
    if not found:
        return None
    common = [one for one in found if one.configuration in group.compared] or found
    said = [_sentence(one) for one in common[:MOST_SAID]]
    if len(found) > len(said):
        said.append(f"These are {len(said)} of {len(found)} results; the table has all.")
    gated = [one for one in found if one.gated]
    return PageSection(
        "on-demand",
        "Effects on demand",
        said,
        [Tab("", _drawings(gated[:MOST_BARS], canvas))] if gated else [],
        _table(found, group.machine),
        notes=_notes(found, len(gated)),
        swatches=_swatches() if gated else [],
        images=_images(found, folder),
    )


# ---- sentences


def _sentence(one: Decided) -> str:
    """Describe which effects (time, view direction, the network AGR) a model and its Gaussians keep on a scene."""
    parts = [_screen_words(one.runs) or ":", _comparison_words(one.runs), *_gate_words(one)]
    return f"On {one.scene}, {one.name}{' '.join(part for part in parts if part)}"


def _screen_words(runs: list[Record]) -> str:
    """Say whether the model keeps time, why the first run decided so, and if other seeds gave the same result."""
    screens = _screens(runs)
    if not screens:
        return ""
    first = screens[0]
    kept = KEPT.get(first.decision, f"decided “{messages.shorten(first.decision, 20)}” on time")
    text = messages.shorten(f" {kept}: {reason(first)}", LONGEST_REASON)
    others = Counter(screen.decision for screen in screens if screen.decision != first.decision)
    if others:
        parts = [
            f"{messages.shorten(decision, 20)} with {messages.count(n, 'seed')}"
            for decision, n in sorted(others.items())
        ]
        text += f"; {messages.listing(parts)}"
    elif len(screens) > 1:
        text += f"; all {len(screens)} seeds agree"
    return f"{text}."


def _screens(runs: list[Record]) -> list[TimeScreen]:
    return [r.on_demand.screen for r in runs if r.on_demand and r.on_demand.screen]


def _comparison_words(runs: list[Record]) -> str:
    """Say which model was best on val in the first run that compared models, and which other runs chose."""
    found = [r.on_demand.comparison for r in runs if r.on_demand and r.on_demand.comparison]
    if not found:
        return ""
    text = messages.shorten(of_comparison(found[0]), LONGEST_REASON)
    others = Counter(one.chosen for one in found[1:] if one.chosen != found[0].chosen)
    parts = [f"{messages.shorten(name, 20)} with {messages.count(n, 'seed')}" for name, n in sorted(others.items())]
    return f"{text}; {messages.listing(parts)}." if parts else f"{text}."


def _gate_words(one: Decided) -> list[str]:
    """Say which effects (time, view direction, the network AGR) Gaussians keep, and what removing the others changed.

    The text gives the change of PSNR and of the milliseconds per frame.
    """
    if not one.gated:
        return ["No Gaussian was changed."]
    kept = [f"{one.rows[name]:,.0f} {said}" for name, said in EFFECT_SETS.items() if one.rows[name] >= 0.5]
    share = f" ({100 * one.left / one.before:.0f} %)" if one.before else ""
    where = "" if one.gated == len(one.runs) else f" with {one.gated} of {len(one.runs)} seeds"
    text = f"The gates left {one.left:,.0f} of {one.before:,.0f} Gaussians{share}{where}"
    said = [f"{text}: {messages.listing(kept)}." if kept else f"{text}."]
    if one.asleep > 0:
        moves = 100 * (1 - one.asleep)
        said.append(f"AGR moves {moves:.0f} % of its Gaussians in a frame; the others are invisible at its time.")
    if one.psnr.scenes:
        text = f"The gate after training changed PSNR on {messages.shorten(one.views, 40)} by "
        text += _change(one.psnr, "dB", 3)
        if one.ms.scenes:
            text += f", and a frame of {messages.plain(one.ms_before)} ms by {_change(one.ms, 'ms', 2)}"
        said.append(f"{text}.")
    return said


def _change(of: Estimate, unit: str, digits: int) -> str:
    """Format the change of a value, with its interval if there is one."""
    interval = messages.interval(of, digits, sign=True)
    return f"{messages.signed(of.mean, digits)} {unit}{messages.in_brackets(interval)}"


def _notes(found: list[Decided], gated: int) -> list[str]:
    """List notes on removing time, direction and AGR (a network): open decisions, and what the numbers leave out.

    Equal notes of several seeds are merged.
    """
    named: dict[str, list[int]] = {}
    for one in found:
        for run in one.runs:
            for note in run.on_demand.notes if run.on_demand else []:
                named.setdefault(f"{one.scene}, {one.name}, §: {messages.shorten(note)}", []).append(run.seed)
    notes = []
    for text, seeds in named.items():
        which = f"seed{'' if len(seeds) == 1 else 's'} {messages.listing([str(seed) for seed in seeds[:5]])}"
        notes.append(text.replace("§", which, 1))
    more = [f"and {len(notes) - MOST_NOTES} more notes."] if len(notes) > MOST_NOTES else []
    if gated > MOST_BARS:
        more.append(f"The figures have {MOST_BARS} of {gated} rows; the table has all.")
    gates = [g for one in found for r in one.runs for g in (r.on_demand.gates if r.on_demand else [])]
    if any(gate.step is not None for gate in gates):
        more.append(IN_TRAINING)
    return notes[:MOST_NOTES] + more


# ---- figures


def _drawings(gated: list[Decided], canvas: Canvas) -> list[PageFigure]:
    """Draw two stacked bars for each scene and model: Gaussians by the effects that they keep, and by SH degree.

    The effects are time, view direction and the network AGR.
    """
    label = lambda one: messages.shorten_middle(f"{one.scene}, {one.name}", LONGEST_LABEL, LABEL_END)  # noqa: E731
    effect_sets = [
        charts.Bar(label(one), _shares([one.rows[name] for name in NAMES]), f"{one.left:,.0f} of {one.before:,.0f}")
        for one in gated
    ]
    degrees = [charts.Bar(label(one), _shares(one.degrees), f"mean degree {_mean_degree(one)}") for one in gated]
    colours = [model_colour(MODELS.index(EFFECT_SET_LIKE[name])) for name in EFFECT_SETS]
    whose = messages.listing([bar.label for bar in effect_sets])
    drawn = (
        ("Gaussians before the gates, by effect set", "k", effect_sets, [*colours, LINE]),
        ("Gaussians left, by degree of harmonics", "d", degrees, [stage_colour(_stage(i)) for i in range(DEGREES)]),
    )
    return [
        PageFigure(title, charts.bars(bars, hues, "%"), f"{canvas.name}o{key}", f"{title}: {whose}")
        for title, key, bars, hues in drawn
    ]


def _stage(degree: int) -> int:
    """Return the colour number of an SH degree; higher degrees have a stronger contrast with the background."""
    return DEGREES - 1 - degree


def _shares(values: list[float]) -> list[float]:
    """Return values as percentages of their sum."""
    total = sum(values)
    return [100 * value / total if total else 0.0 for value in values]


def _mean_degree(one: Decided) -> str:
    total = sum(one.degrees)
    return messages.plain(sum(i * n for i, n in enumerate(one.degrees)) / total if total else math.nan, 1)


def _swatches() -> list[Swatch]:
    """Return the colour legend: what Gaussians depend on, such as "static", and the degrees of their SH."""
    effect_sets = [Swatch(said, f"model-{MODELS.index(EFFECT_SET_LIKE[name])}") for name, said in EFFECT_SETS.items()]
    degrees = [Swatch(f"degree {i}", f"stage-{_stage(i)}") for i in range(DEGREES)]
    return [*effect_sets, Swatch(NAMES[REMOVED], "line"), *degrees]


def _images(found: list[Decided], folder: Path) -> list[Image]:
    """Return images in which the colour of a Gaussian shows whether it depends on time, direction or AGR (a network).

    There is one image for each scene and model, from the first seed that has one.
    """
    places = gallery.places(folder, OLD_PICTURE) | gallery.places(folder, PICTURE)
    paths = [next((p for r in one.runs if (p := places.get(r.path))), None) for one in found]
    captions = [f"{one.scene}, {one.name}" for one in found]
    return gallery.images([(c, path) for c, path in zip(captions, paths, strict=True) if path])


# ---- numbers


def _table(found: list[Decided], machine: str) -> DataTable:
    columns = [Column("scene"), Column("model"), Column("variant"), Column("seeds"), Column("time")]
    columns += [Column("largest p", 3), Column("% free of the camera", 0), Column("screen s", 1), Column("seeds gated")]
    columns += [Column("Gaussians before", 0), *(Column(said, 0) for said in NAMES.values())]
    columns += [Column(f"degree {i}", 0) for i in range(DEGREES)] + [Column("% of AGR left out of a frame", 0)]
    columns += [Column("predicted dB", 3), Column("PSNR measured on"), Column("PSNR dB", 3), Column("95 % low", 3)]
    columns += [Column("95 % high", 3), Column("ms a frame before", 2), Column("change in ms", 2), Column("low", 2)]
    columns += [Column("high", 2), Column("MB before", 2), Column("MB", 2)]
    return DataTable("effects_on_demand.csv", columns, [_row(one, machine) for one in found])


def _row(one: Decided, machine: str) -> list[Value]:
    screens = _screens(one.runs)
    seconds = [screen.seconds for screen in _screens([r for r in one.runs if r.provenance.machine == machine])]
    decisions = Counter(screen.decision for screen in screens)
    p = [screen.p for screen in screens if screen.p is not None]
    free = [100 * screen.free for screen in screens if screen.free is not None]
    rows = [one.rows[name] for name in NAMES] if one.gated else [math.nan] * len(NAMES)
    return [
        one.scene,
        one.configuration.model,
        one.configuration.variant or "none",
        len(one.runs),
        ", ".join(f"{decision} {n}" for decision, n in sorted(decisions.items())) or "not asked",
        max(p, default=math.nan),
        fmean(free) if free else math.nan,
        fmean(seconds) if seconds else math.nan,
        one.gated,
        one.before if one.gated else math.nan,
        *rows,
        *(one.degrees or [math.nan] * DEGREES),
        100 * one.asleep,
        one.predicted,
        one.views or None,
        *(one.psnr.mean, one.psnr.low, one.psnr.high),
        *(one.ms_before, one.ms.mean, one.ms.low, one.ms.high),
        one.mb_before,
        one.mb,
    ]
