"""Compute camera paths for a video of a model: an orbit or a spiral around its middle.

A checkpoint contains no cameras, but it contains the image size and the scene extent. The cameras have a distance of
one extent, which is about the distance of the training cameras.
"""

import math

import torch
from torch import Tensor

from gsbench.models.base import GaussianModel
from gsbench.run.load import LoadedRun
from gsbench.scenes import Camera

UP = (0.0, 0.0, 1.0)  # of Blender's layout: D-NeRF, 7DGS-PBR, the embedded scenes
ELEVATION = math.radians(25)  # of an orbit above the horizon
HIGHEST = math.radians(60)  # elevation at the end of a spiral
TURNS = 2  # of a spiral
FIELD_OF_VIEW = 0.69  # radians, horizontal; D-NeRF's camera_angle_x
FAR_AWAY = 1e4  # in scene extents; view directions then differ by at most about 1e-4 radians

Shot = tuple[Camera, float | None]  # a frame of a film: its camera and its time


def middle(model: GaussianModel) -> Tensor:
    """Return the middle of a model, [3]: the median of the Gaussians' means, weighted by opacity."""
    means = model.splats["means"].detach().cpu()
    order = means.argsort(0)
    weights = torch.sigmoid(model.splats["opacities"].detach().cpu())[order].cumsum(0)  # [N, 3]
    half = (weights < weights[-1] / 2).sum(0, keepdim=True)
    return means.gather(0, order.gather(0, half.clamp(max=len(means) - 1)))[0]


def look_at(eye: Tensor, target: Tensor) -> Tensor:
    """Return the viewmat [4, 4] of an upright camera at `eye` [3] that looks at `target` [3]."""
    forward = torch.nn.functional.normalize(target - eye, dim=0)
    up = torch.tensor(UP).to(eye)
    if torch.linalg.cross(forward, up).norm() < 1e-3:  # straight up or down
        up = up.roll(1)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up), dim=0)
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    viewmat = torch.eye(4).to(eye)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ eye
    return viewmat


def intrinsics(width: int, height: int) -> Tensor:
    """Return the intrinsic matrix K [3, 3] for an image of the given size.

    The horizontal field of view is 0.69 radians, as in D-NeRF.
    """
    focal = width / 2 / math.tan(FIELD_OF_VIEW / 2)
    return torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])


def around(run: LoadedRun, azimuth: float, elevation: float) -> Camera:
    """Return a camera that looks at the middle of a model from a distance of one scene extent.

    Args:
        run: the run of the model.
        azimuth: the angle about the axis `UP`, radians.
        elevation: the angle above the horizon, radians.
    """
    flat = math.cos(elevation)
    towards = torch.tensor([flat * math.sin(azimuth), -flat * math.cos(azimuth), math.sin(elevation)])
    target = middle(run.model)
    size = run.scene.width, run.scene.height
    return Camera(look_at(target + run.scene.extent * towards, target), intrinsics(*size), *size)


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
    parts = [i / max(1, frames - 1) for i in range(frames)]
    return [around(run, 2 * math.pi * TURNS * part, HIGHEST * part) for part in parts]


def far_along(run: LoadedRun, direction: Tensor) -> Tensor:
    """Return a viewpoint [3] that is so far away that all Gaussians are seen along the same `direction` [3]."""
    return middle(run.model) - FAR_AWAY * run.scene.extent * torch.nn.functional.normalize(direction, dim=0)
