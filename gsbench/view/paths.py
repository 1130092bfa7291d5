"""Compute camera paths for a video of a model: an orbit or a spiral around its middle.

A checkpoint contains no cameras, but it contains the image size and the scene extent. The cameras have a distance of
one extent, which is about the distance of the training cameras.
"""

import math

import torch
from torch import Tensor

from gsbench.models import cameras
from gsbench.models.cameras import ELEVATION
from gsbench.run.load import LoadedRun
from gsbench.scenes import Camera

HIGHEST = math.radians(60)  # elevation at the end of a spiral
TURNS = 2  # of a spiral
FAR_AWAY = 1e4  # in scene extents; view directions then differ by at most about 1e-4 radians

Shot = tuple[Camera, float | None]  # a frame of a film: its camera and its time


def around(run: LoadedRun, azimuth: float, elevation: float) -> Camera:
    """Return a camera that looks at the middle of a model from a distance of one scene extent.

    Args:
        run: the run of the model.
        azimuth: the angle about the up direction of the scene, radians.
        elevation: the angle above the horizon, radians.
    """
    size = run.scene.width, run.scene.height
    return cameras.around(run.model, run.scene.extent, *size, azimuth, elevation, run.scene.up)


def resized(camera: Camera, width: int, height: int) -> Camera:
    """Return a camera with another image size and the same horizontal field of view.

    Pixels stay as wide as high: with another aspect ratio, the image shows less or more above and below.
    """
    scale = width / camera.width
    K = camera.K.clone()
    K[:2] *= scale
    K[1, 2] += (height - scale * camera.height) / 2
    return Camera(camera.viewmat, K, width, height)


def orbit(run: LoadedRun, frames: int) -> list[Camera]:
    """Return cameras on one full circle around a model; the last camera does not repeat the first."""
    return [around(run, 2 * math.pi * i / frames, ELEVATION) for i in range(frames)]


def spiral(run: LoadedRun, frames: int) -> list[Camera]:
    """Return cameras on a spiral that goes twice around a model and rises from the horizon."""
    return [around(run, 2 * math.pi * TURNS * part, HIGHEST * part) for part in times(frames)]


def times(frames: int) -> list[float]:
    """Return the times of a video's frames: 0 to 1 in equal steps."""
    return [i / max(1, frames - 1) for i in range(frames)]


def far_along(run: LoadedRun, direction: Tensor) -> Tensor:
    """Return a viewpoint [3] that is so far away that all Gaussians are seen along the same `direction` [3]."""
    return cameras.middle(run.model) - FAR_AWAY * run.scene.extent * torch.nn.functional.normalize(direction, dim=0)
