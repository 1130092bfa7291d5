"""List the public functions that take tensors, each with arguments that it accepts."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from cases import camera, gaussians
from torch import Tensor

from gsbench.kernels.colors import show_colors
from gsbench.kernels.loss import l1_ssim
from gsbench.kernels.refine import HIDDEN, refine
from gsbench.kernels.slices import (
    slice_direct,
    slice_direct_beta,
    slice_free_time,
    slice_rotated,
    slice_static,
    slice_triangular,
    slice_universal,
)
from gsbench.measure.quality import evaluate, psnr, psnr_channel_mean, quantise, ssim
from gsbench.models import CameraTime, build
from gsbench.models.render import render
from gsbench.models.slicing import slice_gaussians
from gsbench.raster import rasterize
from gsbench.scenes import Camera
from gsbench.scenes.points import nearest_distances, random_points

N = 6
MODELS: dict[str, dict[str, Any]] = {
    "3dgs": {},
    "4dgs": {"time_degree": 2, "scheme": "square_root", "lambda_t": 1.0},
    "6dgs": {"lambda_d": 0.5, "factor_order": "paper", "scheme": "schur", "off_diagonal": "raw"},
    "7dgs": {"lambda_d": 0.5, "lambda_t": 0.5, "directional_half": True},
}


@dataclass(frozen=True)
class Target:
    """A function and arguments that it accepts, by name; the tensors among them are float32 but where it says so."""

    function: Callable[..., Any]
    arguments: dict[str, Any]
    constant: tuple[str, ...] = ()  # tensors by which there is no gradient


def targets() -> dict[str, Target]:
    g = torch.Generator().manual_seed(0)

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=g)

    def rows(**widths: int) -> dict[str, Tensor]:
        return {name: rand(N, width) for name, width in widths.items()}

    scene = {key: x.float() if isinstance(x, Tensor) else x for key, x in (gaussians(g, N) | camera(20, 12)).items()}
    images = {"a": rand(12, 13, 3), "b": rand(12, 13, 3)}
    common = {"means": rand(N, 3), "opacities": rand(N)}
    static = {**rows(scales=3, quats=4), "opacities": rand(N)}
    rotated = common | rows(times=1, scales=4, left_quats=4, right_quats=4)
    rotated |= {"clock": torch.tensor(2.0), "time": torch.tensor(0.5), "log_lambda_t": torch.tensor(0.1)}
    triangular = common | rows(directions=3, times=1, log_diagonal=7, shape=3, motion=12, coupling=6)
    triangular |= {"center": rand(3), "time": torch.tensor(0.5), "conditioned_first": True}
    triangular |= {"log_lambda_d": torch.tensor(0.1), "log_lambda_t": torch.tensor(0.1)}
    universal = common | rows(directions=3, times=1, scales=7, skew=3, lower=18, betas=5)
    universal |= {"center": rand(3), "time": torch.tensor(0.5)}
    timed = {**rows(times=1), "time": torch.tensor(0.5)}
    free = common | static | timed | rows(durations=1, velocities=3)
    coupled = common | timed | rows(directions=3, scales=3, precision=7, coupling=12) | {"center": rand(3)}
    direct = coupled | rows(quats=4, shares=2)
    direct_beta = coupled | rows(skew=3, betas=5)
    colors = {**common, "sh0": rand(N, 1, 3), "shN": rand(N, 15, 3), "center": rand(3), "degree": 3}
    moved = rows(a=3, b=7) | {"weight_in": rand(2 * HIDDEN, 5), "bias_in": rand(2 * HIDDEN)}
    moved |= {"weight_out": rand(10, HIDDEN), "bias_out": rand(10), "units": rand(10) + 1, "gamma": rand(2)}
    joint = {"mean": rand(N, 7), "factor": rand(N, 7, 7) + 2 * torch.eye(7), "query": rand(N, 4)}
    joint["scheme"] = "square_root"
    model = {"agr": True, "agr_octaves": 4, "sh_degree": 2, "time": 0.5, "center": torch.tensor([0.0, 0.0, -4.0])}
    models = {name: Target(_model, {"name": name, **options, **model}, ("center",)) for name, options in MODELS.items()}
    return models | {
        "rasterize": Target(rasterize, {**scene, "background": rand(3), "backend": "cpu"}, ("Ks",)),
        "rasterize by auto": Target(rasterize, {**scene, "background": rand(3), "antialias": True}, ("Ks",)),
        "rasterize by reference": Target(rasterize, {**scene, "near": 0.1, "backend": "reference"}, ("Ks",)),
        "slice_gaussians": Target(slice_gaussians, joint),
        "slice_static": Target(slice_static, static),
        "slice_rotated": Target(slice_rotated, rotated, ("clock", "time")),
        "slice_triangular": Target(slice_triangular, triangular, ("center", "time")),
        "slice_universal": Target(slice_universal, universal, ("center", "time")),
        "slice_direct": Target(slice_direct, direct, ("center", "time")),
        "slice_direct_beta": Target(slice_direct_beta, direct_beta, ("center", "time")),
        "slice_free_time": Target(slice_free_time, free, ("time",)),
        "show_colors": Target(show_colors, colors, ("center", "opacities")),
        "l1_ssim": Target(
            l1_ssim, {"image": rand(12, 13, 3), "target": rand(12, 13, 3), "ssim_weight": 0.2}, ("target",)
        ),
        "refine": Target(_refine, moved, ("units", "gamma")),
        "psnr": Target(psnr, images, ("a", "b")),
        "psnr_channel_mean": Target(psnr_channel_mean, images, ("a", "b")),
        "ssim": Target(ssim, images, ("a", "b")),
        "quantise": Target(quantise, {"image": rand(12, 13, 3)}, ("image",)),
        "evaluate": Target(_evaluate, images, ("a", "b")),
        "nearest_distances": Target(nearest_distances, {"means": rand(N, 3)}, ("means",)),
    }


@torch.enable_grad()
def _model(name: Any, center: Any, time: Any, **options: Any) -> list[Tensor]:
    """Build a model, slice it from a place and return its image; the gradients of its parameters are finite."""
    model, g = build(name, **options), torch.Generator().manual_seed(0)
    model.initialise(random_points(20, 1.0, g), 1.0, g)
    means = model.slice(CameraTime.at(center, time)).means.detach()
    viewmat, K = torch.eye(4), torch.tensor([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]])
    viewmat[2, 3] = 4.0
    image = render(model, Camera(viewmat, K, 16, 16), time, torch.zeros(3))
    image.sum().backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in model.parameters())
    return [image.detach(), means]


def _refine(a: Any, b: Any, **layers: Any) -> list[Tensor]:
    return refine([a, b], **layers)


def _evaluate(a: Any, b: Any) -> float | None:
    return evaluate([("view", a, b)], background=(0.0, 0.5, 1.0)).metrics["psnr"]
