"""Decide before a training, by a permutation test, whether a scene changes with time.

Images from the same camera position are compared with one another (gsbench.gates.fixed_camera_test).

For other views, a static 3DGS is fitted in a few steps. If the scene moves, the gradients of the views' squared errors
with respect to the means of the Gaussians change slowly with time. The test measures the share of these gradients that
follows four slow cosines of time, cos(pi k t) with k = 1 .. 4. It compares this share with the shares under random
permutations of time (Freedman and Lane 1983). The influence of the camera position is removed by regression first. If
the camera moves along with time, as on an orbit, the two influences cannot be separated, and the answer is undecided.
"""

import math
import time
from dataclasses import replace

import numpy as np
import torch

from gsbench.errors import InputError
from gsbench.gates.fixed_camera_test import compare_images
from gsbench.gates.permutation_test import follow_time
from gsbench.gates.shared_viewpoints import Viewpoints, group_by_viewpoint
from gsbench.gates.static_fit_residuals import camera_basis, gradient_products, smaller
from gsbench.measure.record import TimeScreen
from gsbench.scenes import Scene

LEVEL = 0.01  # the scene changes with time if the p-value is at most this
LEAST_FREE = 0.5  # least share of the variance of the cosines of time that the camera position does not explain
LEAST_VIEWS = 12
ON, OFF, UNDECIDED = "on", "off", "undecided"


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
    answer = _screen(scene, seed, backend)
    return replace(answer, seconds=time.perf_counter() - started)


def import_compiler() -> None:
    """Create a torch optimizer so that torch imports its compiler now, before the run time of the test is measured.

    The import takes a second. Otherwise the first optimizer of the test would trigger the import.
    """
    torch.optim.Adam([torch.zeros(1)])


def _screen(scene: Scene, seed: int, backend: str) -> TimeScreen:
    """Test whether the scene changes with time, on views that share a camera position, on other views, or on both."""
    views = scene.train
    if not scene.has_time:
        return TimeScreen(OFF, "the views have no times")
    if len({view.time for view in views}) == 1:
        return TimeScreen(UNDECIDED, "all training views have the same time")
    if len(views) < LEAST_VIEWS:
        return TimeScreen(UNDECIDED, f"{len(views)} training views are too few; {LEAST_VIEWS} are needed")
    viewpoints = group_by_viewpoint(views, scene.extent)
    answers = []
    if viewpoints.fixed:
        answers.append(_screen_fixed(scene, viewpoints, seed))
    if len(viewpoints.loose) >= LEAST_VIEWS:
        answers.append(_screen_loose(scene, viewpoints, seed, backend))
    return answers[0] if len(answers) == 1 else _both(*answers)


def _screen_fixed(scene: Scene, viewpoints: Viewpoints, seed: int) -> TimeScreen:
    """Test for change with time by comparing the images that were taken from the same camera position."""
    result = compare_images(scene.train, viewpoints.fixed, seed)
    count = len(viewpoints.fixed)
    where = f"the images of each of {count} camera positions" if count > 1 else "the images of the camera's position"
    if not result.changed:
        return TimeScreen(OFF, f"{where} differ by exposure and noise only")
    share = f"{result.changed:.0%}" if result.changed >= 0.01 else "less than 1%"
    blocks = f"{share} of their blocks"
    if result.p is None:
        return TimeScreen(UNDECIDED, f"{where} differ in {blocks}, but are too few to test for a change over time")
    if result.p <= LEVEL:
        return TimeScreen(ON, f"{where} change over time, in {blocks} (p = {result.p:.3f})", result.p, result.z)
    reason = f"{where} differ in {blocks}, but not clearly over time (p = {result.p:.3f})"
    return TimeScreen(UNDECIDED, reason, result.p, result.z)


def _screen_loose(scene: Scene, viewpoints: Viewpoints, seed: int, backend: str) -> TimeScreen:
    """Test for change with time by the residuals of a static 3DGS, fitted to views without a common camera position.

    If some of these views are from held cameras, only those are used.
    """
    indices = [v for group in viewpoints.held for v in group] or viewpoints.other
    views = [smaller(scene.train[v]) for v in indices]
    times = np.array([view.time for view in views], dtype=np.float64)
    ends = np.cumsum([len(group) for group in viewpoints.held])  # views of a held camera are next to each other
    held = [list(range(end - len(group), end)) for end, group in zip(ends, viewpoints.held, strict=True)]
    # The influence that the test removes: [V, P] 1 for a view from a position, or functions of the camera.
    camera = np.repeat(np.eye(len(held)), list(map(len, held)), axis=0) if held else camera_basis(views)
    test = follow_time(gradient_products(views, scene, seed, backend), times, camera, seed, held)
    if test.free < LEAST_FREE:
        reason = (
            f"the camera moves along with time, so that only {test.free:.0%} of a slow change can be told from "
            f"its motion; {LEAST_FREE:.0%} are needed"
        )
        return TimeScreen(UNDECIDED, reason, test.p, test.z, test.free)
    if test.p <= LEVEL:
        decision, reason = ON, f"a static model's error changes over time (p = {test.p:.3f})"
    elif held:
        decision = UNDECIDED
        reason = (
            f"the cameras of {len(held)} positions move a little, and a static model's error does not clearly "
            f"change over time (p = {test.p:.3f})"
        )
    else:
        decision, reason = OFF, f"a static model's error does not change over time (p = {test.p:.3f})"
    return TimeScreen(decision, reason, test.p, test.z, test.free)


def _both(fixed: TimeScreen, loose: TimeScreen) -> TimeScreen:
    """Combine two tests whether a scene changes with time.

    One test has the views from repeated camera positions, the other has all other views. The combined p-value is q (1 -
    ln q), where q is the product of the two p-values (Fisher). z-scores are added and divided by sqrt 2 (Stouffer).
    The answer is `off` only if both tests say so, because each sees only a part of the views.
    """
    reason = f"{fixed.reason}; of the other views, {loose.reason}"
    if OFF == fixed.decision == loose.decision:  # `fixed` has no p-value then
        return TimeScreen(OFF, reason, loose.p, loose.z, loose.free)
    is_blind = loose.free is not None and loose.free < LEAST_FREE  # time and camera position are too correlated
    usable = [fixed] if is_blind else [fixed, loose]
    tested = [(answer.p, answer.z) for answer in usable if answer.p is not None and answer.z is not None]
    if not tested:
        return TimeScreen(UNDECIDED, reason, free=loose.free)
    if len(tested) == 1:
        p, z = tested[0]
    else:
        q = math.prod(p for p, _ in tested)
        p, z = q * (1 - math.log(q)), sum(z for _, z in tested) / math.sqrt(2)
        reason += f"; together p = {p:.3f}"
    return TimeScreen(ON if p <= LEVEL else UNDECIDED, reason, p, z, loose.free)
