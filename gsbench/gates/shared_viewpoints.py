"""Group views that were taken from the same camera position, by the shift of the image between two views."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsbench.gates.static_fit_residuals import center_of
from gsbench.measure.regions import grouped
from gsbench.scenes import View

SAME = 1e-4  # largest shift within a position, in units of the longer side: less than a tenth of a pixel of 800
NEAR = 0.05  # largest shift for a camera that is held in the hand, or stands on soft ground
LEAST_HELD = 3  # least number of views of a held camera
LEAST_SPAN = 0.5  # least part of the scene's length that these views span; a moving camera stays for a moment only

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Viewpoints:
    """The views from each camera position, as indices into a list of views."""

    fixed: list[list[int]]  # groups of at least two views from exactly the same position
    held: list[list[int]]  # groups of views from a camera that moves a little; empty if these are a minority
    other: list[int]  # the views of no group
    loose: list[int]  # the views of `held` and `other`: those that share their exact position with no other view


def group_by_viewpoint(views: Sequence[View], extent: float) -> Viewpoints:
    """Group views by the camera position from which they were taken.

    Args:
        views: the views, which have times.
        extent: the radius of the scene; it replaces the distance to the scene if the cameras look at no common point.
    """
    poses = _poses(views, extent)
    of_one_position = grouped(poses, range(len(views)), SAME, 2)
    fixed = [group for group in of_one_position if len(group) > 1]
    loose = sorted(v for group in of_one_position if len(group) == 1 for v in group)
    times = np.array([view.time for view in views], dtype=np.float64)
    span = float(np.ptp(times))
    near = [
        group
        for group in grouped(poses, loose, NEAR, 2)
        if len(group) >= LEAST_HELD and np.ptp(times[group]) >= LEAST_SPAN * span
    ]
    held = near if 2 * sum(map(len, near)) > len(loose) else []  # a minority stays with the others
    return Viewpoints(fixed, held, sorted(set(loose).difference(*held)), loose)


def _poses(views: Sequence[View], extent: float) -> Array:  # [V, 20]
    """Return a vector for each camera, such that vectors differ by about the shift between the images of the cameras.

    The unit of the shift is the longer side of the image.
    """
    cameras = [view.camera for view in views]
    viewmats = np.stack([camera.viewmat.cpu().double().numpy() for camera in cameras])
    K = np.stack([camera.K.cpu().double().numpy()[:2].ravel() for camera in cameras])  # [V, 6]
    sizes = np.array([(camera.width, camera.height) for camera in cameras], dtype=np.float64)
    side = sizes.max(1, keepdims=True)
    focal = (K[:, :1] / side).mean()
    centers = np.stack([-viewmat[:3, :3].T @ viewmat[:3, 3] for viewmat in viewmats])
    meeting = center_of(views)
    distance = extent if meeting is None else float(np.linalg.norm(centers - meeting.numpy(), axis=1).mean())
    turns = viewmats[:, :3, :3].reshape(-1, 9) / math.sqrt(2)  # they differ by the angle: |R - R'| is sqrt 2 times it
    # Sizes are in pixels: cameras whose images have other sizes are never in one group.
    return np.concatenate([focal * turns, focal * centers / max(distance, 1e-12), K / side, sizes], 1)  # 9 + 3 + 6 + 2
