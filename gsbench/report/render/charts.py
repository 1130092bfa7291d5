"""Draw the figures of sections: each function takes a table and returns a Vega-Lite chart, for pages and for files.

On a page, colours are variables of the style sheet, so one chart serves the light and the dark theme. A chart has the
parameters `hidden` (the models that the legend hides) and `scene`, which the script of the page sets.
"""

import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import altair as alt
import pandas as pd
from pandas.api.types import is_bool_dtype, is_float_dtype

from gsbench.measure.atomic import write_atomically
from gsbench.report.render.palette import DEGREES, MARKERS, SETS, THEMES
from gsbench.report.section import Figure, text

INK, MUTED, LINE, PAPER = (f"var(--{name})" for name in ("ink", "muted", "line", "paper"))
FONT = "system-ui, -apple-system, Segoe UI, Roboto, Helvetica Neue, Arial, sans-serif"
WIDTH = 400  # pixels of a figure in a file; on a page it has the width of its column
HEIGHT = 250
LOG_FROM = 5.0  # an axis is logarithmic if its largest value is this many times its smallest
LONGEST_NAME = 120  # letters of a file name

Look = dict[str, int]  # by series: the number of its colour and marker


def spec(
    figure: Figure, look: Look, *, scene: str = "", width: Any = "container", legend: bool = False
) -> dict[str, Any]:
    """Return the Vega-Lite JSON of a figure.

    Args:
        figure: the figure to draw.
        look: the number of the colour and marker of each series: `styles` of all series of the report.
        scene: the scene that is shown first, if the table has a column "scene"; "" for its first one.
        width: pixels, or "container".
        legend: whether the chart has a legend of its own; a page has one above its figures.
    """
    table = figure.table.copy()
    for name, column in figure.table.items():
        if not is_bool_dtype(column):
            table[name] = column.map(_rounded if is_float_dtype(column) else text)
    chart = DRAWINGS[figure.draw](table, look, **figure.options)
    if "scene" in table:
        chart = chart.add_params(alt.param("scene", value=scene or table.scene.iloc[0]))
        chart = chart.transform_filter("datum.scene == scene")
    if "series" in table:
        chart = chart.add_params(alt.param("hidden", value=[])).transform_filter("indexof(hidden, datum.series) < 0")
    axis = {
        "labelColor": MUTED,
        "titleColor": MUTED,
        "domainColor": LINE,
        "gridColor": LINE,
        "tickColor": LINE,
        "titleFontWeight": "normal",
        "labelFontSize": 12,
        "titleFontSize": 12,
        "labelLimit": 220,
        "labelSeparation": 6,  # pixels between the numbers of a logarithmic axis
    }
    shown = {"labelColor": INK, "titleColor": INK, "labelFontSize": 12} if legend else {"disable": True}
    chart = chart.configure(background="transparent", font=FONT, axis=axis, legend=shown, view={"stroke": None})
    fit = alt.AutoSizeParams(type="fit-x", contains="padding")
    described = chart.properties(description=f"{figure.caption}; the table has the numbers", width=width, autosize=fit)
    plain: dict[str, Any] = described.to_dict(validate=False)
    return plain


def _rounded(value: float) -> float | None:
    """Round a number to what a figure can show; None if it is not finite."""
    return float(f"{value:.5g}") if math.isfinite(value) else None


def write(figure: Figure, look: Look, stem: Path) -> list[Path]:
    """Write a figure as PDF and SVG for a paper, in the light theme; each scene has files of its own."""
    import vl_convert  # takes a moment

    scenes = list(dict.fromkeys(figure.table.scene)) if "scene" in figure.table else [""]
    paths = []
    for scene in scenes:
        light = in_light_theme(spec(figure, look, scene=scene, width=WIDTH, legend=True))
        name = "-".join(re.findall("[a-z0-9]+", f"{stem.name} {scene}".lower()))
        path = stem.with_name(name[:LONGEST_NAME])
        write_atomically(path.with_suffix(".svg"), vl_convert.vegalite_to_svg(light).encode())
        write_atomically(path.with_suffix(".pdf"), vl_convert.vegalite_to_pdf(light))
        paths += [path.with_suffix(".pdf"), path.with_suffix(".svg")]
    return paths


def in_light_theme(chart: dict[str, Any]) -> str:
    """Return the Vega-Lite JSON of a figure as text, with colours in place of the style sheet's variables."""
    return re.sub(r"var\(--([\w-]+)\)", lambda match: THEMES[match[1]][0], json.dumps(chart))


def frontier(table: pd.DataFrame, look: Look, x: str, title: str) -> alt.LayerChart:
    """Draw PSNR against a cost: means with intervals, a line through those on the frontier, single runs."""
    halves = table.get("psnr_db ±", pd.Series(0.0, table.index)).fillna(0.0)
    table = table.assign(best=table[f"best {x}"], low=table.psnr_db - halves, high=table.psnr_db + halves)
    table = table.dropna(subset=[x, "psnr_db"])
    names = ["scene", "series", "model", "variant", "kind", "seeds", x, "psnr_db", "low", "high", "best"]
    base = alt.Chart(table.reindex(columns=names).astype({"seeds": str}))
    at = {"x": alt.X(x, type="quantitative", title=title, scale=_scale(table[x])), "y": _y("psnr_db", "PSNR, dB")}
    colour, shape = _colour(table, look), _shape(table, look)
    tip = _tip(model="model", variant="variant", psnr_db="PSNR, dB", **{x: title}, seeds="seeds")
    means = base.transform_filter("datum.kind == 'mean'")
    line = means.transform_filter("datum.best").mark_line(opacity=0.7, aria=False).encode(**at, color=colour)
    bars = means.mark_rule(aria=False).encode(at["x"], alt.Y("low:Q"), alt.Y2("high:Q"), colour)
    runs = base.transform_filter("datum.kind == 'run'").mark_point(size=10, filled=True, opacity=0.45, aria=False)
    hue = alt.Fill("series:N", title=None, scale=_hues(table, look))
    stroke = alt.Stroke("series:N", title=None, scale=_hues(table, look))
    fill = alt.when("datum.best").then(hue).otherwise(alt.value(PAPER))
    dots = means.mark_point(size=80, opacity=1, strokeWidth=1.3)
    return alt.layer(
        line,
        bars,
        runs.encode(**at, color=colour, shape=shape, tooltip=tip),
        dots.encode(**at, fill=fill, stroke=stroke, shape=shape, tooltip=tip),
    ).properties(height=HEIGHT)


def curves(table: pd.DataFrame, look: Look) -> alt.LayerChart:
    """Draw PSNR on val against training seconds."""
    base = alt.Chart(table[["scene", "series", "iteration", "train_s", "psnr_val_db"]])
    at = {"x": alt.X("train_s:Q", title="training seconds"), "y": _y("psnr_val_db", "PSNR on val, dB")}
    at["color"] = _colour(table, look)
    tip = _tip(series="model", iteration="iteration", train_s="training s", psnr_val_db="PSNR val, dB")
    return alt.layer(
        base.mark_line(strokeWidth=1.5, aria=False).encode(**at),
        base.mark_point(size=14, filled=True).encode(**at, shape=_shape(table, look), tooltip=tip),
    ).properties(height=1.3 * HEIGHT)


def intervals(table: pd.DataFrame, look: Look, label: str, value: str) -> alt.LayerChart:
    """Draw differences with their intervals on an axis with zero; significant ones are filled."""
    base = alt.Chart(table[[label, value, "low", "high", "significant"]].dropna(subset=[value]))
    y = alt.Y(label, type="nominal", sort=None, title=None, axis=alt.Axis(labelColor=INK, labelLimit=200))
    fill = alt.condition("datum.significant == 'yes'", alt.value(INK), alt.value(PAPER))
    tip = _tip(**{label: label, value: value, "low": "95 % low", "high": "high", "significant": "significant"})
    x = alt.X(value, type="quantitative", title=value)
    zero = alt.Chart(pd.DataFrame({"zero": [0]})).mark_rule(color=MUTED, aria=False).encode(x="zero:Q")
    bars = base.mark_rule(color=INK, aria=False).encode(alt.X("low:Q", title=value), alt.X2("high:Q"), y)
    dots = base.mark_point(size=45, opacity=1, strokeWidth=1.3).encode(
        x, y, fill=fill, stroke=alt.value(INK), tooltip=tip
    )
    return alt.layer(zero, bars, dots).properties(height=20 * len(table))


def bars(table: pd.DataFrame, look: Look, label: str, parts: list[str], title: str, colours: str) -> alt.Chart:
    """Draw a stacked bar for each label; `colours` is "stage", "effect set" or "degree"."""
    hues = part_colours(parts, colours)
    colour = alt.Color(
        "part:N", title=None, sort=parts, scale=alt.Scale(domain=parts, range=[f"var(--{hue})" for hue in hues])
    )
    ordered = table.assign(order=table.part.map(parts.index))
    y = alt.Y(label, type="nominal", sort=None, title=None, axis=alt.Axis(labelColor=INK, labelLimit=200))
    x = alt.X("size:Q", title=title, stack="zero")
    tip = _tip(**{label: label, "part": "part", "size": title})
    mark = alt.Chart(ordered).mark_bar(stroke=PAPER, strokeWidth=0.8)
    return mark.encode(x, y, colour, order="order:Q", tooltip=tip).properties(height=24 * table[label].nunique())


DRAWINGS: dict[str, Callable[..., Any]] = {
    "frontier": frontier,
    "curves": curves,
    "intervals": intervals,
    "bars": bars,
}


def part_colours(parts: list[str], colours: str) -> list[str]:
    """Return the variables of the style sheet that hold the colours of the parts of bars."""
    from gsbench.report.sections.stages import REST, STAGES

    if colours == "stage":
        return [f"stage-{(*STAGES, REST).index(part)}" for part in parts]
    return list(SETS if colours == "effect set" else DEGREES)[: len(parts)]


def _hues(table: pd.DataFrame, look: Look) -> alt.Scale:
    names = sorted(table.series.unique())
    return alt.Scale(domain=names, range=[f"var(--model-{look[name]})" for name in names])


def _colour(table: pd.DataFrame, look: Look) -> alt.Color:
    return alt.Color("series:N", title=None, scale=_hues(table, look))


def _shape(table: pd.DataFrame, look: Look) -> alt.Shape:
    names = sorted(table.series.unique())
    return alt.Shape("series:N", title=None, scale=alt.Scale(domain=names, range=[MARKERS[look[n]] for n in names]))


def _y(name: str, title: str) -> alt.Y:
    return alt.Y(name, type="quantitative", title=title, scale=alt.Scale(zero=False, padding=8))


def _scale(values: pd.Series) -> alt.Scale:
    is_wide = values.min() > 0 and values.max() / values.min() > LOG_FROM
    return alt.Scale(type="log", nice=False, padding=12) if is_wide else alt.Scale(zero=False, padding=12)


def _tip(**titles: str) -> list[alt.Tooltip]:
    """Return the lines of a tooltip: columns with their titles, numbers with at most four digits."""
    texts = ("series", "model", "variant", "seeds", "name", "pair", "label", "part", "significant")
    kinds = {
        name: {"type": "nominal"} if name in texts else {"type": "quantitative", "format": ",.4~g"} for name in titles
    }
    return [alt.Tooltip(name, title=title, **kinds[name]) for name, title in titles.items()]
