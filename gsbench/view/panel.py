"""Write the HTML of the viewer's panel: milliseconds by stage, colour legend, and errors against a training view."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import jinja2
import numpy as np

from gsbench.gates.messages import EFFECT_SETS
from gsbench.gates.picture import COLOURS
from gsbench.measure.images import ERROR_SCALE, ROUNDING_SCALE, data_url, inferno
from gsbench.view.controls import ShownImage
from gsbench.view.frame import CLASS, COST, FLOAT32, STAGES, Float32Error, FrameCost
from gsbench.view.training_views import Nearest, ViewComparison

STOPS = 9  # of a gradient
FOLLOWS = "this is the image; its bound follows when nothing moves"
_FLOAT32_ROWS: dict[str, Callable[[Float32Error], str]] = {
    "largest bound": lambda error: f"{error.largest:.2g}",
    "median bound": lambda error: f"{error.median:.2g}",
    "undecided pixels": lambda error: f"{100 * error.undecided:.2g} %",
    "pixels": lambda error: f"{error.image.shape[1]} x {error.image.shape[0]}",
    "seconds": lambda error: f"{error.seconds:.1f}",
}
_BLOCKS = """\
{% macro gradient(low, high) %}<div style="display:flex;gap:0.5em;align-items:center">{{ low }}
<span style="flex:1;height:0.8em;background:linear-gradient(to right,{{ stops }})"></span>{{ high }}</div>{% endmacro %}
{% macro table(rows) %}<table style="width:100%;border-collapse:collapse;table-layout:fixed">
{% for row in rows %}<tr style="font-weight:{{ 600 if row.is_bold else 400 }}">
<td style="padding-left:{{ row.indent }}em">
{%- if row.swatch %}<span style="display:inline-block;width:0.8em;height:0.8em;background-color:rgb{{ row.swatch }}">
</span> {% endif %}{{ row.label }}</td>
{% for cell in row.cells %}<td style="text-align:right;padding:0 0 0 0.5em;vertical-align:bottom">{{ cell }}</td>
{% endfor %}</tr>{% endfor %}</table>{% endmacro %}
{% macro box() %}<div style="margin:0 1em 0.5em;font-size:0.75em;line-height:1.35;overflow-wrap:anywhere">
{{ caller() }}</div>{% endmacro %}
"""
_COSTS = "{% call box() %}{{ table(rows) }}<div>at {{ width }} x {{ height }}</div>{% endcall %}"
_LEGEND = """\
{% if classes %}{% call box() %}{{ table(classes) }}{% endcall %}{% endif %}
{% if cost_ns %}{% call box() %}What the Gaussians that a pixel shows add to a frame before they are drawn, each
{{ gradient(0, cost_ns) }}{% endcall %}{% endif %}
{% if float32 %}{% call box() %}Bound on the error of float32, in steps of 8 bits, log scale: no channel of the image is
farther from the image in float64{{ gradient(*float32) }}{% if bounds %}{{ table(bounds) }}{% endif %}
{% for name, reason in reasons.items() %}<div><b>{{ name }}</b>: {{ reason }}</div>{% endfor %}{% endcall %}{% endif %}
"""
_COMPARISON = """\
{% call box() %}<b>{{ view.name }}</b>{% if view.time is not none %}, time {{ "%.2f" % view.time }}{% endif %}
: {{ away }}
{% for one in compared %}<div style="display:flex;gap:4px;margin-top:4px">
{% for image, caption in (one.truth, "training image"), (one.render, one.name), (one.error, "%.2f dB" % one.psnr) %}
<figure style="flex:1;margin:0;min-width:0">
<img src="{{ url(image) }}" style="width:100%;display:block;image-rendering:pixelated">
<figcaption>{{ caption }}</figcaption></figure>{% endfor %}</div>{% endfor %}
<div>absolute error, mean of RGB</div>{{ gradient(0, scale) }}{% endcall %}
"""
_PAGES = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True)
_PAGES.globals["stops"] = ",".join(
    f"rgb{tuple(color)}" for color in inferno(np.linspace(0, 1, STOPS)[None])[0].tolist()
)
_PAGES.globals["url"] = data_url
_COSTS_PAGE, _LEGEND_PAGE, _COMPARISON_PAGE = (
    _PAGES.from_string(_BLOCKS + text) for text in (_COSTS, _LEGEND, _COMPARISON)
)


class Row(NamedTuple):
    """A row of a table: a label, and a cell for each model."""

    label: str
    cells: Sequence[str]
    is_bold: bool = False
    indent: int = 0  # em
    swatch: tuple[int, int, int] | None = None  # RGB of a square before the label


def cost_table(costs: Sequence[FrameCost], width: int, height: int) -> str:
    """Return a table in HTML of a frame's milliseconds: a column for each model, the stages by part, and the FPS."""
    rows = [Row("ms", [cost.name for cost in costs], is_bold=True)]
    for part, stages in STAGES.items():
        rows.append(Row(part, [f"{cost.of(part):.1f}" for cost in costs], is_bold=True))
        rows += [
            Row(stage, [f"{cost.ms[stage]:.1f}" if stage in cost.ms else "" for cost in costs], indent=1)
            for stage in stages
            if any(stage in cost.ms for cost in costs)
        ]
    rows.append(Row("FPS", [f"{1000 / sum(cost.ms.values()):.0f}" for cost in costs], is_bold=True))
    return _COSTS_PAGE.render(rows=rows, width=width, height=height)


def legend(
    shown: Sequence[ShownImage],
    most_cost: float,  # ns that the most expensive Gaussian adds to a frame; it has the brightest colour
    notes: Mapping[str, Float32Error | str],  # by model: the bound on the error of float32, or why it is not shown
) -> str:
    """Return the legend of the colours in HTML; "" if Gaussians have their usual colours."""
    renderers = {
        meaning: {image.renderer.name: image.renderer for image in shown if image.colours == meaning}
        for meaning in (CLASS, COST, FLOAT32)
    }
    classes = [Row("Gaussians", list(renderers[CLASS]), is_bold=True)] if renderers[CLASS] else []
    for name, words in EFFECT_SETS.items():
        counts = [renderer.counts[name] for renderer in renderers[CLASS].values()]
        if any(counts):
            classes.append(Row(words, [f"{count:,}" for count in counts], swatch=COLOURS[name]))
    errors = {name: notes.get(name, FOLLOWS) for name in renderers[FLOAT32]}
    bounds = {name: error for name, error in errors.items() if isinstance(error, Float32Error)}
    rows = [Row(label, [cell(error) for error in bounds.values()]) for label, cell in _FLOAT32_ROWS.items()]
    return _LEGEND_PAGE.render(
        classes=classes,
        cost_ns=f"{most_cost:.0f} ns" if renderers[COST] else None,
        float32=(f"{ROUNDING_SCALE[0]:g}", f"{ROUNDING_SCALE[1]:g} or more") if errors else None,
        bounds=[Row("", list(bounds), is_bold=True), *rows] if bounds else None,
        reasons={name: error for name, error in errors.items() if isinstance(error, str)},
    ).strip()


def comparison(nearest: Nearest, compared: Sequence[ViewComparison]) -> str:
    """Return the HTML that shows a training view, the models' renders of this view, and their errors."""
    away = f"{nearest.distance:.2f} world units and {nearest.degrees:.0f}° from here"
    return _COMPARISON_PAGE.render(view=nearest.view, compared=compared, away=away, scale=f"{ERROR_SCALE} or more")
