"""Draw initial points at random or read them from a PLY file, and compute distances to their neighbours."""

import math
import re
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.tensors import check_tensor
from gsbench.process.memory import require
from gsbench.scenes.ply import columns, read_vertices
from gsbench.scenes.scene import Camera, Points

SH_C0 = 0.5 / math.sqrt(math.pi)  # the constant spherical harmonic Y_00; 3DGS: colour = 0.5 + SH_C0 f_dc

_POINT = 100  # least number of bytes that a point needs while it is drawn or its neighbours are searched
NEAREST, FARTHEST = 2.0, 100.0  # range of depths of points in a frustum, in units of the radius of the cameras
FAR = 4.0  # distance from the middle, beyond which a point lies far outside; three quarters of the points lie within 1
NEIGHBOURS = 3  # whose distances are the initial scale
ROUNDS = 50  # largest number of rounds in which points in a frustum are drawn

_READ_OR_HARMLESS = re.compile(r"n?[xyz]|red|green|blue|alpha|time|f_(dc|rest)_\d+|opacity|scale_\d|rot_\d")
_LARGEST = float(np.finfo(np.float32).max)
_MIN_SQUARED_DISTANCE = 1e-7  # 3DGS, create_from_pcd: clamp_min(distCUDA2, 1e-7), so that log(scale) stays finite


def random_points(count: int, half_width: float, generator: torch.Generator) -> Points:
    """Draw `count` points uniformly in the cube [-half_width, half_width]^3, as 3DGS does for synthetic scenes.

    Colours are 0.5 + SH_C0 u / 255 with u uniform in [0, 1), so nearly grey, as in the code of 3DGS and 4DGS. The
    result is float32 on the device of the generator.
    """
    require(_POINT * count, f"{count} random points", "use fewer")
    draws = torch.rand(2, count, 3, generator=generator, device=generator.device)
    return Points(means=(2 * draws[0] - 1) * half_width, colors=0.5 + SH_C0 * draws[1] / 255)


def frustum_points(
    count: int,
    cameras: Sequence[Camera],  # of the training views
    radius: float,  # of the cameras around their mean, world units
    generator: torch.Generator,
) -> Points:
    """Draw `count` nearly grey points in the part of space that all cameras see, for a scene without known points.

    A point lies on the ray through a random pixel of a random camera. Its inverse depth is uniform between
    1 / (NEAREST radius) and 1 / (FARTHEST radius), as then its parallax in pixels is uniform too.
    """
    K, viewmats = torch.stack([camera.K for camera in cameras]), torch.stack([camera.viewmat for camera in cameras])
    size = torch.tensor([[camera.width, camera.height] for camera in cameras])  # [C, 2]
    drawn = torch.zeros(0, 3)
    for _ in range(ROUNDS):
        chosen = torch.randint(len(cameras), (count,), generator=generator)
        draws = torch.rand(count, 3, generator=generator)
        depth = radius / (draws[:, 2] * (1 / NEAREST - 1 / FARTHEST) + 1 / FARTHEST)
        pixel = torch.cat([draws[:, :2] * size[chosen], torch.ones(count, 1)], 1)  # [count, 3] u, v, 1
        in_camera = depth[:, None] * (K.inverse()[chosen] @ pixel[:, :, None])[..., 0]  # [count, 3]
        rotation, translation = viewmats[chosen, :3, :3], viewmats[chosen, :3, 3]
        points = (rotation.mT @ (in_camera - translation)[:, :, None])[..., 0]  # [count, 3] in the world
        visible = torch.stack([is_seen(points, camera, camera.near) for camera in cameras]).all(0)
        drawn = torch.cat([drawn, points[visible]])
        if len(drawn) >= count:
            colors = 0.5 + SH_C0 * torch.rand(count, 3, generator=generator) / 255
            return Points(drawn[:count].contiguous(), colors)
    raise InputError(
        f"initial points: expected training cameras that see something in common, {len(drawn)} of "
        f"{ROUNDS * count} random points are seen by all: set data.initial_half_width, or lower data.near"
    )


def is_seen(
    points: Tensor,  # [P, 3] in the dtype of the camera
    camera: Camera,
    near: float = 0.0,  # least depth, world units
) -> Tensor:  # [P] bool
    """Return which points are inside the image of a camera."""
    x = (points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]) @ camera.K.to(points).T  # [P, 3] u z, v z, z
    pixel = x[:, :2] / x[:, 2:]
    return (x[:, 2] > near) & (pixel >= 0).all(1) & (pixel <= pixel.new_tensor([camera.width, camera.height])).all(1)


def share_of_points_seen(points: Points, cameras: Sequence[Camera], enough: float = 1.0) -> float:
    """Return the share of points that are inside the image of at least one camera, and beyond its near plane.

    It is at least `enough` once this share is reached, where the search ends.
    """
    means = points.means.cpu()
    unseen = means
    for camera in cameras:
        unseen = unseen[~is_seen(unseen, camera, camera.near)]
        if len(means) - len(unseen) >= enough * len(means):
            break
    return 1 - len(unseen) / len(means)


def read_ply(path: Path) -> Points:
    """Read positions (float64) and colours of points from a PLY with `x y z` and `red green blue` or `f_dc_0..2`.

    Integer colours lie in 0..255, or in 0..65535 if one is larger. Colours from `f_dc_0..2`, which come first, are
    clamped to [0, 1]. A property `time` in [0, 1] gives the points times: the union of the clouds of several frames has
    one. Other columns are named on stderr.
    """
    vertices = read_vertices(path)
    means = columns(vertices, ("x", "y", "z"), path, _LARGEST)
    names = vertices.dtype.names or ()
    if others := [name for name in names if not _READ_OR_HARMLESS.fullmatch(name)]:
        print(f"{path}: columns of its points that are not read: {', '.join(others):.120}", file=sys.stderr)
    if "f_dc_0" in names:  # of trained Gaussians, beside which red green blue may be labels
        colors = (0.5 + SH_C0 * columns(vertices, ("f_dc_0", "f_dc_1", "f_dc_2"), path, _LARGEST)).clip(0, 1)
    elif "red" in names:
        colors = _rgb(vertices, path)
    else:
        raise InputError(f"{path}: expected colours as red green blue, or as f_dc_0..2, found {names!r:.120}: add them")
    times = torch.from_numpy(columns(vertices, ("time",), path, _LARGEST)[:, 0]).float() if "time" in names else None
    if times is not None and (times.min() < 0 or times.max() > 1):
        raise InputError(
            f"{path}: time: expected numbers from 0 to 1, got {times.min():g} to {times.max():g}: scale them"
        )
    return Points(torch.from_numpy(means), torch.from_numpy(colors.astype(np.float32)), times)


def _rgb(vertices: NDArray[np.void], path: Path) -> NDArray[np.float64]:  # [P, 3] in [0, 1]
    """Return the colours `red green blue` of points; files of scripts have 0..255 as int or ushort too."""
    names = ("red", "green", "blue")
    colors = columns(vertices, names, path, _LARGEST)
    kinds = {vertices.dtype[name].kind in "iu" for name in names}  # whether they are integers
    white = 1 if kinds == {False} else 255 if colors.max() <= 255 else 65535
    if len(kinds) > 1 or colors.min() < 0 or colors.max() > white:
        types = ", ".join(vertices.dtype[name].name for name in names)
        raise InputError(
            f"{path}: red green blue: expected uchar 0..255, ushort 0..65535 or float 0..1, got "
            f"{colors.min():g} to {colors.max():g} as {types}: convert them"
        )
    return colors / white


def nearest_distances(means: Tensor) -> Tensor:  # [P, 3] -> [P] in the dtype and on the device of `means`
    """Return the root mean square distance of each point to its three nearest neighbours, the initial scale of 3DGS.

    The result is at least sqrt(1e-7), as in the code of 3DGS.
    """
    check_tensor(means, "points")
    if means.dim() != 2 or means.shape[1] != 3:
        raise InputError(f"points: expected [P, 3], got {list(means.shape)}")
    if len(means) <= NEIGHBOURS:
        raise InputError(f"points: expected more than {NEIGHBOURS} to measure their spacing, got {len(means)}")
    require(_POINT * len(means), f"the neighbours of {len(means)} points", "use fewer")
    positions = means.detach().cpu().double().numpy()
    if not np.isfinite(positions).all():
        raise InputError("points: expected finite positions, some are not")
    # The nearest is the point itself or a duplicate.
    distances, _ = cKDTree(positions).query(positions, k=NEIGHBOURS + 1)
    squared = np.square(distances[:, 1:]).mean(axis=1)
    return torch.from_numpy(np.sqrt(squared.clip(min=_MIN_SQUARED_DISTANCE))).to(means)


def size_of(points: Points) -> float:
    """Return the size of a scene in world units: the standard deviation of the points, averaged over the axes x, y, z.

    Points that lie far outside do not count. The size of a single point is 1.
    """
    means = points.means[~far_outside(points.means)]
    size = float(means.std(0).mean()) if len(means) > 1 else 0.0
    return size if 0 < size < math.inf else 1.0


def far_outside(means: Tensor) -> Tensor:  # [P, 3] -> [P] bool
    """Return which points lie far outside: over FAR times as far from the median as three quarters of the points.

    Structure from motion places some points at a random depth. No point of a cube or of a normal distribution is far
    outside.
    """
    distances = (means.double() - means.double().median(0).values).norm(dim=1)
    within = distances.kthvalue(max(1, math.ceil(0.75 * len(distances)))).values  # radius of three quarters
    return distances > FAR * within if within > 0 else torch.zeros_like(distances, dtype=torch.bool)
