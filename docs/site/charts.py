"""Draw the charts of README.md and docs/results.md from the published studies.

python docs/site/charts.py
"""

import dataclasses
import math
from pathlib import Path
from typing import Any

import altair as alt
import pandas as pd
import vl_convert

from gsbench.report.blocks import DNERF_VARIANT, MODELS, only
from gsbench.report.render import charts
from gsbench.report.render.palette import styles
from gsbench.report.sections.budgets import frontier

ROOT = Path(__file__).resolve().parents[2]
PUBLISHED = ROOT / "results" / "published"
DIMENSIONS = {"3dgs": "3D", "4dgs": "4D, time", "6dgs": "6D, direction", "7dgs": "7D, both"}
NETWORKS = {  # the variant of its runs, and the end of the label of each model
    "none": (DNERF_VARIANT, ["", "", "", "_noagr"]),
    "AGR: 1 layer of 64": (DNERF_VARIANT, ["_agr", "_agr", "_agr", ""]),
    "4 layers of 64": (f"ablation=deep_agr_encoded,{DNERF_VARIANT}", ["_agr", "_agr", "_agr", ""]),
}


def draw_frontier() -> None:
    """Draw PSNR on test against seconds of training, means over scenes, of the runs that differ only in length."""
    section = frontier(only(PUBLISHED, "frontier"), pd.DataFrame())
    assert section is not None
    figure = section.figures[0]
    of = figure.table
    kept = of.scene.str.startswith("mean") & of.model.isin(MODELS) & of.variant.str.fullmatch(r"(iterations=\d+)?")
    figure = dataclasses.replace(figure, table=of[kept])
    write(charts.spec(figure, styles(MODELS), width=620, legend=True), "frontier")


def draw_networks() -> None:
    """Draw PSNR of Gaussians of each kind with each network, means over scenes and seeds of D-NeRF.

    CPU seconds are drawn for the runs of `dnerf100`; those of `networks` were trained on another machine.
    """
    here, deeper = (only(PUBLISHED, name).runs for name in ("dnerf100", "networks"))
    deeper = deeper[deeper.variant.str.startswith("ablation=")].assign(train_cpu_s=math.nan)
    runs = pd.concat([here, deeper])
    averages = runs.groupby(["model", "variant"])[["psnr_db", "train_cpu_s"]].mean()
    cells = [
        {"network": network, "Gaussians": dimensions, **averages.loc[(model + ending, variant)]}
        for network, (variant, endings) in NETWORKS.items()
        for (model, dimensions), ending in zip(DIMENSIONS.items(), endings, strict=True)
    ]
    table = pd.DataFrame(cells)
    table["psnr"] = table.psnr_db.map("{:.2f} dB".format)
    table["seconds"] = table.train_cpu_s.map("{:.0f} s".format, na_action="ignore").fillna("")
    at = {
        "x": alt.X("Gaussians:N", title="dimensions of a Gaussian", axis=alt.Axis(orient="top", labelAngle=0)),
        "y": alt.Y("network:N", title="network that changes Gaussians", sort=list(NETWORKS)),
    }
    shade = alt.Color("psnr_db:Q", title="PSNR, dB", scale=alt.Scale(scheme="blues"))
    ink = alt.condition("datum.psnr_db > 30", alt.value("white"), alt.value("black"))
    chart = alt.Chart(table).mark_rect(stroke="white").encode(**at, color=shade)
    for name, dy in (("psnr", -8), ("seconds", 10)):
        chart += alt.Chart(table).mark_text(fontSize=14, dy=dy).encode(**at, text=f"{name}:N", color=ink)
    axis = {"labelFontSize": 12, "titleFontSize": 12, "titleFontWeight": "normal", "labelLimit": 220}
    chart = chart.properties(width=440, height=190).configure(font=charts.FONT, axis=axis, view={"stroke": None})
    write(chart.to_dict(), "networks")


def write(spec: dict[str, Any], name: str) -> None:
    """Draw a Vega-Lite chart in the light theme to docs/images/."""
    spec["background"] = spec["config"]["background"] = "white"
    picture = vl_convert.vegalite_to_png(charts.in_light_theme(spec), scale=2)
    (ROOT / "docs" / "images" / f"{name}.png").write_bytes(picture)


if __name__ == "__main__":
    draw_frontier()
    draw_networks()
