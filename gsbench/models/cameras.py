"""Place cameras around the Gaussians of a model."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from gsbench.models.base import GaussianModel
from gsbench.scenes.scene import UP, Camera

ELEVATION = math.radians(25)  # of an orbit above the horizon
FIELD_OF_VIEW = 0.69  # radians, horizontal; D-NeRF's camera_angle_x


def middle(model: GaussianModel) -> Tensor:
    """Return the middle of a model, [3]: the median of the Gaussians' means, weighted by opacity."""
    means = model.splats["means"].detach().cpu()
    order = means.argsort(0)  # [N, 3] along each axis
    weights = torch.sigmoid(model.splats["opacities"].detach().cpu())[order].cumsum(0)  # [N, 3] of all up to each
    place = (weights < weights[-1] / 2).sum(0, keepdim=True)  # [1, 3] the first with half of the weight
    return means.gather(0, order.gather(0, place.clamp(max=len(means) - 1)))[0]


def look_at(eye: Tensor, target: Tensor, up: Tensor) -> Tensor:
    """Return the viewmat [4, 4] of an upright camera at `eye` [3] that looks at `target` [3]; `up` [3]: unit vector."""
    forward = torch.nn.functional.normalize(target - eye, dim=0)
    if torch.linalg.cross(forward, up).norm() < 1e-3:  # straight up or down
        up = _level(up)[0]
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up), dim=0)
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    viewmat = torch.eye(4).to(eye)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ eye
    return viewmat


def intrinsics(width: int, height: int) -> Tensor:
    """Return the intrinsic matrix K [3, 3] for an image of a size, with the field of view FIELD_OF_VIEW."""
    focal = width / 2 / math.tan(FIELD_OF_VIEW / 2)
    return torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])


def _level(up: Tensor) -> tuple[Tensor, Tensor]:
    """Return two unit vectors [3] that form a right-handed basis with `up` [3]; for z they are x and y."""
    axis = torch.eye(3)[min(range(3), key=up.abs().tolist().__getitem__)]  # the first of equal ones, unlike argmin
    first = torch.nn.functional.normalize(axis - (axis @ up) * up, dim=0)
    return first, torch.linalg.cross(up, first)


def around(
    model: GaussianModel,
    distance: float,  # of the camera from the middle of the model, world units
    width: int,
    height: int,
    azimuth: float,  # the angle about `up`, radians
    elevation: float = ELEVATION,  # the angle above the horizon, radians
    up: Sequence[float] = UP,  # a unit vector in world space
) -> Camera:
    """Return a camera that looks at the middle of a model."""
    flat, axis = math.cos(elevation), torch.tensor(up, dtype=torch.float32)
    basis = torch.stack([*_level(axis), axis])
    # [3] from the middle to the camera; with azimuth 0 it looks along the second level axis
    towards = torch.tensor([flat * math.sin(azimuth), -flat * math.cos(azimuth), math.sin(elevation)]) @ basis
    target = middle(model)
    return Camera(look_at(target + distance * towards, target, axis), intrinsics(width, height), width, height)
