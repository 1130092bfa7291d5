"""Write the HTML of the viewer's panel: milliseconds by stage, colour legend, and errors against a training view."""

import html
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import numpy.typing as npt

from gsbench.effects.messages import EFFECT_SETS
from gsbench.effects.picture import COLOURS
from gsbench.measure.images import ERROR_SCALE, ROUNDING_SCALE, data_url, inferno
from gsbench.view.controls import ShownImage
from gsbench.view.frame import CLASS, COST, FLOAT32, FrameCost
from gsbench.view.nearest import Nearest, ViewComparison
from gsbench.view.rounding import Rounding
from gsbench.view.stages import STAGES

STOPS = 9  # of a gradient
WAITS = "the bound is computed when nothing moves"
_ROUNDING_ROWS: dict[str, Callable[[Rounding], str]] = {
    "largest bound": lambda one: f"{one.largest:.2g}",
    "median bound": lambda one: f"{one.median:.2g}",
    "undecided pixels": lambda one: f"{100 * one.undecided:.2g} %",
    "pixels": lambda one: f"{one.image.shape[1]} x {one.image.shape[0]}",
    "seconds": lambda one: f"{one.seconds:.1f}",
}
_STYLE = "width:100%;border-collapse:collapse;table-layout:fixed"
_NUMBER = "text-align:right;padding:0 0 0 0.5em;vertical-align:bottom"
_SWATCH = "display:inline-block;width:0.8em;height:0.8em"
_BOX = "margin:0 1em 0.5em;font-size:0.75em;line-height:1.35;overflow-wrap:anywhere"


def cost_table(costs: Sequence[FrameCost], width: int, height: int) -> str:
    """Write an HTML table of a frame's milliseconds: a column for each model, a row for each stage, and the FPS."""
    rows = [_row("ms", [cost.name for cost in costs], bold=True)]
    for part, stages in STAGES.items():
        rows.append(_row(part, [f"{cost.of(part):.1f}" for cost in costs], bold=True))
        there = [stage for stage in stages if any(stage in cost.ms for cost in costs)]
        rows += [_row(stage, [_ms(cost, stage) for cost in costs], inside=True) for stage in there]
    rows.append(_row("FPS", [f"{1000 / sum(cost.ms.values()):.0f}" for cost in costs], bold=True))
    return _box(_table(rows) + f"<div>at {width} x {height}</div>")


def legend(shown: Sequence[ShownImage], most_cost: float, rounding: Mapping[str, Rounding | str]) -> str:
    """Write the legend of the colours; "" for the Gaussians' own.

    Args:
        shown: the images on the screen.
        most_cost: the nanoseconds that the most expensive Gaussian adds to a frame; it has the brightest colour.
        rounding: the bound on the error of float32 by the name of the model, or why it is not shown.
    """
    text = ""
    if by_effect_set := {renderer.name: renderer.counts for renderer, colours in shown if colours == CLASS}:
        rows = [_row("Gaussians", list(by_effect_set), bold=True)]
        for name, words in EFFECT_SETS.items():
            counts = [counts[name] for counts in by_effect_set.values()]
            if any(counts):
                swatch = f'<span style="{_SWATCH};background-color:rgb{COLOURS[name]}"></span> {words}'
                rows.append(_row(swatch, [f"{number:,}" for number in counts], escaped=True))
        text += _box(_table(rows))
    if any(colours == COST for _, colours in shown):
        text += _box(f"What the Gaussians that a pixel shows add to a frame before they are drawn, each"
                     f"{_gradient('0', f'{most_cost:.0f} ns')}")  # fmt: skip
    if names := list(dict.fromkeys(renderer.name for renderer, colours in shown if colours == FLOAT32)):
        text += _box(_rounding({name: rounding.get(name, WAITS) for name in names}))
    return text


def _rounding(found: Mapping[str, Rounding | str]) -> str:
    """Write the legend of the bound on the error of float32, with a summary for each model or why there is none."""
    low, high = (f"{end:g}" for end in ROUNDING_SCALE)
    text = (f"Bound on the error of float32, in steps of 8 bits, log scale: no channel of the image is farther from "
            f"the image in float64{_gradient(low, f'{high} or more')}")  # fmt: skip
    if known := {name: one for name, one in found.items() if isinstance(one, Rounding)}:
        rows = [_row("", list(known), bold=True)]
        rows += [_row(label, [cell(one) for one in known.values()]) for label, cell in _ROUNDING_ROWS.items()]
        text += _table(rows)
    return text + "".join(
        f"<div><b>{html.escape(name)}</b>: {html.escape(one)}</div>"
        for name, one in found.items()
        if isinstance(one, str)
    )


def comparison(nearest: Nearest, compared: Sequence[ViewComparison]) -> str:
    """Write the HTML that shows a training view, the models' renders of this view, and their errors."""
    view = nearest.view
    when = "" if view.time is None else f", time {view.time:.2f}"
    away = f"{nearest.distance:.2f} world units and {nearest.degrees:.0f}° from here"
    text = f"<b>{html.escape(view.name)}</b>{when}: {away}"
    for one in compared:
        pictures = {"training image": one.truth, html.escape(one.name): one.render, f"{one.psnr:.2f} dB": one.error}
        cells = "".join(f'<figure style="flex:1;margin:0;min-width:0">{_image(image)}<figcaption>{caption}</figcaption>'
                        f"</figure>" for caption, image in pictures.items())  # fmt: skip
        text += f'<div style="display:flex;gap:4px;margin-top:4px">{cells}</div>'
    return _box(f"{text}<div>absolute error, mean of RGB</div>{_gradient('0', f'{ERROR_SCALE} or more')}")


def _ms(cost: FrameCost, stage: str) -> str:
    return f"{cost.ms[stage]:.1f}" if stage in cost.ms else ""


def _row(label: str, values: Sequence[str], *, bold: bool = False, inside: bool = False, escaped: bool = False) -> str:
    """Write a row of an HTML table: a label, and then a number for each model."""
    weight = "font-weight:600;" if bold else ""
    indent = "padding-left:1em;" if inside else ""
    cells = "".join(f'<td style="{_NUMBER}">{html.escape(value)}</td>' for value in values)
    return f'<tr style="{weight}"><td style="{indent}">{label if escaped else html.escape(label)}</td>{cells}</tr>'


def _table(rows: Sequence[str]) -> str:
    return f'<table style="{_STYLE}">{"".join(rows)}</table>'


def _box(content: str) -> str:
    return f'<div style="{_BOX}">{content}</div>'


def _gradient(low: str, high: str) -> str:
    """Write the colour scale (inferno) in HTML, between a text for its low end and a text for its high end."""
    stops = ",".join(f"rgb{tuple(color)}" for color in inferno(np.linspace(0, 1, STOPS)[None])[0].tolist())
    bar = f'<span style="flex:1;height:0.8em;background:linear-gradient(to right,{stops})"></span>'
    return f'<div style="display:flex;gap:0.5em;align-items:center">{low}{bar}{html.escape(high)}</div>'


def _image(image: npt.NDArray[np.uint8]) -> str:
    """Embed an image as PNG in HTML at the full width of the panel; enlarged pixels stay sharp."""
    return f'<img src="{data_url(image)}" style="width:100%;display:block;image-rendering:pixelated">'
