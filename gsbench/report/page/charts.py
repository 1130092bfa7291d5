"""Draw the figures of the HTML report; each kind of figure has a function that takes numbers and returns a drawing."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullLocator

from gsbench.report.page.palette import Style
from gsbench.report.page.svg import INK, LANE, MUTED, PAPER, Panel, model_colour, stage_colour

LOG_FROM = 5.0  # an axis is logarithmic if its largest value is this many times its smallest
SOLID = ("s", "o", "D", "X", "p", "d", "8", "H")  # markers that look large for their area
ROW = 38  # height in pixels of a row with its label above it
NAME = 10  # font size of the names beside the rows of events


@dataclass(frozen=True)
class Mark:
    """A point of a figure, with a confidence interval along y and its run's number in the report's list of runs."""

    x: float
    y: float
    run: int  # the number of its run in the list of runs of the report
    low: float = math.nan
    high: float = math.nan


@dataclass(frozen=True)
class FrontierCurve:
    """The points of one model in a figure of PSNR against cost."""

    style: Style
    best: Sequence[Mark]  # the Pareto frontier, joined by a line
    beaten: Sequence[Mark] = ()  # means that are not on the model's Pareto frontier
    runs: Sequence[Mark] = ()  # the single runs behind the means
    paper: Sequence[Mark] = ()  # the paper's own numbers, on other hardware


def frontier(curves: list[FrontierCurve], x: str, y: str = "PSNR, dB") -> Panel:
    """Draw PSNR against a cost for several models.

    Means are drawn with their intervals, and a line joins the means on the Pareto frontier of each model. Single runs
    are pale points.
    """
    panel = Panel(270)
    axes = panel.axes
    across: list[float] = []
    for curve in curves:
        colour = model_colour(curve.style.colour)
        if len(curve.best) > 1:
            xs, ys = [m.x for m in curve.best], [m.y for m in curve.best]
            axes.plot(xs, ys, color=colour, linewidth=1.4, alpha=0.75)
            if not any(math.isnan(m.low) for m in curve.best):
                low, high = [m.low for m in curve.best], [m.high for m in curve.best]
                axes.fill_between(xs, low, high, color=colour, alpha=0.12, linewidth=0)
        _dots(axes, curve.runs, curve.style, 9, alpha=0.45, linewidths=0)
        for mark in (*curve.best, *curve.beaten):
            if mark.high > mark.low:
                axes.plot([mark.x] * 2, [mark.low, mark.high], color=colour, linewidth=1.4)
        _dots(axes, curve.beaten, curve.style, 36, facecolors=PAPER, edgecolors=colour, linewidths=1.3)
        _dots(axes, curve.best, curve.style, 56, linewidths=0)
        if curve.paper:
            axes.scatter([m.x for m in curve.paper], [m.y for m in curve.paper], s=34, c=colour, marker="x")
        every = (*curve.runs, *curve.paper, *curve.beaten, *curve.best)
        panel.hits += [(m.x, m.y, m.run, curve.style.colour) for m in every]
        across += [m.x for m in every]
    _scale_x(axes, across)
    _margin_y(axes)
    panel.labels(x, y)
    return panel


def _dots(axes: Axes, marks: Sequence[Mark], style: Style, size: float, **how: Any) -> None:
    """Draw a model's marker at each point; marker shapes with a small area are drawn larger."""
    area = size * (1.0 if style.marker in SOLID else 1.3)
    colour: dict[str, Any] = {} if "facecolors" in how else {"c": model_colour(style.colour)}
    axes.scatter([m.x for m in marks], [m.y for m in marks], s=area, marker=style.marker, **colour, **how)


@dataclass(frozen=True)
class Anytime:
    """The PSNR of a run during its training, or the mean PSNR over seeds."""

    name: str  # of the model, short enough for the space beside the axes
    style: Style
    seconds: Sequence[float]
    psnr: Sequence[float]
    run: int
    events: Sequence[tuple[float, str]] = ()  # seconds and letter


def anytime(curves: list[Anytime]) -> Panel:
    """Draw PSNR on the validation views against training seconds; a named row for each model shows training events."""
    beside = 12 + round(0.62 * NAME * max(len(curve.name) for curve in curves))
    panel = Panel(290 + LANE * len(curves), left=max(38, beside), lanes=len(curves))
    axes = panel.axes
    for lane, curve in enumerate(curves):
        colour, y = model_colour(curve.style.colour), len(curves) - lane - 0.5
        axes.plot(curve.seconds, curve.psnr, color=colour, linewidth=1.5)
        panel.below.plot([0, curve.seconds[-1]], [y, y], color=colour, linewidth=1)
        place: dict[str, Any] = {"xycoords": ("axes fraction", "data"), "xytext": (-6, 0), "ha": "right"}
        place |= {"textcoords": "offset points", "va": "center_baseline", "fontsize": NAME}
        panel.below.annotate(curve.name, (0, y), color=colour, **place)
        for seconds, letter in curve.events:
            box = {"facecolor": PAPER, "edgecolor": "none", "pad": 0.8}
            style: dict[str, Any] = {"ha": "center", "va": "center_baseline", "fontsize": 10, "color": INK, "bbox": box}
            panel.below.text(seconds, y, letter, **style)
        _dots(axes, [Mark(curve.seconds[-1], curve.psnr[-1], curve.run)], curve.style, 44, linewidths=0)
        panel.hits += [(s, p, curve.run, curve.style.colour) for s, p in zip(curve.seconds, curve.psnr, strict=True)]
    axes.set_xlim(left=0)
    _margin_y(axes)
    axes.xaxis.set_major_locator(_ticks(6))
    axes.xaxis.set_major_formatter(FuncFormatter(_plain))
    panel.labels("training seconds", "PSNR on val, dB")
    return panel


def profile(ratios: dict[str, tuple[Style, Sequence[float]]], problems: int) -> Panel:
    """Draw performance profiles: the share of PSNR targets that a model reaches within a factor of the fastest time."""
    panel = Panel(270)
    axes = panel.axes
    finite = [r for _, values in ratios.values() for r in values if math.isfinite(r)]
    end = max(2.0, 1.15 * max(finite, default=1.0))
    for style, values in ratios.values():
        reached = [r for r in values if math.isfinite(r)]
        xs = [1.0, *reached, end]
        ys = [sum(r <= x for r in reached) / problems for x in xs]
        axes.step(xs, ys, where="post", color=model_colour(style.colour), linewidth=1.5)
        _dots(axes, [Mark(xs[-1], ys[-1], 0)], style, 44, linewidths=0, clip_on=False)
    axes.set_xlim(1 - 0.02 * (end - 1), end)
    axes.set_ylim(-0.03, 1.05)
    axes.yaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{100 * v:.0f}"))
    axes.xaxis.set_major_locator(_ticks(6))
    panel.labels("times the fastest model's seconds", f"% of {problems} targets reached")
    return panel


@dataclass(frozen=True)
class Difference:
    """A difference between models with its interval and its label, to be drawn in a figure."""

    label: str
    mean: float
    low: float
    high: float
    strong: bool  # whether it is significant; it is then drawn filled
    note: str = ""


def differences(rows: list[Difference], x: str) -> Panel:
    """Draw differences and their intervals on an axis that contains zero, with a label above each difference."""
    panel = Panel(66 + ROW * len(rows), left=2, top=4)
    axes = panel.axes
    for i, row in enumerate(rows):
        y = len(rows) - i - 0.72
        if not math.isnan(row.low):
            axes.plot([row.low, row.high], [y, y], color=INK, linewidth=1.5, solid_capstyle="butt")
        fill = INK if row.strong else PAPER
        axes.scatter([row.mean], [y], s=30, facecolors=fill, edgecolors=INK, linewidths=1.3, zorder=3)
        panel.above(len(rows) - i - 0.08, row.label, row.note)
    axes.axvline(0, color=MUTED, linewidth=1)
    axes.set_ylim(0, len(rows))
    axes.yaxis.set_major_locator(NullLocator())
    shown = [v for r in rows for v in (0.0, r.mean, r.low, r.high) if not math.isnan(v)]
    spread = (max(shown) - min(shown)) or 1.0
    axes.set_xlim(min(shown) - 0.06 * spread, max(shown) + 0.06 * spread)
    axes.xaxis.set_major_locator(_ticks(5))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:+g}".replace("-", "−") if abs(v) > 1e-9 else "0"))
    panel.labels(x)
    return panel


@dataclass(frozen=True)
class Bar:
    """A stacked bar of a figure: its label, the sizes of its parts from left to right, and a note."""

    label: str
    parts: Sequence[float]
    note: str


def bars(rows: list[Bar], colours: list[str], x: str) -> Panel:
    """Draw stacked bars with a label above each bar; `colours` has one colour for each part of a bar."""
    panel = Panel(66 + ROW * len(rows), left=2, top=4)
    axes = panel.axes
    for i, row in enumerate(rows):
        y, start = len(rows) - i - 0.66, 0.0
        for part, colour in zip(row.parts, colours, strict=True):
            axes.barh([y], [part], 0.42, [start], color=colour, edgecolor=PAPER, linewidth=0.8)
            start += part
        panel.above(len(rows) - i - 0.06, row.label, row.note)
    axes.set_xlim(0, max(sum(row.parts) for row in rows) or 1.0)
    axes.set_ylim(0, len(rows))
    axes.yaxis.set_major_locator(NullLocator())
    axes.xaxis.set_major_locator(_ticks(6))
    panel.labels(x)
    return panel


def stages(rows: list[tuple[str, dict[str, float]]], names: list[str], colours: list[int]) -> Panel:
    """Draw a stacked bar of training seconds for each model, with one coloured part for each stage of training."""
    found = []
    for label, parts in rows:
        total = sum(parts.values())
        note = f"{total:,.0f} s" if total >= 100 else f"{total:#.3g} s"
        found.append(Bar(label, [parts.get(name, 0.0) for name in names], note))
    return bars(found, [stage_colour(i) for i in colours], "training seconds")


def _scale_x(axes: Axes, values: Sequence[float]) -> None:
    """Set the scale, the ticks and the margins of the x axis; the scale is logarithmic if the values differ much."""
    low, high = (min(values), max(values)) if values else (0.0, 1.0)
    if low > 0 and high / low > LOG_FROM:
        axes.set_xscale("log")
        room = (high / low) ** 0.07
        axes.set_xlim(low / room, high * room)
        axes.xaxis.set_major_locator(FixedLocator(_round_ticks(low / room, high * room)))
        axes.xaxis.set_minor_locator(NullLocator())
    else:
        room = 0.08 * ((high - low) or high or 1.0)
        axes.set_xlim(max(0.0, low - room), high + room)
        axes.xaxis.set_major_locator(_ticks(5))
    axes.xaxis.set_major_formatter(FuncFormatter(_plain))


def _round_ticks(low: float, high: float) -> list[float]:
    """Return at most seven round numbers in a range, which are evenly spread on a logarithmic axis."""
    for digits in ((1, 2, 5), (1, 3), (1,)):
        first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
        ticks = [d * 10.0**e for e in range(first, last + 1) for d in digits]
        ticks = [t for t in ticks if low <= t <= high]
        if len(ticks) <= 7:
            return ticks
    return ticks[:: math.ceil(len(ticks) / 7)]


def _margin_y(axes: Axes) -> None:
    axes.margins(y=0.08)
    axes.yaxis.set_major_locator(_ticks(6))


def _ticks(most: int) -> MaxNLocator:
    return MaxNLocator(most, steps=[1, 2, 2.5, 5, 10])


def _plain(value: float, _: object) -> str:
    """Format the number at an axis tick without powers of ten."""
    return f"{value:,.0f}" if value >= 1000 else f"{value:g}"
