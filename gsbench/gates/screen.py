"""Decide before a training, by a permutation test, whether a scene changes with time.

If several images come from the same camera position, they are compared with one another
(gsbench.gates.fixed_camera_test).

For other views, a static 3DGS is fitted in a few steps. If the scene moves, the gradients of the views' squared errors
with respect to the means of the Gaussians change slowly with time. The test measures the share of these gradients that
follows four slow cosines of time, cos(pi k t) with k = 1 .. 4. It compares this share with the shares under random
permutations of time (Freedman and Lane 1983). The influence of the camera position is removed by regression first. If
the camera moves along with time, as on an orbit, the two influences cannot be separated, and the answer is undecided.
"""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from gsbench.errors import InputError
from gsbench.gates.fixed_camera_test import compare_images
from gsbench.gates.permutation_test import Array, evidence
from gsbench.gates.shared_viewpoints import Viewpoints, group_by_viewpoint
from gsbench.gates.static_fit_residuals import camera_basis, residual_products, smaller
from gsbench.measure.record import TimeScreen
from gsbench.scenes import Scene, View

LEVEL = 0.01  # the scene changes with time if the p-value is at most this
LEAST_FREE = 0.5  # least share of the variance of the cosines of time that the camera position does not explain
LEAST_VIEWS = 12
ON, OFF, UNDECIDED = "on", "off", "undecided"


@dataclass(frozen=True)
class ScreenResult:
    """Hold the answer (on, off or undecided) of one test whether the scene changes with time, and its p-value."""

    decision: str
    reason: str
    p: float | None = None
    z: float | None = None
    free: float | None = None


def screen_time(scene: Scene, seed: int = 0, backend: str = "auto") -> TimeScreen:
    """Decide whether a scene changes with time, from its training views, which are reduced to a small size.

    Args:
        scene: the scene.
        seed: the seed of the initial points of the static fit and of the random permutations.
        backend: the rasterizer of the static fit: `reference` (plain PyTorch), `cpu`, `cuda` or `auto`.

    Raises:
        InputError: the scene has no training view.
    """
    import_compiler()
    started = time.perf_counter()
    if not scene.train:
        raise InputError(f"{scene.name}: expected training views to look at, there are none")
    found = _answer(scene, seed, backend)
    return TimeScreen(found.decision, found.reason, found.p, found.z, found.free, time.perf_counter() - started)


def import_compiler() -> None:
    """Create a torch optimizer so that torch imports its compiler now, before the run time of the test is measured.

    The import takes a second. Otherwise the first optimizer of the test would trigger the import.
    """
    torch.optim.Adam([torch.zeros(1)])


def _answer(scene: Scene, seed: int, backend: str) -> ScreenResult:
    """Test whether the scene changes with time, on views that share a camera position, on other views, or on all."""
    views = scene.train
    if not scene.has_time:
        return ScreenResult(OFF, "the views have no times")
    if len({view.time for view in views}) == 1:
        return ScreenResult(UNDECIDED, "all training views have the same time")
    if len(views) < LEAST_VIEWS:
        return ScreenResult(UNDECIDED, f"{len(views)} training views are too few; {LEAST_VIEWS} are needed")
    places = group_by_viewpoint(views, scene.extent)
    answers = []
    if places.fixed:
        answers.append(_of_fixed(views, places, seed))
    if len(places.loose) >= LEAST_VIEWS:
        answers.append(_of_loose(scene, places, seed, backend))
    return answers[0] if len(answers) == 1 else _both(*answers)


def _of_fixed(views: Sequence[View], places: Viewpoints, seed: int) -> ScreenResult:
    """Test for change with time by comparing the images that were taken from the same camera position."""
    found = compare_images(views, places.fixed, seed)
    count = len(places.fixed)
    where = f"the images of each of {count} camera positions" if count > 1 else "the images of the camera's position"
    if not found.changed:
        return ScreenResult(OFF, f"{where} differ by exposure and noise only")
    blocks = f"{_percent(found.changed)} of their blocks"
    if found.p is None:
        return ScreenResult(UNDECIDED, f"{where} differ in {blocks}, but are too few to test for a change over time")
    if found.p <= LEVEL:
        return ScreenResult(ON, f"{where} change over time, in {blocks} (p = {found.p:.3f})", found.p, found.z)
    said = f"{where} differ in {blocks}, but not clearly over time (p = {found.p:.3f})"
    return ScreenResult(UNDECIDED, said, found.p, found.z)


def _percent(share: float) -> str:
    return f"{share:.0%}" if share >= 0.01 else "less than 1%"


def _of_loose(scene: Scene, places: Viewpoints, seed: int, backend: str) -> ScreenResult:
    """Test for change with time by the residuals of a static 3DGS, fitted to views without a common camera position."""
    numbers = [*(v for place in places.held for v in place)] if places.held else places.other
    views = [smaller(scene.train[v]) for v in numbers]
    times = np.array([view.time for view in views], dtype=np.float64)
    held, start = [], 0
    for place in places.held:
        held.append(list(range(start, start + len(place))))
        start += len(place)
    camera = _dummies(held) if held else camera_basis(views)
    found = evidence(residual_products(views, scene, seed, backend), times, camera, seed, held or None)
    if found.free < LEAST_FREE:
        reason = (f"the camera moves along with time, so that only {found.free:.0%} of a slow change can be told from "
                  f"its motion; {LEAST_FREE:.0%} are needed")  # fmt: skip
        return ScreenResult(UNDECIDED, reason, found.p, found.z, found.free)
    if found.p <= LEVEL:
        decision, reason = ON, f"a static model's error changes over time (p = {found.p:.3f})"
    elif held:
        decision = UNDECIDED
        reason = (f"the cameras of {len(held)} positions move a little, and a static model's error does not clearly "
                  f"change over time (p = {found.p:.3f})")  # fmt: skip
    else:
        decision, reason = OFF, f"a static model's error does not change over time (p = {found.p:.3f})"
    return ScreenResult(decision, reason, found.p, found.z, found.free)


def _dummies(places: list[list[int]]) -> Array:  # [V, P]
    """Return indicator variables [V, P] of P camera positions: 1 for a view from the position, 0 for other views."""
    columns = np.zeros((sum(map(len, places)), len(places)))
    for number, place in enumerate(places):
        columns[place, number] = 1
    return columns


def _both(fixed: ScreenResult, loose: ScreenResult) -> ScreenResult:
    """Combine the p-values of two tests whether a scene changes with time, by Fisher's method.

    One test has the views from repeated camera positions, the other has all other views. The combined p-value is q (1 -
    ln q), where q is the product of the two p-values.
    """
    reason = f"{fixed.reason}; of the other views, {loose.reason}"
    if OFF == fixed.decision == loose.decision:
        return ScreenResult(OFF, reason, loose.p, loose.z, loose.free)
    tested = [one for one in (fixed, loose) if one.p is not None and not (one is loose and _is_blind(loose))]
    if not tested:
        return ScreenResult(UNDECIDED, reason, free=loose.free)
    if len(tested) == 1:
        p, z = tested[0].p, tested[0].z
    else:
        q = math.prod(one.p or 1.0 for one in tested)
        p, z = q * (1 - math.log(q)), sum(one.z or 0.0 for one in tested) / math.sqrt(2)
        reason += f"; together p = {p:.3f}"
    return ScreenResult(ON if p is not None and p <= LEVEL else UNDECIDED, reason, p, z, loose.free)


def _is_blind(loose: ScreenResult) -> bool:
    """Return whether time and camera position are so correlated that the test for change with time says nothing."""
    return loose.free is not None and loose.free < LEAST_FREE
