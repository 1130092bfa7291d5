"""Drift in 3D: paths that can be computed by hand, of what is seen in static pixels and of nothing else."""

import math
from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import Tensor

from gsbench.kernels.backends import resolve
from gsbench.models.gaussian_batch import Gaussians3D
from gsbench.run.drift import NAMES, of_films
from gsbench.scenes import Camera, View

FOCAL, SIDE = 40.0, 32
CAMERA = Camera(torch.eye(4), torch.tensor([[FOCAL, 0, 16], [0, FOCAL, 16], [0, 0, 1.0]]), SIDE, SIDE)
FILM = [View(str(i), CAMERA, i / 4, torch.zeros(SIDE, SIDE, 3)) for i in range(5)]
WHOLE = np.ones((SIDE, SIDE), bool)
LEFT = WHOLE.copy()
LEFT[:, SIDE // 2 :] = False


def drift(means: Callable[[float], list[list[float]]], opacities: list[float], still=WHOLE, size=0.05, unit=1.0):
    """The drift of Gaussians of one size whose means are a function of time."""

    def slice_at(query) -> Gaussians3D:
        at: Tensor = torch.tensor(means(query.time))
        n = len(at)
        return Gaussians3D(at, size * torch.eye(3).expand(n, 3, 3), torch.tensor(opacities), torch.rand(n, 3), None)

    model = SimpleNamespace(slice=slice_at, backend=resolve("reference", "cpu"))
    return of_films(model, [(FILM, still)], False, unit)


def test_the_path_of_a_gaussian():
    """Catches a displacement in place of a path, another unit, and pixels of another depth or focal length."""
    there_and_back = drift(lambda t: [[0.1 * math.sin(2 * math.pi * t), 0.0, 2.0]], [0.9], unit=3.0)
    assert there_and_back == pytest.approx({"drift_3d": 3 * 0.4, "drift_3d_px": 0.4 * FOCAL / 2}, rel=1e-5)
    in_depth = drift(lambda t: [[0.0, 0.0, 2.0 + t]], [0.9])
    assert in_depth == pytest.approx({"drift_3d": 1.0, "drift_3d_px": 0.0}, rel=1e-5, abs=1e-5)


def test_only_what_is_seen_in_static_pixels_counts():
    """Catches a moving object, a Gaussian behind a wall or behind the camera, weights other than alpha times
    transmittance, and those of the frame after the step."""
    standing, moving = [-0.4, 0.0, 2.0], lambda t: [0.3, 0.1 * t, 2.0]
    assert drift(lambda t: [standing, moving(t)], [0.9, 0.9], LEFT)["drift_3d"] == 0
    assert drift(lambda t: [standing, moving(t)], [0.9, 0.9])["drift_3d"] == pytest.approx(0.05, abs=0.002)
    behind_the_camera = drift(lambda t: [standing, [-0.4, t, -2.0]], [0.9, 0.9], LEFT)
    assert behind_the_camera == pytest.approx(dict.fromkeys(NAMES, 0.0))
    leaving = drift(lambda t: [[-0.4 if t < 0.5 else 0.4, 0.0, 2.0]], [0.9], LEFT)
    assert leaving["drift_3d"] == pytest.approx(0.8, rel=1e-5)
    # Large Gaussians that fill the image: alpha is the opacity, the front one hides the rest of the other.
    layers = drift(lambda t: [[0.1 * t, 0.0, 2.0], [0.0, 0.0, 3.0]], [0.25, 0.8], size=50.0)
    assert layers["drift_3d"] == pytest.approx(0.1 * 0.25 / (0.25 + 0.75 * 0.8), rel=1e-3)


def test_without_a_film_there_is_no_number():
    """Catches a 0 where nothing was measured, and a division by 0 where nothing is seen."""
    assert of_films(SimpleNamespace(), [], False, 1.0) == dict.fromkeys(NAMES)
    assert drift(lambda t: [[0.0, t, 2.0]], [0.0]) == dict.fromkeys(NAMES, 0.0)
