"""The viewer's panel: milliseconds by stage, what colours mean, errors, and untrusted names as text."""

import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch

from gsbench.gates.messages import EFFECT_SETS
from gsbench.gates.picture import COLOURS
from gsbench.models.effect_sets import NAMES
from gsbench.scenes import Camera, View
from gsbench.view.controls import ShownImage
from gsbench.view.frame import CLASS, COST, FLOAT32, IMAGE, Float32Error, FrameCost
from gsbench.view.panel import comparison, cost_table, legend
from gsbench.view.training_views import Nearest, ViewComparison

BLACK = np.zeros((4, 4, 3), np.uint8)


def rows(text: str) -> dict[str, list[str]]:
    """The rows of a table by their labels."""
    cells = [re.findall(r"<td[^>]*>(.*?)</td>", row, re.DOTALL) for row in re.findall(r"<tr.*?</tr>", text, re.DOTALL)]
    return {re.sub("<.*?>", "", label, flags=re.DOTALL).strip(): values for label, *values in cells}


def shown(colours: str, name: str, *counts: int) -> ShownImage:
    """An image of a model with so many Gaussians of each effect set."""
    renderer: Any = SimpleNamespace(name=name, counts=dict(zip(NAMES, counts or (1, 0, 0), strict=True)))
    return ShownImage(renderer, colours)


def view(name: str, time: float | None) -> View:
    return View(name, Camera(torch.eye(4), torch.eye(3), 4, 4), time, torch.zeros(4, 4, 3))


def test_the_table_splits_a_frame_by_stage():
    """Catches a sum without one of its stages, another model's column, and FPS of half a frame."""
    ms = {"AGR": 2.0, "conditioning": 1.0, "colours": 0.5, "projection": 0.5, "blending": 4.0}
    costs = [FrameCost("7dgs seed0", ms), FrameCost("3dgs seed0", {"conditioning": 0.25, "raster": 3.75})]
    text = cost_table(costs, 90, 60)
    table = rows(text)
    assert list(table) == ["ms", "slice", "AGR", "conditioning", "colours", "raster", "projection", "blending", "FPS"]
    assert table["ms"] == ["7dgs seed0", "3dgs seed0"]
    assert table["slice"] == ["3.5", "0.2"]
    assert table["AGR"] == ["2.0", ""]
    assert table["raster"] == ["4.5", "3.8"]
    assert table["FPS"] == ["125", "250"]
    assert "90 x 60" in text


def test_the_legend_explains_the_colours_that_there_are():
    """Catches a count beside the name of another effect set or colour, effect sets that nothing shown has, a scale that
    is not the one the image was drawn on, and a legend of colours that need none."""
    text = legend([shown(CLASS, "7dgs", 1200, 5, 30), shown(CLASS, "4dgs", 0, 700, 0)], 250.0, {})
    table = rows(text)
    assert list(table) == ["Gaussians", EFFECT_SETS["refined"], EFFECT_SETS["conditioned"], EFFECT_SETS["static"]]
    assert list(table.values()) == [["7dgs", "4dgs"], ["1,200", "0"], ["5", "700"], ["30", "0"]]
    colours = re.findall(r"color:rgb(\(.*?\))", text)
    assert colours == [str(COLOURS[name]) for name in ("refined", "conditioned", "static")]
    assert "251 ns" in (both := legend([shown(CLASS, "a"), shown(COST, "a")], 251.0, {}))
    assert EFFECT_SETS["refined"] in both
    assert EFFECT_SETS["refined"] not in legend([shown(IMAGE, "a"), shown(COST, "a")], 251.0, {})
    assert legend([shown(IMAGE, "a")], 251.0, {}) == ""


def test_the_legend_of_float32_says_what_is_known_of_each_model():
    """Catches another model's bound, a summary of a model that is not shown, and a model without a bound or reason."""
    images = [shown(FLOAT32, name) for name in ("a", "b", "c", "a")]
    error = Float32Error(np.zeros((30, 40, 3), np.uint8), 0.71, 0.00043, 0.0125, 2.04)
    text = legend(images, 1.0, {"a": error, "b": "no <bound>", "d": "hidden"})
    assert "1e-06" in text
    assert rows(text) == {
        "": ["a"],
        "largest bound": ["0.71"],
        "median bound": ["0.00043"],
        "undecided pixels": ["1.2 %"],
        "pixels": ["40 x 30"],
        "seconds": ["2.0"],
    }
    assert "<b>b</b>: no &lt;bound&gt;" in text
    assert "<b>c</b>: this is the image; its bound follows when nothing moves" in text
    assert "hidden" not in text
    assert legend([shown(IMAGE, "a")], 1.0, {"a": error}) == ""


def test_a_comparison_says_with_what_and_how_far():
    """Catches a number without its model, and a view of a static scene that has no time to print."""
    for time in (0.5, None):
        compared = [ViewComparison("a", BLACK, BLACK, BLACK, 31.256)]
        text = comparison(Nearest(view("train/r_7", time), 0.5, 12.3), compared)
        assert all(part in text for part in ("train/r_7", "0.50", "12°", "31.26 dB", "0.2 or more"))
        assert ("time 0.50" in text) == (time is not None)
        assert text.count("data:image/png;base64,") == 3


def test_names_of_folders_are_text():
    """Catches a folder or a view whose name is run as a script."""
    bad = "<script>alert(1)</script>"
    texts = (
        cost_table([FrameCost(bad, {"AGR": 1.0})], 1, 1),
        legend([shown(CLASS, bad), shown(FLOAT32, bad)], 1.0, {bad: bad}),
        comparison(Nearest(view(bad, None), 0.0, 0.0), [ViewComparison(bad, BLACK, BLACK, BLACK, 1.0)]),
    )
    assert not any("<script" in text for text in texts)
    assert all("&lt;script" in text for text in texts)
