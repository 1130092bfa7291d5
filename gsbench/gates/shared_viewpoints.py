"""Group views that were taken from the same camera position, by the shift of the image between two views."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsbench.gates.static_fit_residuals import center_of
from gsbench.scenes import View

SAME = 1e-4  # largest shift within a position, in units of the longer side: less than a tenth of a pixel of 800
NEAR = 0.05  # largest shift for a camera that is held in the hand, or stands on soft ground
LEAST_HELD = 3  # least number of views of a held camera
LEAST_SPAN = 0.5  # least part of the scene's length that these views span; a moving camera stays for a moment only

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Viewpoints:
    """Hold the views from each camera position, as indices into a list of views."""

    fixed: list[list[int]]  # groups of at least two views from exactly the same position
    held: list[list[int]]  # groups of views from a camera that moves a little; empty if these are a minority
    other: list[int]  # the views of no group

    @property
    def loose(self) -> list[int]:
        """The views that share their exact camera position with no other view, sorted."""
        return sorted([v for place in self.held for v in place] + self.other)


def group_by_viewpoint(views: Sequence[View], extent: float) -> Viewpoints:
    """Group views by the camera position from which they were taken.

    Args:
        views: the views, which have times.
        extent: the radius of the scene; it replaces the distance to the scene if the cameras look at no common point.
    """
    poses = _poses(views, extent)
    exact = _groups(list(range(len(views))), poses, SAME)
    fixed = [group for group in exact if len(group) > 1]
    loose = sorted(v for group in exact if len(group) == 1 for v in group)
    times = np.array([view.time for view in views], dtype=np.float64)
    span = float(np.ptp(times))
    near = [group for group in _groups(loose, poses, NEAR)
            if len(group) >= LEAST_HELD and np.ptp(times[group]) >= LEAST_SPAN * span]  # fmt: skip
    held = near if 2 * sum(map(len, near)) > len(loose) else []
    inside = {v for group in held for v in group}
    return Viewpoints(fixed, held, [v for v in loose if v not in inside])


def _poses(views: Sequence[View], extent: float) -> Array:  # [V, 18]
    """Return a vector for each camera, such that vectors differ by about the shift between the images of the cameras.

    The unit of the shift is the longer side of the image.
    """
    center = center_of(views)
    rows = []
    for view in views:
        camera = view.camera
        viewmat, K = camera.viewmat.cpu().double().numpy(), camera.K.cpu().double().numpy()
        place = -viewmat[:3, :3].T @ viewmat[:3, 3]
        rows.append((viewmat[:3, :3].ravel() / math.sqrt(2), place, K[:2].ravel(), camera.width, camera.height))
    side = np.array([max(width, height) for *_, width, height in rows], dtype=np.float64)[:, None]
    focal = np.array([K[0] for _, _, K, _, _ in rows])[:, None] / side
    places = np.stack([place for _, place, *_ in rows])
    distance = extent if center is None else float(np.linalg.norm(places - center.numpy(), axis=1).mean())
    sizes = np.array([(width, height) for *_, width, height in rows], dtype=np.float64)
    return np.concatenate([
        focal.mean() * np.stack([turned for turned, *_ in rows]),
        focal.mean() * places / max(distance, 1e-12),
        np.stack([K for _, _, K, _, _ in rows]) / side,
        sizes,
    ], 1)  # fmt: skip


def _groups(numbers: list[int], poses: Array, tolerance: float) -> list[list[int]]:
    """Group views so that the distance of each pose vector to the first one of its group is at most `tolerance`."""
    groups: list[list[int]] = []
    left = np.array(numbers, dtype=np.int64)
    while len(left):
        near = np.linalg.norm(poses[left] - poses[left[0]], axis=1) <= tolerance
        groups.append(left[near].tolist())
        left = left[~near]
    return groups
