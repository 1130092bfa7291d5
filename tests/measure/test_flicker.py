"""What flickers: the numbers of the sheet, films among other views, and flow that differs from the truth's."""

import numpy as np
import pytest
import torch
from torch import Tensor

from gsbench.measure.flicker import NAMES, NO_FILM, Film, FlickerScores, flow_difference, tof
from gsbench.measure.regions import moving
from gsbench.scenes import Camera, View

FRAMES, SIDE = 6, 8
Y, X = np.mgrid[:SIDE, :SIDE] / SIDE
STILL = np.ones((SIDE, SIDE), bool)
STILL[:3, :3] = False
TRUTH = np.stack([0.5 + 0.2 * np.sin(4 * X + 3 * Y) + 0.05 * n * ~STILL for n in range(FRAMES)])
STEPS = np.arange(FRAMES)[:, None, None]


def in_color(image: np.ndarray) -> Tensor:  # [H, W]
    return torch.from_numpy(image)[..., None].expand(-1, -1, 3)


@pytest.mark.parametrize(
    ("error", "flicker", "drift"),
    [(np.full_like(STEPS, 0.02, float), 0.0, 0.0), (0.01 * STEPS, 2.55, 10.2), (0.02 * (-1.0) ** STEPS, 10.2, 0.0)],
)
def test_the_numbers_of_the_sheet(error, flicker, drift):
    """Catches a constant error, a drift of frames for thirds, moving pixels, another unit (RIVALS.md, section 10)."""
    film = Film(FRAMES, STILL)
    for frame, truth in zip(TRUTH + error, TRUTH, strict=True):
        film.add(in_color(frame), in_color(truth))
    assert film.scores == pytest.approx((flicker, drift, 0.0), abs=1e-8)


def test_the_truth_has_a_flicker_of_its_own():
    """Catches a floor that is not told: of a frozen render of a noisy truth, both numbers are equal."""
    noise = np.random.default_rng(0).normal(0.5, 0.01, (FRAMES, SIDE, SIDE))
    film = Film(FRAMES, STILL)
    for truth in noise:
        film.add(in_color(noise[0]), in_color(truth))
    error, _, of_truth = film.scores
    assert error == pytest.approx(of_truth)
    assert of_truth == pytest.approx(255 * np.abs(np.diff(noise, axis=0))[:, STILL].mean())


def view(name: str, time: float | None, *, x: float = 0.0, square: int | None = None) -> View:
    viewmat = torch.eye(4)
    viewmat[0, 3] = x
    image = torch.full((30, 40, 3), 0.4)
    if square is not None:
        image[10:20, square : square + 10] = 0.9
    return View(name, Camera(viewmat, torch.eye(3), 40, 30), time, image)


def scores_of(views: list[View], error: float = 0.0) -> FlickerScores:
    """Renders whose error is 0 in odd frames, and `error` in even ones."""
    scores = FlickerScores(views, moving(views).of_any_size)
    renders = ((v.name, v.image + error * (i % 2), v.image) for i, v in enumerate(views))
    assert len(list(scores.measured(renders))) == len(views)
    return scores


def test_films_of_two_cameras_are_measured_side_by_side():
    """Catches changes from one camera to another, and a view of a third that is taken for a frame."""
    films = [view(f"{x}_{i}", i / 3, x=x, square=5 * i) for i in range(4) for x in (0.0, 1.0)]
    scores = scores_of([*films, view("alone", 0.5, x=2.0)], 0.1)
    assert scores.metrics() == pytest.approx({"flicker": 0, "static_drift": 0, "flicker_truth": 0})
    moved = np.logical_or.reduce([moving(films).masks[v.name] for v in films])
    region = scores.of_record()["static"]
    assert (region.views, region.share) == (8, pytest.approx(1 - moved.mean()))
    assert scores.pictures()["flicker.png"].shape[2] == 3


@pytest.mark.parametrize(
    "views",
    [
        [view(str(i), i / 2, x=float(i)) for i in range(3)],
        [view(str(i), i / 2) for i in range(2)],
        [view(str(i), time) for i, time in enumerate((0.0, 1.0, 0.5))],
        [view(str(i), 0.5) for i in range(3)],
        [view(str(i), None) for i in range(3)],
    ],
)
def test_what_is_no_film_has_a_reason(views):
    """Catches cameras that jump, two frames, frames in another order, and a number where there is none."""
    scores = scores_of(views)
    assert scores.metrics() == dict.fromkeys(NAMES)
    assert scores.missing() == dict.fromkeys(NAMES, NO_FILM)
    assert (scores.of_record(), scores.pictures()) == ({}, {})


def test_what_moves_is_not_static_however_small():
    """Catches a region with too few pixels for a PSNR that counts as static: 6 x 6 around a square of 4 x 4."""
    views = [view(str(i), i / 3) for i in range(4)]
    views[1].pixels[4:8, 4:8] = 1.0
    assert not moving(views).masks
    assert scores_of(views).of_record()["static"].share == pytest.approx(1 - 36 / 1200)


def test_tof_of_two_flows():
    """Catches the L1 norm of the paper's text in place of the Euclidean one of its code (RIVALS.md, section 10)."""
    a = np.array([[[1.0, 0.0], [0.5, 0.5]], [[0.0, 0.0], [-1.0, 0.2]]])
    b = np.array([[[0.8, 0.1], [0.5, 0.4]], [[0.1, 0.0], [-1.2, 0.0]]])
    assert flow_difference(a, b) == pytest.approx(0.17661238, abs=1e-8)


def test_tof_of_films():
    """Catches flow between render and truth, and frames that are not left out: a render that stands still lacks the
    truth's motion of a pixel a frame, and the first two and last two frames may be anything."""
    texture = np.random.default_rng(0).integers(0, 256, (96, 160), np.uint8)
    texture = np.asarray(torch.nn.functional.avg_pool2d(torch.from_numpy(texture)[None].float(), 9, 1, 4)[0]) * 3 - 256
    wide = texture.clip(0, 255).astype(np.uint8)
    moved = [wide[:, i : i + 128] for i in range(8)]
    still = [wide[:, :128]] * 8
    assert tof(moved, moved) == 0
    assert tof(still, moved) == pytest.approx(1, abs=0.15)
    assert tof([255 - frame if i in (0, 1, 6, 7) else frame for i, frame in enumerate(moved)], moved) == 0
    assert tof(moved[:5], moved[:5]) is None
    assert tof([frame[:40] for frame in moved], [frame[:40] for frame in moved]) is None
