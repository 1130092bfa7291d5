"""Draw README's frontier: PSNR on test against seconds of training, a line for each model, from the published study.

python docs/site/frontier_chart.py
"""

import dataclasses
import json
import re
from pathlib import Path

import pandas as pd
import vl_convert

from gsbench.report.blocks import LENGTHS, MODELS, only
from gsbench.report.render import charts
from gsbench.report.render.palette import THEMES, styles
from gsbench.report.sections.budgets import frontier

ROOT = Path(__file__).resolve().parents[2]
PICTURE = ROOT / "docs" / "images" / "frontier.png"


def draw() -> None:
    """Draw the chart of the means over scenes, without the threshold of densification, to docs/images/."""
    section = frontier(only(ROOT / "results" / "published", "frontier"), pd.DataFrame())
    assert section is not None
    figure = section.figures[0]
    of = figure.table
    variants = [variant for name, variant in LENGTHS.items() if "threshold" not in name]
    kept = of.scene.str.startswith("mean") & of.model.isin(MODELS) & of.variant.isin(variants)
    spec = charts.spec(dataclasses.replace(figure, table=of[kept]), styles(MODELS), width=620, legend=True)
    spec["background"] = spec["config"]["background"] = "white"
    plain = re.sub(r"var\(--([\w-]+)\)", lambda match: THEMES[match[1]][0], json.dumps(spec))
    PICTURE.write_bytes(vl_convert.vegalite_to_png(plain, scale=2))


if __name__ == "__main__":
    draw()
