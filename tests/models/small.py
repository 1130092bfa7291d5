"""Small models for the tests: every registered one and its variants, fresh or in the midst of a training."""

from typing import Any

import torch
from torch import Tensor

from gsbench.kernels.headers import ALPHA_MIN
from gsbench.models import CameraTime, GaussianModel, build
from gsbench.scenes.scene import Points

N = 24
EXTENT = 2.0
CAMERA = torch.tensor([0.3, -0.2, -4.0], dtype=torch.float64)
MODELS: dict[str, dict[str, Any]] = {
    "3dgs": {},
    "4dgs": {"lambda_t": 0.5},
    "6dgs": {"lambda_d": 0.35, "directional_half": False},
    "7dgs": {"lambda_t": 0.5, "lambda_d": 0.3},
    "7dgs_nodir": {"lambda_t": 0.5},
}
TRIANGULAR = ("6dgs", "7dgs", "7dgs_nodir")
VARIANTS: dict[str, tuple[str, dict[str, Any]]] = {
    **{name: (name, options) for name, options in MODELS.items()},
    **{f"{name}_agr": (name, options | {"agr": True}) for name, options in MODELS.items()},
    "4dgs_constant_colors": ("4dgs", {"time_degree": 0}),
    **{f"{name}_paper": (name, MODELS[name] | {"factor_order": "paper"}) for name in TRIANGULAR},
    **{
        f"{name}_{form}": (name, MODELS[name] | {"off_diagonal": form})
        for name in TRIANGULAR
        for form in ("raw", "row_scaled")
    },
}


def seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def started(model: GaussianModel, count: int = N, seed: int = 0) -> GaussianModel:
    """A model that was just built, with Gaussians at random points."""
    g = seeded(seed)
    model.initialise(Points(torch.rand(count, 3, generator=g) * 2 - 1, torch.rand(count, 3, generator=g)), EXTENT, g)
    return model


def moved(model: GaussianModel, seed: int = 0) -> GaussianModel:
    """The model in float64, with every raw parameter moved and networks that say something."""
    model, g = model.double(), seeded(seed + 1)
    with torch.no_grad():
        for parameter in model.splats.values():
            parameter += 0.3 * torch.randn(parameter.shape, generator=g, dtype=torch.float64)
        if model.refinement is not None:
            for parameter in (model.refinement.weight_out, model.refinement.bias_out):
                parameter += 0.05 * torch.randn(parameter.shape, generator=g, dtype=torch.float64)
    return model


def fresh(variant: str, count: int = N, seed: int = 0, **options: Any) -> GaussianModel:
    """A model as it starts, in float32."""
    name, own = VARIANTS[variant]
    return started(build(name, **own | options), count, seed)


def lively(variant: str, count: int = N, seed: int = 0, **options: Any) -> GaussianModel:
    """A model in the midst of a training, in float64."""
    return moved(fresh(variant, count, seed, **options), seed)


def assert_culled_outside_its_intervals(model: GaussianModel, times: Tensor, exact: bool) -> None:
    """A Gaussian has too low an opacity outside its visible interval and, if `exact`, only there."""
    intervals = model.visible_intervals()
    assert intervals is not None
    first, last = intervals.unbind(1)
    hidden = 0
    for time in times:
        opacities = model.slice(CameraTime.at(CAMERA, time)).opacities
        outside = (time < first) | (time > last)
        assert (opacities[outside] < ALPHA_MIN * (1 + 1e-9)).all()
        hidden += int(outside.sum())
        if exact:
            assert (opacities[~outside] > ALPHA_MIN * (1 - 1e-9)).all()
    assert 0 < hidden < len(times) * len(model)


def raw(model: GaussianModel) -> dict[str, Tensor]:
    """The raw parameters, detached copies."""
    return {name: parameter.detach().clone() for name, parameter in model.splats.items()}


def joint(model: GaussianModel) -> Tensor:
    """Covariance of each Gaussian of a triangular model, rows and columns ordered (p, d, t)."""
    factor = model.factors(raw(model))
    return factor @ factor.mT
