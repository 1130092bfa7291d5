"""Every model that has a kernel for its slice, with raw parameters of which some are beyond where they stop."""

from copy import deepcopy
from typing import Any

import torch
from torch import Tensor

from gsbench.models import CameraTime, GaussianModel, build
from gsbench.models.cholesky import CholeskyModel
from gsbench.models.gaussian_batch import tensors_of
from gsbench.models.gaussians4d import Gaussians4DModel
from gsbench.models.moving import MovingGaussians3D
from gsbench.scenes.scene import Points

Raw = dict[str, Tensor]
CENTER, TIME = torch.tensor([0.3, -0.2, -3.0]), torch.tensor(0.4)
OPTIONS: dict[str, tuple[dict[str, Any], ...]] = {  # the options of each model that change its kernel
    "7dgs": (
        {},
        {"factor_order": "paper"},
        {"off_diagonal": "raw"},
        {"off_diagonal": "row_scaled"},
        {"factor_order": "paper", "off_diagonal": "raw"},
        {"scheme": "cholesky"},
        {"scheme": "cholesky", "factor_order": "paper"},
    ),
    "6dgs": (
        {},
        {"factor_order": "paper", "off_diagonal": "row_scaled", "directional_half": False},
        {"scheme": "cholesky", "off_diagonal": "row_scaled"},
    ),
    "7dgs_nodir": ({}, {"factor_order": "paper"}, {"off_diagonal": "row_scaled"}, {"scheme": "cholesky"}),
    **dict.fromkeys(("4dgs", "3dgs", "ubs", "ubs_static", "dgs", "dbs", "dbs_static"), ({},)),
    **dict.fromkeys(("freetime", "freetime_plus", "sharptime", "stg", "stg_full"), ({},)),
    "ex4dgs": ({"dynamic_share": 0.5, "intervals": 2},),
}
LAMBDAS = {"7dgs": {"lambda_d": 0.3, "lambda_t": 0.5}, "6dgs": {"lambda_d": 0.3}, "7dgs_nodir": {"lambda_t": 0.5}}
LAMBDAS["4dgs"] = {"lambda_t": 0.7}
CASES = [(name, options) for name, every in OPTIONS.items() for options in every]
SPREADS = {"betas": 0.7, "coupling": 0.5, "velocities": 0.5, "skew": 0.3, "directions": 0.7, "opacities": 2.0}


def sliced_model(name: str, options: dict[str, Any], dtype: torch.dtype, times: int = 1) -> tuple[GaussianModel, Raw]:
    """A model, and raw parameters of about 40 Gaussians or of many times as many, the same numbers in every dtype."""
    model = build(name, **options, **LAMBDAS.get(name, {}))
    raw = _raw_of(model, name, options)
    model.log_lambda.requires_grad_(True)
    if isinstance(model, Gaussians4DModel):
        model.clock.fill_(0.8)
    if dtype == torch.float32:
        model.condition = None  # nothing is left to torch
    return model.to(dtype), {
        key: x.repeat(times, *[1] * (x.dim() - 1)).to(dtype).requires_grad_() for key, x in raw.items()
    }


def _raw_of(model: GaussianModel, name: str, options: dict[str, Any]) -> Raw:
    g = torch.Generator().manual_seed(1)

    def normal(*shape: int, size: float = 1.0, mean: float = 0.0) -> Tensor:
        return mean + size * torch.randn(*shape, generator=g)

    if isinstance(model, MovingGaussians3D):
        return _moving(model, g)
    N, k = 45, {"7dgs": 4, "6dgs": 3, "7dgs_nodir": 1, "ubs": 4, "ubs_static": 3}.get(name, 0)
    raw = {"means": normal(N, 3), "opacities": normal(N, size=2)}
    if isinstance(model, CholeskyModel):
        raw |= {"log_diagonal": normal(N, k + 3, size=0.3, mean=-0.5)}
        raw |= {"shape": normal(N, 3, size=0.5), "motion": normal(N, 3 * k, size=0.5)}
        if name != "7dgs_nodir":
            raw |= {"directions": normal(N, 3), "coupling": normal(N, k * (k - 1) // 2, size=0.5)}
        if options.get("scheme") != "cholesky":  # which keeps no digits of these
            raw["log_diagonal"][3:6] = -4.0  # so narrow that next to nothing is left of them
            raw["log_diagonal"][7:9, 0] = torch.tensor([17.0, -17.0])  # beyond where the diagonal stops
    elif name == "4dgs":
        raw |= {"scales": normal(N, 4, size=0.5, mean=-1), "left_quats": normal(N, 4), "right_quats": normal(N, 4)}
        raw["scales"][:20] = -3.0  # short in time: some are culled
    elif name == "3dgs":
        raw |= {"scales": normal(N, 3, size=0.5, mean=-1), "quats": normal(N, 4)}
        raw["scales"][3:5, 0] = torch.tensor([17.0, -17.0])  # beyond where sizes stop
    else:
        raw |= {
            "directions": normal(N, 3),
            "scales": normal(N, 3 + k, mean=-1),
            "skew": normal(N, 3, size=0.5),
            "lower": normal(N, 3 * k + k * (k - 1) // 2, size=0.5),
            "betas": normal(N, 1 + k, mean=-1),
        }
        raw["betas"][:3] = 0.0  # the root of I - B is zero
        raw["betas"][3:5] = torch.tensor([17.0, -17.0])[:, None]  # beyond where exponents stop
        raw["scales"][5:7, 0] = torch.tensor([-7.0, -17.0])  # a size that 1 + e^x would round; one that stops
        raw["scales"][7:9, 3:] = -5.0  # so narrow that opacity factors are at their least
    if "time" in model.observes:
        raw["times"] = torch.rand(N, 1, generator=g)
    return raw


def _moving(model: MovingGaussians3D, g: torch.Generator) -> Raw:
    N = 45
    model.initialise(Points(torch.randn(N, 3, generator=g), torch.rand(N, 3, generator=g)), 1.0, g)
    model.before_density(CENTER[None], torch.ones(1, N, dtype=torch.bool))
    names = dict.fromkeys(("means", *model.geometry, *model.centers, *model.moving, "opacities"))
    raw = {key: model.splats[key].detach() for key in names}
    raw = {key: x + SPREADS.get(key, 0.3) * torch.randn(x.shape, generator=g) for key, x in raw.items()}
    raw["scales"] = torch.randn(N, 3, generator=g) - 1
    raw["scales"][3, 0] = -17.0  # beyond where sizes stop
    if "plateaus" in raw:  # of which some contain the time of the slice, and some make f larger than 2
        raw["plateaus"] = torch.randn(N, 1, generator=g) - 1
    for key, column in (("precision", 0), ("durations", 0), ("plateaus", 0), ("betas", 1)):
        if key in raw:
            raw[key][5:7, column] = -17.0
    if "betas" in raw:
        raw["betas"][7, 2] = 0.0  # where the weight of a shift stops
        raw["precision"][8:10, 5] = 2.0  # so narrow that the factor of the opacity stops
    return raw


def slice_of(model: GaussianModel, raw: Raw) -> list[Tensor]:
    """A slice, with F F^T in the place of F where several square factors F are right."""
    at = raw["opacities"]
    means, factors, *rest = tensors_of(model.slice_geometry(raw, CameraTime(CENTER.to(at), TIME.to(at))))
    return [means, factors @ factors.mT if "lower" in raw else factors, *rest]


def moved(model: GaussianModel, device: str) -> GaussianModel:
    return deepcopy(model).to(device, torch.float32)


def weights_of(outputs: list[Tensor]) -> list[Tensor]:
    """The same random numbers for outputs of the same shapes."""
    g = torch.Generator().manual_seed(2)
    return [torch.randn(x.shape, generator=g).to(x) for x in outputs]


def gradients(outputs: list[Tensor], inputs: list[Tensor]) -> list[Tensor]:
    """The gradients of a random sum of the outputs."""
    return list(torch.autograd.grad(outputs, inputs, weights_of(outputs), materialize_grads=True))


def assert_same(actual: list[Tensor], expected: list[Tensor]) -> None:
    """Compare by norm, and by which numbers are zero."""
    for x, y in zip(actual, expected, strict=True):
        a, b = x.detach().cpu().double(), y.detach()
        assert (a - b).norm() <= 1e-4 * b.norm() + 1e-7
        noise = 1e-6 * (b.abs().max() if b.numel() else 0) + 1e-12
        assert not ((a == 0) & (b.abs() > noise)).any(), "something is missing"
        assert not ((b == 0) & (a.abs() > noise)).any(), "something should be zero"
