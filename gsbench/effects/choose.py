"""Test whether a scene changes with time, before any training of the model that would simulate it.

A static 3DGS is fitted for a moment. If the scene moves, what the fit leaves over depends on time: the gradients of the
squared errors of the training views by the Gaussians' means follow slow waves of time. The test compares their energy
in those waves with that under random permutations of time (Freedman and Lane 1983), so it needs no threshold that
depends on the scene. What the camera's place explains is taken out of both first: where the camera moves along with
time, as on an orbit, little of the waves is left, and the answer is that nothing can be decided.

Direction and AGR have no such test: docs/effects.md says why. They are admitted, and gsbench.effects.gate keeps them
where they pay.
"""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from gsbench.backends import resolve
from gsbench.errors import InputError
from gsbench.kernels.tape import Tape
from gsbench.lanes import side_by_side
from gsbench.measure.record import TimeScreen
from gsbench.models.appearance import sh_basis
from gsbench.models.gaussians3d import Gaussians3DModel
from gsbench.models.query import Query, unit
from gsbench.models.render import rasterize_slice
from gsbench.scenes import Camera, Points, Scene, View
from gsbench.scenes.points import frustum_points

LONG_SIDE = 40  # pixels of the images that the screen looks at, at least
POINTS = 2_000
STEPS = 50
BATCH = 4  # views in a step
RATES = {"means": 2e-3, "scales": 2e-2, "quats": 1e-2, "opacities": 5e-2, "sh0": 5e-2}  # means: parts of the extent
WAVES = 4  # cos(pi k t), k = 1 .. WAVES
CAMERA_DEGREE = 2  # of the harmonics of the camera's direction that are taken out
PERMUTATIONS = 999
LEVEL = 0.01  # time is on where p is at most this
LEAST_FREE = 0.5  # share of the waves' variance that the camera must leave free
LEAST_VIEWS = 12
# A point nearest to all optical axes is the scene's centre if they pass it within this part of its depth.
NEAR_AXES = 0.5
RADIUS = 0.4  # of the points around the centre, in distances of the cameras

Array = NDArray[np.float64]


def screen(scene: Scene, seed: int = 0, backend: str = "auto") -> TimeScreen:
    """Decide from its training views whether a scene changes with time.

    Args:
        scene: its training views are looked at, at LONG_SIDE pixels.
        seed: of the points and the permutations.
        backend: renders the static fit; see `gsbench.backends.resolve`.

    Raises:
        InputError: the scene has no training view.
    """
    import_compiler()
    started = time.perf_counter()
    if not scene.train:
        raise InputError(f"{scene.name}: expected training views to look at, there are none")

    def conclude(decision: str, reason: str, found: "Evidence | None" = None) -> TimeScreen:
        p, z, free = (found.p, found.z, found.free) if found else (None, None, None)
        return TimeScreen(decision, reason, p, z, free, time.perf_counter() - started)

    if not scene.has_time:
        return conclude("off", "the views have no times")
    times = np.array([view.time for view in scene.train], dtype=np.float64)
    if len(set(times.tolist())) == 1:
        return conclude("undecided", "all training views are of one time")
    if len(times) < LEAST_VIEWS:
        return conclude("undecided", f"{len(times)} training views are too few to tell, {LEAST_VIEWS} are needed")
    views = [_smaller(view) for view in scene.train]
    found = evidence(_leftovers(views, scene, seed, backend), times, _camera_basis(views), seed)
    if found.free < LEAST_FREE:
        return conclude("undecided", f"the camera moves along with time: it leaves {found.free:.0%} of time's slow "
                                     f"waves free, {LEAST_FREE:.0%} are needed", found)  # fmt: skip
    said = f"p = {found.p:.3f}, z = {found.z:.1f}, {found.free:.0%} of time's slow waves are free of the camera"
    if found.p <= LEVEL:
        return conclude("on", f"what a static fit leaves over changes with time ({said})", found)
    return conclude("off", f"what a static fit leaves over does not change with time ({said})", found)


def import_compiler() -> None:
    """Let torch import its compiler, as the first optimizer of a process does, before a clock starts.

    It takes a second that is not the screen's: a training makes its optimizer before its clock starts, too.
    """
    torch.optim.Adam([torch.zeros(1)])


# ---- the test


@dataclass(frozen=True)
class Evidence:
    """The result of the permutation test."""

    p: float
    z: float
    free: float


def evidence(
    leftovers: Array,  # [V, V] Gram matrix of the views' gradients
    times: Array,  # [V] in [0, 1]
    camera: Array,  # [V, B] what the camera explains, with a constant
    seed: int,
) -> Evidence:
    """Test whether gradients follow slow waves of time, given what the camera explains (Freedman and Lane 1983).

    Args:
        leftovers: g_v . g_w for all pairs of views.
        times: of the views.
        camera: functions of the camera; their span is taken out of gradients and waves.
        seed: of the permutations.
    """
    waves = np.cos(math.pi * np.outer(times, np.arange(1, WAVES + 1)))
    waves = waves - waves.mean(0)
    known = _range(camera)
    own = waves - known @ (known.T @ waves)
    free = float(np.square(own).sum() / max(np.square(waves).sum(), 1e-300))
    slow = _range(own)
    residual = np.eye(len(times)) - known @ known.T
    gram = residual @ leftovers @ residual
    total = float(np.trace(gram))
    random = np.random.default_rng(seed)

    def share(rows: NDArray[np.int64]) -> float:
        """Share of energy in the slow waves, of what is left once the camera is taken out of permuted leftovers too."""
        turned = np.concatenate([slow, known], 1)[rows]
        energies = np.einsum("vk,vk->k", turned, gram @ turned)
        left = total - energies[slow.shape[1] :].sum()
        return float(energies[: slow.shape[1]].sum() / left) if left > 0 else 0.0

    actual = share(np.arange(len(times)))
    null = np.array([share(random.permutation(len(times))) for _ in range(PERMUTATIONS)])
    p = (1 + int((null >= actual).sum())) / (1 + PERMUTATIONS)
    spread = float(null.std())
    return Evidence(p, (actual - float(null.mean())) / spread if spread > 0 else 0.0, free)


def _range(columns: Array) -> Array:
    """Return an orthonormal basis [V, R] of what columns [V, B] span."""
    left, values, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(left[:, values > 1e-6 * max(values.max(initial=0.0), 1e-300)])


# ---- what a static fit leaves over


def _leftovers(views: Sequence[View], scene: Scene, seed: int, backend: str) -> Array:
    """Fit 3DGS of degree 0 for STEPS steps; return the Gram matrix [V, V] of the views' gradients by the means."""
    random = torch.Generator().manual_seed(seed)
    points = scene_points(views, scene, random)
    device = views[0].camera.viewmat.device
    model = Gaussians3DModel(sh_degree=0, backend=resolve(backend, device.type))
    model.initialise(points, scene.extent, random)
    model.to(device)
    background = torch.tensor(scene.background, device=device)
    groups = [{"params": [model.splats[name]], "lr": rate * (scene.extent if name == "means" else 1.0)}
              for name, rate in RATES.items()]  # fmt: skip
    adam = torch.optim.Adam(groups, eps=1e-15)
    fitted = [model.splats[name] for name in RATES]
    lanes = model.backend.lanes(fitted[0])
    of_view = partial(_gradients, model, fitted, background)
    for _ in range(STEPS):
        chosen = torch.randint(len(views), (BATCH,), generator=random).tolist()
        by_view = list(side_by_side(of_view, [views[i] for i in chosen], lanes))
        for parameter, gradients in zip(fitted, zip(*by_view, strict=True), strict=True):
            parameter.grad = torch.stack(gradients).mean(0)
        adam.step()
    rows = [gradients[0].flatten() for gradients in side_by_side(of_view, views, lanes)]
    matrix = torch.stack(rows).double().cpu().numpy()
    return np.asarray(matrix @ matrix.T)


def _gradients(model: Gaussians3DModel, by: list[nn.Parameter], background: Tensor, view: View) -> list[Tensor]:
    """Compute the gradients of a view's mean squared error by some parameters."""
    with Tape() as tape:
        gaussians = model.slice(Query.of(view.camera, None))
        image = rasterize_slice(gaussians, view.camera, background, model.backend).image
    found: dict[int, Tensor] = {}
    residual = image.detach() - view.image
    tape.backward(image, 2 / residual.numel() * residual, by, found)
    return [found.get(id(parameter), torch.zeros_like(parameter)) for parameter in by]


def _smaller(view: View) -> View:
    """Return a view whose longer side has LONG_SIDE pixels or a few more."""
    camera = view.camera
    factor = max(1, max(camera.width, camera.height) // LONG_SIDE)
    height, width = camera.height // factor, camera.width // factor
    image = view.image[: height * factor, : width * factor].permute(2, 0, 1)[None]
    K = camera.K.clone()
    K[:2] /= factor
    return replace(
        view,
        camera=Camera(camera.viewmat, K, width, height),
        pixels=F.avg_pool2d(image, factor)[0].permute(1, 2, 0).contiguous(),
    )


def scene_points(views: Sequence[View], scene: Scene, random: torch.Generator) -> Points:
    """Choose POINTS points to start a fit from: of those given with the scene, else where the cameras look."""
    if scene.points is not None:
        chosen = torch.randperm(len(scene.points.means), generator=random)[:POINTS]
        return Points(scene.points.means[chosen], scene.points.colors[chosen])
    center = _center(views)
    if center is None:
        return frustum_points(POINTS, [view.to("cpu").camera for view in views], scene.extent, random)
    distance = torch.stack([view.camera.center for view in views]).cpu().sub(center).norm(dim=-1).mean()
    offset = torch.rand(POINTS, 3, generator=random) * 2 - 1
    return Points(center + RADIUS * distance * offset, torch.full((POINTS, 3), 0.5))


def _center(views: Sequence[View]) -> Tensor | None:
    """Return the point nearest to all optical axes, [3]; None where they do not meet before the cameras."""
    centers = torch.stack([view.camera.center for view in views]).cpu().double()
    axes = torch.stack([view.camera.viewmat[2, :3] for view in views]).cpu().double()
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None, :]
    total = across.mean(0)
    if float(torch.linalg.cond(total)) > 1e3:  # parallel axes meet nowhere
        return None
    meeting = torch.linalg.solve(total, (across @ centers[:, :, None]).mean(0)[:, 0])
    depth = ((meeting - centers) * axes).sum(-1)
    miss = (across @ (meeting - centers)[:, :, None])[..., 0].norm(dim=-1)
    return meeting.float() if bool((depth > 0).all() and (miss < NEAR_AXES * depth).all()) else None


def _camera_basis(views: Sequence[View]) -> Array:
    """Compute harmonics [V, 9] of the direction in which each camera lies from the middle of what they look at."""
    center = _center(views)
    centers = torch.stack([view.camera.center for view in views]).cpu()
    if center is None:  # cameras side by side: seen from so far in front of them that all lie close together
        axes = torch.stack([view.camera.viewmat[2, :3] for view in views]).cpu()
        spread = (centers - centers.mean(0)).norm(dim=-1).mean()
        center = centers.mean(0) + 3 * spread * axes.mean(0)
    return np.asarray(sh_basis(unit((centers - center).double()), CAMERA_DEGREE).numpy())
