"""Provide initial points, at random or from a PLY, and measure their distances and their extent."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.tensors import check_number, check_tensor
from gsbench.process.memory import require
from gsbench.scenes.ply import read_vertices
from gsbench.scenes.scene import Camera, Points

SH_C0 = 0.5 / math.sqrt(math.pi)  # the constant spherical harmonic Y_00; 3DGS: colour = 0.5 + SH_C0 f_dc

_POINT = 100  # bytes a point takes while it is drawn or its neighbours are looked for, at least
NEAREST, FARTHEST = 2.0, 100.0  # depth of points in a frustum, in radii of the cameras
ROUNDS = 50  # of drawing points in a frustum

_MIN_SQUARED_DISTANCE = 1e-7  # 3DGS, create_from_pcd: clamp_min(distCUDA2, 1e-7), so that log(scale) stays finite


def random_points(count: int, half_width: float, generator: torch.Generator) -> Points:
    """Draw `count` points uniformly in the cube [-half_width, half_width]^3, all of nearly the same grey.

    Colours are 0.5 + SH_C0 u / 255 with u uniform in [0, 1), as 3DGS and 4DGS draw them (readNerfSyntheticInfo:
    SH2RGB(random / 255)). Everything is float32 on the generator's device.
    """
    if type(count) is not int or count < 1:
        raise InputError(f"random points: expected a count of at least 1, got {count!r:.80}")
    check_number(half_width, "random points: half width", 1e-30, 1e30)
    require(_POINT * count, f"{count} random points", "use fewer")
    draws = torch.rand(2, count, 3, generator=generator, device=generator.device)
    return Points(means=(2 * draws[0] - 1) * float(half_width), colors=0.5 + SH_C0 * draws[1] / 255)


def frustum_points(count: int, cameras: Sequence[Camera], radius: float, generator: torch.Generator) -> Points:
    """Draw `count` points in the frustum that all cameras share, all of nearly the same grey.

    Each lies on a random pixel's ray of a random camera, uniformly in inverse depth between `NEAREST` and `FARTHEST`
    times the cameras' radius: a rig that looks in one direction says nothing about how far away the scene is.

    Args:
        count: of points.
        cameras: of the training views.
        radius: of the cameras around their mean, world units.
        generator: the source of all random numbers.

    Raises:
        InputError: the cameras share too little for that many points.
    """
    K, viewmats = torch.stack([camera.K for camera in cameras]), torch.stack([camera.viewmat for camera in cameras])
    size = torch.tensor([[camera.width, camera.height] for camera in cameras])  # [C, 2]
    found = torch.zeros(0, 3)
    for _ in range(ROUNDS):
        chosen = torch.randint(len(cameras), (count,), generator=generator)
        draws = torch.rand(count, 3, generator=generator)
        depth = radius / (draws[:, 2] * (1 / NEAREST - 1 / FARTHEST) + 1 / FARTHEST)
        pixel = torch.cat([draws[:, :2] * size[chosen], torch.ones(count, 1)], 1)
        inside = depth[:, None] * (K.inverse()[chosen] @ pixel[:, :, None])[..., 0]  # [count, 3] in the camera
        rotation, translation = viewmats[chosen, :3, :3], viewmats[chosen, :3, 3]
        points = (rotation.mT @ (inside - translation)[:, :, None])[..., 0]
        found = torch.cat([found, points[_seen_by_all(points, K, viewmats, size)]])
        if len(found) >= count:
            colors = 0.5 + SH_C0 * torch.rand(count, 3, generator=generator) / 255
            return Points(found[:count].contiguous(), colors)
    raise InputError(f"initial points: expected training cameras that see something in common, {len(found)} of "
                     f"{ROUNDS * count} random points are seen by all: set data.initial_half_width")  # fmt: skip


def _seen_by_all(points: Tensor, K: Tensor, viewmats: Tensor, size: Tensor) -> Tensor:
    """Tell which points [P, 3] every camera has in its image, [P] bool."""
    seen = torch.ones(len(points), dtype=torch.bool)
    for camera, viewmat, extent in zip(K, viewmats, size, strict=True):
        x = (points @ viewmat[:3, :3].T + viewmat[:3, 3]) @ camera.T
        pixel = x[:, :2] / x[:, 2:]
        seen &= (x[:, 2] > 0) & (pixel >= 0).all(1) & (pixel <= extent).all(1)
    return seen


def read_ply(path: str | Path) -> Points:
    """Read points from a PLY: `x y z` and `red green blue`, else 3DGS' `f_dc_0..2`.

    Integer colours are divided by their type's largest value, float colours are used unchanged; a colour outside
    [0, 1] is refused, except one from `f_dc`, where it is usual and is clamped.

    Raises:
        InputError: the file is not such a PLY, is truncated, lacks positions or colours, or is not finite.
    """
    vertices = read_vertices(Path(path))
    means = _columns(vertices, ("x", "y", "z"), path)
    names = vertices.dtype.names or ()
    if "red" in names:
        colors = _columns(vertices, ("red", "green", "blue"), path)
        kind = vertices.dtype["red"]
        if kind.kind in "iu":
            colors = colors / np.iinfo(kind).max
        if colors.min() < 0 or colors.max() > 1:
            raise InputError(f"{path}: red green blue: expected uchar 0..255 or float 0..1, some are outside")
    else:
        colors = (0.5 + SH_C0 * _columns(vertices, ("f_dc_0", "f_dc_1", "f_dc_2"), path)).clip(0, 1)
    return Points(_tensor(means), _tensor(colors))


def nearest_distances(
    means: Tensor,  # [P, 3]
    k: int = 3,
) -> Tensor:  # [P] in the dtype and on the device of `means`
    """Return the root of the mean squared distance of every point to its `k` nearest others, at least sqrt(1e-7).

    This is the initial scale of 3DGS, sqrt(clamp_min(distCUDA2, 1e-7)); distCUDA2 is the mean SQUARED distance.

    Raises:
        InputError: there are at most `k` points, or a point is not finite.
    """
    check_tensor(means, "points")
    if type(k) is not int or k < 1 or means.dim() != 2 or means.shape[1] != 3:
        raise InputError(f"points: expected [P, 3] and at least one neighbour, got {list(means.shape)} and {k!r:.80}")
    if means.shape[0] <= k:
        raise InputError(f"points: expected more than {k} to measure their spacing, got {means.shape[0]}")
    require(_POINT * len(means), f"the neighbours of {len(means)} points", "use fewer")
    positions = means.detach().cpu().double().numpy()
    if not np.isfinite(positions).all():
        raise InputError("points: expected finite positions, some are not")
    distances, _ = cKDTree(positions).query(positions, k=k + 1)  # the nearest is the point itself or a duplicate
    squared = np.square(distances[:, 1:]).mean(axis=1)
    return torch.from_numpy(np.sqrt(squared.clip(min=_MIN_SQUARED_DISTANCE))).to(means)


def size_of(points: Points) -> float:
    """Return the size of a scene, world units: the mean standard deviation of points along an axis; 1 for one point.

    Unlike the extent, it does not depend on the cameras.
    """
    size = float(points.means.std(0).mean()) if len(points.means) > 1 else 0.0
    return size if 0 < size < math.inf else 1.0


def _columns(vertices: NDArray[np.void], names: tuple[str, str, str], path: str | Path) -> NDArray[np.float64]:
    """Return three properties as [P, 3] float64, finite in single precision."""
    for name in names:
        if name not in (vertices.dtype.names or ()):
            raise InputError(f"{path}: {name}: expected this vertex property, found {vertices.dtype.names!r:.120}")
    columns = np.stack([vertices[name] for name in names], axis=1).astype(np.float64)
    if not (np.abs(columns) <= np.finfo(np.float32).max).all():
        raise InputError(f"{path}: {' '.join(names)}: expected finite numbers, some are not")
    return columns


def _tensor(values: NDArray[np.float64]) -> Tensor:
    return torch.from_numpy(values.astype(np.float32))
