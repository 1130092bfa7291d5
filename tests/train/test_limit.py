"""The largest number of Gaussians of a training: one for 64 training pixels, or what the settings say."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
from test_wiring import trainer
from tiny_training import moving_square

from gsbench.train.density.control import gaussian_limit


def views(number: int, side: int) -> list[Any]:
    return [SimpleNamespace(camera=SimpleNamespace(width=side, height=side))] * number


@pytest.mark.parametrize(
    ("number", "side", "initial", "most"),
    [
        (120, 80, 1_000, 12_000),
        (120, 80, 10_000, 40_000),
        (100, 800, 100_000, 1_000_000),
        (800, 2_000, 400_000, 2_000_000),
    ],
)
def test_the_limit_follows_from_the_training_pixels(number: int, side: int, initial: int, most: int) -> None:
    """Catches a limit of the views' number or of one view, one that many initial points exceed, and one without end."""
    assert gaussian_limit(None, views(number, side), initial) == most
    assert gaussian_limit(500, views(number, side), initial) == 500


def test_a_training_keeps_to_it_and_says_so_once(capsys: pytest.CaptureFixture[str]) -> None:
    """Catches a limit that no round of densification gets, and a training that is silent about what it left out."""
    square = moving_square()
    assert square.points is not None
    points = replace(square.points, means=square.points.means[:20], colors=square.points.colors[:20])
    words = ("train.densify.grad_threshold=0", "train.densify.every=5", "effects.gate=off")
    fitted = trainer("3dgs", *words, scene=replace(square, points=points))
    pixels = sum(view.camera.width * view.camera.height for view in square.train)
    assert fitted.density.limit == max(pixels // 64, 80)
    fitted.run(lambda _: None, "limit")
    assert len(fitted.model) <= fitted.density.limit
    said = capsys.readouterr().err
    assert said.count(f"{fitted.density.limit} Gaussians are the most (default of train.densify.max_gaussians)") == 1
