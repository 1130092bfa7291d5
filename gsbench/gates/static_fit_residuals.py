"""Fit a static 3DGS in a few steps, and compute gradients of each view's error with respect to the Gaussians' means."""

from collections.abc import Sequence
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from gsbench.kernels.backends import resolve
from gsbench.kernels.tape import Tape
from gsbench.models.appearance import sh_basis
from gsbench.models.camera_time import CameraTime, unit
from gsbench.models.gaussians3d import Gaussians3DModel
from gsbench.models.render import rasterize_slice
from gsbench.process.workers import side_by_side
from gsbench.scenes import Points, Scene, View
from gsbench.scenes.points import frustum_points
from gsbench.train.batches import reduced

LONG_SIDE = 40  # least length in pixels of the longer side of a fitted image, if the image is not smaller
POINTS = 2_000
STEPS = 50
BATCH = 4  # views in a step
RATES = {"means": 2e-3, "scales": 2e-2, "quats": 1e-2, "opacities": 5e-2, "sh0": 5e-2}  # means: times the extent
CAMERA_DEGREE = 2  # SH degree of the functions of camera direction that are removed from the gradients by regression
# The point nearest to all optical axes is the scene's centre if each axis passes it within this part of its depth.
NEAR_AXES = 0.5
RADIUS = 0.4  # half width of the cube of initial points, as a part of the distance of the cameras

Array = NDArray[np.float64]


def gradient_products(views: Sequence[View], scene: Scene, seed: int, backend: str) -> Array:
    """Fit a static 3DGS to V views for STEPS steps, and return the scalar products of the views' gradients, [V, V].

    The gradient of a view is that of its squared error with respect to the means of the Gaussians, after the fit. If
    the scene moves, a view's gradient says where each Gaussian should be at its time, so that gradients of views at
    close times are alike. `gsbench.gates.permutation_test` tests this, and needs only the products of the gradients.
    """
    random = torch.Generator().manual_seed(seed)
    points = scene_points(views, scene, random)
    device = views[0].camera.viewmat.device
    model = Gaussians3DModel(sh_degree=0, backend=resolve(backend, device.type))
    model.initialise(points, scene.extent, random)
    model.to(device)
    background = torch.tensor(scene.background, device=device)
    groups = [
        {"params": [model.splats[name]], "lr": rate * (scene.extent if name == "means" else 1.0)}
        for name, rate in RATES.items()
    ]
    adam = torch.optim.Adam(groups, eps=1e-15)
    fitted = [model.splats[name] for name in RATES]  # means first
    workers = model.backend.workers(fitted[0])
    gradients_of = partial(_gradients, model, fitted, background)
    for _ in range(STEPS):
        chosen = torch.randint(len(views), (BATCH,), generator=random).tolist()
        by_view = list(side_by_side(gradients_of, [views[i] for i in chosen], workers))
        for parameter, gradients in zip(fitted, zip(*by_view, strict=True), strict=True):  # one gradient of each view
            parameter.grad = torch.stack(gradients).mean(0)
        adam.step()
    of_means = [by_parameter[0].flatten() for by_parameter in side_by_side(gradients_of, views, workers)]
    matrix = torch.stack(of_means).double().cpu().numpy()  # [V, 3 POINTS]
    return np.asarray(matrix @ matrix.T)


def _gradients(model: Gaussians3DModel, parameters: list[nn.Parameter], background: Tensor, view: View) -> list[Tensor]:
    """Compute the gradients of a view's mean squared error with respect to some parameters of a 3DGS model."""
    with Tape() as tape:
        gaussians = model.slice(CameraTime.of(view.camera, None))
        image = rasterize_slice(gaussians, view.camera, background, model.backend).image
    gradients: dict[int, Tensor] = {}
    residual = image.detach() - view.image
    by_image = 2 / residual.numel() * residual  # the gradient of the mean of residual^2
    tape.backward(image, by_image, parameters, gradients)
    return [gradients.get(id(parameter), torch.zeros_like(parameter)) for parameter in parameters]


def smaller(view: View) -> View:
    """Shrink a view by an integer factor to a longer side of LONG_SIDE pixels or a few more, so that a fit is fast."""
    return reduced(view, max(1, max(view.camera.width, view.camera.height) // LONG_SIDE))


def scene_points(views: Sequence[View], scene: Scene, random: torch.Generator) -> Points:
    """Return POINTS initial points for a fit: a random subset of the scene's points, or points around its centre."""
    if scene.points is not None:
        chosen = torch.randperm(len(scene.points.means), generator=random)[:POINTS]
        return Points(scene.points.means[chosen], scene.points.colors[chosen])
    center = center_of(views)
    if center is None:
        return frustum_points(POINTS, [view.to("cpu").camera for view in views], scene.extent, random)
    distance = torch.stack([view.camera.center for view in views]).cpu().sub(center).norm(dim=-1).mean()
    offset = torch.rand(POINTS, 3, generator=random) * 2 - 1
    return Points(center + RADIUS * distance * offset, torch.full((POINTS, 3), 0.5))


def center_of(views: Sequence[View]) -> Tensor | None:
    """Return the point [3] nearest to all optical axes; None if the axes do not nearly meet in front of the cameras.

    The sum of squared distances |A_v (x - c_v)|^2, where A_v = I - a_v a_v^T for the axis a_v through the camera's
    centre c_v, is smallest where the sum of A_v (x - c_v) is zero.
    """
    centers = torch.stack([view.camera.center for view in views]).cpu().double()  # [V, 3]
    axes = torch.stack([view.camera.viewmat[2, :3] for view in views]).cpu().double()  # [V, 3]
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None, :]  # [V, 3, 3] A_v
    total = across.mean(0)
    if float(torch.linalg.cond(total)) > 1e3:  # parallel axes meet nowhere
        return None
    meeting = torch.linalg.solve(total, (across @ centers[:, :, None]).mean(0)[:, 0])
    depth = ((meeting - centers) * axes).sum(-1)
    miss = (across @ (meeting - centers)[:, :, None])[..., 0].norm(dim=-1)  # distance from each axis
    return meeting.float() if bool((depth > 0).all() and (miss < NEAR_AXES * depth).all()) else None


def camera_basis(views: Sequence[View]) -> Array:
    """Compute the spherical harmonics up to degree 2 of each camera's direction from the scene's centre, [V, 9].

    What the residuals share with them is an effect of view direction, which the test of time leaves out.
    """
    center = center_of(views)
    centers = torch.stack([view.camera.center for view in views]).cpu()
    if center is None:  # cameras side by side: a point in front of them, 3 times as far away as they are spread
        axes = torch.stack([view.camera.viewmat[2, :3] for view in views]).cpu()
        spread = (centers - centers.mean(0)).norm(dim=-1).mean()
        center = centers.mean(0) + 3 * spread * axes.mean(0)
    return np.asarray(sh_basis(unit((centers - center).double()), CAMERA_DEGREE).numpy())
