"""Find the views from each camera place, by how far the image moves between two views."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsbench.effects.leftovers import center_of
from gsbench.scenes import View

SAME = 1e-4  # of the image's longer side: less than a tenth of a pixel of 800
NEAR = 0.05  # the same for a camera that is held, or stands on soft ground
LEAST_HELD = 3  # views of a held camera
LEAST_SPAN = 0.5  # of the film that its views span: a camera that wanders is at each place for a moment only

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Places:
    """The views from each camera place, as indices into a list of views."""

    fixed: list[list[int]]  # at least two of each place
    held: list[list[int]]  # places of cameras that move a little; empty, or most of the views that no fixed place has
    other: list[int]  # views of neither

    @property
    def loose(self) -> list[int]:
        """Return the views that no fixed place has."""
        return sorted([v for place in self.held for v in place] + self.other)


def find_places(views: Sequence[View], extent: float) -> Places:
    """Group the views by camera place.

    Args:
        views: with times.
        extent: the scene's extent, taken as the distance to the scene if the cameras look at no common point.
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
    return Places(fixed, held, [v for v in loose if v not in inside])


def _poses(views: Sequence[View], extent: float) -> Array:  # [V, 18]
    """Return a vector for each camera; the distance of two vectors is about the shift of the image, in longer sides."""
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
    """Group views so that no view is farther than the tolerance from the first view of its group."""
    groups: list[list[int]] = []
    left = np.array(numbers, dtype=np.int64)
    while len(left):
        near = np.linalg.norm(poses[left] - poses[left[0]], axis=1) <= tolerance
        groups.append(left[near].tolist())
        left = left[~near]
    return groups
