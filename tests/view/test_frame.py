"""A frame of the viewer: what is frozen stays, what is switched is the client's own, two models share an image."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from models.small import lively

from gsbench.backends import AUTO
from gsbench.config import Config
from gsbench.models import Phase, Query
from gsbench.models.render import rasterize_slice, render
from gsbench.run.load import LoadedRun, SceneDescription
from gsbench.scenes import Camera
from gsbench.view import paths
from gsbench.view.__main__ import main
from gsbench.view.client import camera_at
from gsbench.view.film import pixels
from gsbench.view.frame import Asked, Frame, Painter, beside, wiped
from gsbench.view.resolution import LEAST_PIXELS, MOST_PIXELS, MOVING_MS, Resolution

SIZE = 40


def painter() -> Painter:
    """Of 7DGS with AGR, in the midst of a training."""
    model = lively("7dgs_agr", count=80).float()
    model.set_phase(Phase(3, True, True))
    scene = SceneDescription("small", "0", 4.0, [0.0, 0.0, 0.0], True, SIZE, SIZE)
    return Painter(LoadedRun(model.requires_grad_(False), Config(), scene, 1, Path("7dgs/seed0")))


@pytest.fixture(scope="module")
def one() -> Painter:
    return painter()


def seen_from(azimuth: float, one: Painter) -> Camera:
    return paths.around(one.run, azimuth, 0.3)


def test_a_frame_is_the_models_image(one: Painter) -> None:
    """Catches a viewer that shows another picture than the one that is measured, and times of zero."""
    camera = seen_from(0.5, one)
    frame = one.paint(camera, Asked(0.4))
    assert (frame.image == pixels(render(one.run.model, camera, 0.4, torch.zeros(3)))).all()
    assert frame.image.max() > 30
    assert frame.slice_ms > 0
    assert frame.raster_ms > 0


def test_a_frozen_direction_slices_from_there_and_draws_from_here(one: Painter) -> None:
    """Catches a frozen slice that is also drawn from its old place, or that is not frozen."""
    here, there = seen_from(0.5, one), seen_from(2.0, one)
    frozen = one.paint(here, Asked(0.4, there.center)).image
    gaussians = one.run.model.slice(Query.at(there.center, 0.4))
    expected = pixels(rasterize_slice(gaussians, here, torch.zeros(3), AUTO).image[0])
    assert (frozen == expected).all()
    assert (frozen != one.paint(here, Asked(0.4)).image).any()


def test_agr_is_switched_for_one_frame(one: Painter) -> None:
    """Catches a client that switches AGR off for all others, or on where the training had not yet."""
    camera = seen_from(0.5, one)
    on, off, again = (one.paint(camera, Asked(0.4, agr=agr)).image for agr in (True, False, True))
    assert (on != off).any()
    assert (on == again).all()
    early = painter()
    early.trained_phase = replace(early.trained_phase, refine=False)
    assert (early.paint(camera, Asked(0.4)).image == off).all()


def test_two_models_share_an_image() -> None:
    """Catches swapped sides, an edge at the wrong place and costs that are not added."""
    left, right = (Frame(np.full((4, 8, 3), value, np.uint8), 1.0, 2.0) for value in (10, 20))
    both = beside(left, right)
    assert both.image.shape == (4, 16, 3)
    assert (both.image[:, :7] == 10).all()
    assert (both.image[:, 8:] == 20).all()
    assert (both.slice_ms, both.raster_ms) == (2, 4)
    part = wiped(left, right, 0.25).image
    assert (part[:, :2] == 10).all()
    assert (part[:, 3:] == 20).all()
    assert (wiped(left, right, 0.0).image == 20).all()
    assert (wiped(left, right, 1.0).image == 10).all()


def test_resolution_falls_while_the_camera_moves() -> None:
    """Catches a large window that stutters, a frame at rest that stays coarse, and a size of zero."""
    resolution = Resolution()
    for _ in range(3):  # 1 us a pixel and 10 ms a slice: 30,000 pixels
        width, height = resolution.size(1000, 500, moving=True)
        resolution.took(width * height, 10.0, width * height / 1000)
    assert width * height == pytest.approx(1000 * (MOVING_MS - 10), rel=0.02)
    assert width / height == pytest.approx(2, rel=0.02)
    assert resolution.size(1000, 500, moving=False) == (1000, 500)
    width, height = resolution.size(8000, 4000, moving=False)
    assert width * height == pytest.approx(MOST_PIXELS, rel=0.01)
    resolution.took(100, 500.0, 900.0)
    width, height = resolution.size(1000, 500, moving=True)
    assert width * height == pytest.approx(LEAST_PIXELS, rel=0.02)
    assert min(resolution.size(1, 3000, moving=True)) >= 1


def test_a_browsers_camera_is_ours(one: Painter) -> None:
    """Catches a pose that is inverted, mirrored or with the horizontal field of view."""
    camera = seen_from(0.7, one)
    flip = camera.viewmat[:3, :3].T.double()
    w = float((1 + flip.trace()).sqrt()) / 2
    x, y, z = (float(flip[i, j] - flip[j, i]) / (4 * w) for i, j in ((2, 1), (0, 2), (1, 0)))
    vertical = 2 * np.arctan(SIZE / 2 / float(camera.K[1, 1]))
    again = camera_at(camera.center.double().numpy(), np.array([w, x, y, z]), vertical, SIZE, SIZE)
    torch.testing.assert_close(again.viewmat, camera.viewmat, atol=1e-5, rtol=0)
    torch.testing.assert_close(again.K, camera.K)


def test_a_folder_without_a_checkpoint_is_told_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Catches a stack trace, and a server that serves nothing."""
    assert main([str(tmp_path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"gsbench.view: {tmp_path}: expected the folder of a run")
    assert main([str(tmp_path), "--port", "0"]) == 2
    assert "--port" in capsys.readouterr().err
