"""Bring a scene to a standard place and size when it is loaded, and convert Gaussians from and to the user's units.

Positions in single precision, the near plane, random initial points and the inputs of networks all suppose a scene that
lies around the origin, with cameras at a distance of about four. D-NeRF, NeRF-synthetic and 7DGS-PBR are such scenes,
and stay as they are, to the last bit.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsbench.errors import InputError
from gsbench.scenes.gaussian_ply import TrainedGaussians
from gsbench.scenes.points import far_outside, is_seen
from gsbench.scenes.scene import STANDARD, Placement, Points, Scene, View, scene_extent, up_of

_SIZE_TOLERANCE = math.sqrt(2)  # a scene keeps its size if that differs by at most this factor ..
_PLACE_TOLERANCE = 0.25  # .. and its place if cameras look at a point so near to the origin, in units of the size
_PULL = 1e-4  # weight of the cameras' middle against their axes: decides where parallel axes leave a choice
_ROUNDS = 30  # of reweighted least squares
_WORSE = 2.0  # sum of distances to the axes by that after the first round, above which the rounds went astray
_ROUNDING = 1e-12  # by which positions of one place differ in double precision, relative to their size
_AHEAD = 0.5  # cosine between a camera's axis and the common point, above which the camera looks at the point
_FAR_CAMERA = 5.0  # in units of the size and of the cameras' spread: a camera farther away has a wrong pose
_ENOUGH_SEEN = 0.25  # share of the points below which a line says how many the training cameras see
_FAR_POINTS = 10.0  # in units of the size: a median distance of the points above which a line asks for their units
_COORDINATES = "are the points in the coordinates and units of the cameras?"
_MOST_PAIRS = 1 << 22  # of points and cameras whose depths are computed


def standard_scene(
    *,
    name: str,
    train: list[View],  # with viewmats in float64 in the user's coordinates, as those of test and val
    test: list[View],
    val: Sequence[View] = (),
    background: tuple[float, float, float],
    points: Points | None = None,  # the data set's own, in float64, in the user's coordinates
    fingerprint: str,  # SHA-256 of the files
    repaired: tuple[str, ...] = (),  # names of damaged images that were replaced
    up: tuple[float, float, float] | None = None,  # None: it is estimated from the cameras
    notes: tuple[str, ...] = (),  # of the reader, a line each
) -> Scene:
    """Return a scene whose cameras and points are in single precision, in the standard place and size."""
    viewmats = np.stack([view.camera.viewmat.numpy() for view in train])
    centers = -np.linalg.solve(viewmats[:, :3, :3], viewmats[:, :3, 3:])[..., 0]  # [C, 3]; R is rigid to 1e-4 only
    is_one_place = bool(np.ptp(centers, axis=0).max() <= _ROUNDING * np.abs(centers).max())
    centers = np.repeat(centers[:1], len(centers), axis=0) if is_one_place else centers
    axes = viewmats[:, 2, :3] / np.linalg.norm(viewmats[:, 2, :3], axis=1, keepdims=True)  # [C, 3] viewing directions
    visible, share = _seen_points(name, train, points)
    middle, size = place_and_size(centers, axes, visible)
    placement = _placement(middle, size)
    train, val, test = ([_placed(view, placement) for view in views] for views in (train, val, test))
    moved = torch.stack([view.camera.viewmat for view in train])
    is_near = torch.from_numpy(_are_near(centers, size))
    lines = _notes(placement, is_near)
    if points is not None:
        distance = float((points.means.double() - torch.from_numpy(middle)).norm(dim=1).median())
        points = Points(placement.to_standard(points.means), points.colors.float(), points.times)
        lines += _notes_of_points(points, share, is_far_away=size > 0 and distance > _FAR_POINTS * size)
    return Scene(
        name=name,
        train=train,
        val=val,
        test=test,
        background=background,
        extent=0.0 if is_one_place else scene_extent(moved[is_near]),
        points=points,
        fingerprint=fingerprint,
        repaired=repaired,
        up=up_of(moved) if up is None else up,
        placement=placement,
        notes=(*notes, *lines),
    )


def _placed(view: View, placement: Placement) -> View:
    camera = view.camera
    return replace(view, camera=replace(camera, viewmat=placement.viewmat_to_standard(camera.viewmat)))


def place_and_size(
    centers: NDArray[np.float64],  # [C, 3] positions of the cameras
    axes: NDArray[np.float64],  # [C, 3] unit vectors in which they look
    visible: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None,  # [S, 3] points that they see, [S] depths
) -> tuple[NDArray[np.float64], float]:
    """Return the point that cameras look at, [3], and the median distance of the cameras from it.

    The point has the smallest sum of distances to the cameras' axes, so a few wrong poses do not move it. Cameras of an
    array have parallel axes, and those of a room look outwards: then the point is the median of the points that they
    see, and the distance is the median depth. Without points, content is taken to lie at four times the spread of the
    cameras. The distance is 0 if all cameras are at one place and there are no points.
    """
    middle = np.median(centers, axis=0)
    spread = float(np.median(np.linalg.norm(centers - middle, axis=1)))
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]  # [C, 3, 3] take away what lies along an axis
    targets, sums, weights = [], [], np.ones(len(centers))
    # Sums of distances, not of their squares: iteratively reweighted least squares. With weights w, across P, centres c
    # and x = target - middle, sum w P (x - (c - middle)) + pull x = 0.
    for _ in range(_ROUNDS):
        weighted = weights[:, None, None] * across
        pull = _PULL * weights.sum()
        matrix = weighted.sum(0) + pull * np.eye(3)
        target = middle + np.linalg.solve(matrix, (weighted @ (centers - middle)[:, :, None]).sum(0)[:, 0])
        offsets = target - centers
        to_axis = np.linalg.norm(across @ offsets[:, :, None], axis=(1, 2))  # [C] distances
        targets.append(target)
        sums.append(to_axis.sum())
        # An axis through the target would have an infinite weight.
        weights = 1 / np.maximum(to_axis, 1e-3 * np.median(np.linalg.norm(offsets, axis=1)) + 1e-300)
        weights /= weights.max()
    if sums[-1] > _WORSE * sums[0]:  # of two cameras side by side, the one with more images draws the point to itself
        target = targets[0]
    distances = np.linalg.norm(target - centers, axis=1)
    ahead = ((target - centers) * axes).sum(1)
    if np.median(ahead) > _AHEAD * np.median(distances) > 0:  # most cameras look at the target
        return target, float(np.median(distances))
    if visible is not None and len(visible[0]):
        return np.median(visible[0], axis=0), float(np.median(visible[1]))
    return middle + STANDARD * spread * axes.mean(0), STANDARD * spread


def gaussians_to_standard(trained: TrainedGaussians, placement: Placement) -> TrainedGaussians:
    """Convert trained Gaussians from the user's coordinates to those of the training."""
    return replace(
        trained, means=placement.to_standard(trained.means), log_scales=trained.log_scales - math.log(placement.unit)
    )


def gaussians_to_user(trained: TrainedGaussians, placement: Placement) -> TrainedGaussians:
    """Convert trained Gaussians from the coordinates of the training to the user's."""
    return replace(
        trained,
        means=placement.to_user(trained.means).float(),
        log_scales=trained.log_scales + math.log(placement.unit),
    )


def _placement(middle: NDArray[np.float64], size: float) -> Placement:
    """Return the placement of a scene; the identity if it is near to the standard place and size.

    The unit has one significant digit, and the centre is a multiple of it. So a scene that was moved by metres or
    scaled by a round number is trained as if it had not been.
    """
    if not np.isfinite([*middle, size]).all():
        raise InputError("cameras: expected positions that are finite, some are not")
    if size == 0:
        return Placement()
    ratio = size / STANDARD
    unit = 1.0 if 1 / _SIZE_TOLERANCE <= ratio <= _SIZE_TOLERANCE else float(f"{ratio:.0e}")
    if np.linalg.norm(middle) <= _PLACE_TOLERANCE * size:
        return Placement(unit=unit)
    x, y, z = (round(value / unit) * unit for value in middle.tolist())
    return Placement((x, y, z), unit)


def _notes(placement: Placement, is_near: Tensor) -> list[str]:
    """Return sentences on a scene that is moved or rescaled, and on cameras that lie far away; `is_near`: [C] bool."""
    notes = []
    if not placement.is_identity:
        notes.append(
            f"trained in units of {placement.unit:g} around {_text(placement.center)}, where the cameras "
            f"look; PLY files and positions stay in your coordinates"
        )
    if not is_near.all():
        notes.append(
            f"{int((~is_near).sum())} of {len(is_near)} training cameras lie far from the others, over "
            f"{_FAR_CAMERA:g} times their distance: are their poses right? They do not count for the size "
            f"of the scene"
        )
    return notes


def _notes_of_points(points: Points, share: float, *, is_far_away: bool) -> list[str]:
    """Return sentences on points of which cameras see a small share only, or which lie far away or far outside."""
    notes = []
    if share < _ENOUGH_SEEN:
        notes.append(f"the training cameras see {share:.1%} of the points: {_COORDINATES}")
    if is_far_away:
        notes.append(
            f"half of the points lie over {_FAR_POINTS:g} times as far away as the cameras from what these "
            f"look at: {_COORDINATES}"
        )
    if far := int(far_outside(points.means).sum()):
        notes.append(f"{far} of {len(points.means)} points lie far outside, and do not count for its size")
    return notes


def _seen_points(
    name: str, views: list[View], points: Points | None
) -> tuple[tuple[NDArray[np.float64], NDArray[np.float64]] | None, float]:  # ([S, 3], [S]), share
    """Return points that cameras see, once for each camera, with their depths, and the share of points that are seen.

    Of many points, every n-th is tested. Points and depths are None if a data set has no points.
    """
    if points is None:
        return None, 1.0
    means = points.means.double()[:: max(1, math.ceil(len(points.means) * len(views) / _MOST_PAIRS))]
    visible, depths, is_any = [], [], torch.zeros(len(means), dtype=torch.bool)
    for camera in (view.camera for view in views):
        is_inside = is_seen(means, camera)
        is_any |= is_inside
        inside = means[is_inside]
        visible.append(inside.numpy())
        depths.append((inside @ camera.viewmat[2, :3] + camera.viewmat[2, 3]).numpy())
    if not is_any.any():
        raise InputError(
            f"{name}: expected initial points that a training camera sees, they see none of the "
            f"{len(points.means)}: are points and poses of one capture, and in the same coordinates and "
            f"units, and focal lengths and principal points in pixels of the images?",
            docs="data.md#where-a-scene-lies",
        )
    return (np.concatenate(visible), np.concatenate(depths)), float(is_any.double().mean())


def _are_near(centers: NDArray[np.float64], size: float) -> NDArray[np.bool_]:  # [C]
    """Return which cameras are not far from the others; all if they are at one place."""
    distances = np.linalg.norm(centers - np.median(centers, axis=0), axis=1)
    spread = float(np.quantile(distances, 0.75))  # the radius of three quarters of the cameras
    return distances <= _FAR_CAMERA * max(size, spread)


def _text(position: tuple[float, float, float]) -> str:
    return f"({', '.join(f'{value:.6g}' for value in position)})"
