"""Test the conditional 3D Gaussians that models compute in float32, against exact ones from mpmath."""

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from gsbench.kernels.backends import BACKENDS
from gsbench.kernels.headers import ALPHA_MIN
from gsbench.models import CameraTime, GaussianModel, build
from gsbench.models.gaussian_batch import tensors_of
from gsbench.models.slicing import SCHEMES, subtract
from numerics import oracle
from numerics.cases import COPIES, ONE_SCHEME, Case, Cell, backends_with, device_of, fastest, worst
from numerics.slice_cases import COUNT, COUPLINGS, JOINT, Observed, single, variables

OPTIONS: dict[str, dict[str, Any]] = {
    "6dgs": {"lambda_d": 0.35, "directional_half": False},
    "7dgs": {"lambda_d": 0.35, "lambda_t": 0.35},
} | {name: {"coupling": coupling} for name, coupling in COUPLINGS.items()}
LEAST_GRADIENT = 1e-20  # errors of a smaller gradient are relative to this, because float32 underflows


@dataclass(frozen=True)
class SliceTruth:
    """The exact conditional mean, covariance and opacity of N Gaussians, and the gradient of a loss."""

    outputs: Tensor  # [N, 13] float64: mean (3), covariance (9), opacity; [N, 14] with the exponent of a Beta profile
    weights: Tensor  # [N, 13]: the loss is the sum of weights x outputs
    scale: Tensor  # [N]: errors of the mean are divided by this
    gradient: Tensor  # [N, parameters], in the order of `Observed.raw`


@dataclass(frozen=True)
class SliceErrors:
    """The relative errors of the slices of N Gaussians."""

    forward: Tensor  # [N]
    gradient: Tensor  # [N]
    bad: Tensor  # [N] bool: not finite
    drawn: Tensor  # [N] bool: opaque enough to be rendered; of other slices only the opacity counts


def judge(case: Case, backends: list[str], schemes: Sequence[str] = SCHEMES, copies: int = COPIES) -> Iterator[Cell]:
    """Yield the errors in one case for each model, scheme and backend; timed are `copies` of the Gaussians."""
    for model in case.subjects:
        observed = case(model=model)
        exact = truth(observed)
        for scheme in schemes if model in JOINT else (ONE_SCHEME,):
            for backend in backends_with(scheme, model, backends):
                gaussians, raw = load(observed, scheme, backend)
                errors = compare(*differentiate(gaussians, raw, observed, exact.weights), exact)
                bad = errors.bad | indefinite(gaussians, raw)
                gaussians, raw = load(observed, scheme, backend, copies)
                weights = exact.weights.repeat(copies, 1)
                ms = fastest(functools.partial(differentiate, gaussians, raw, observed, weights))
                yield Cell(
                    case.area, case.name, model, scheme, backend, worst(errors.forward), worst(errors.gradient),
                    bad.double().mean().item(), ms, case.bound, f"{int(errors.drawn.sum())} of {COUNT} drawn",
                )  # fmt: skip


def truth(observed: Observed) -> SliceTruth:
    """Compute exact conditional Gaussians in mpmath, and the exact gradient of a loss.

    The loss is a random weighted sum of mean, covariance and opacity; mean and covariance are divided by their size. If
    a Gaussian is too faint to be rendered, only its opacity counts.
    """
    function = exact_slice(observed)
    rows = torch.cat([value.reshape(len(value), -1) for value in observed.raw.values()], 1).tolist()
    points = [[*x, *mean] for x, mean in zip(rows, observed.raw["means"].tolist(), strict=True)]
    outputs = torch.tensor([[float(v) for v in oracle.evaluate(function, x)] for x in points], dtype=torch.float64)
    weights, scale = weights_of(outputs, observed.raw["means"])
    gradients = [
        [float(v) for v in oracle.gradient(function, x, weight, first=len(rows[0]))]
        for x, weight in zip(points, weights.tolist(), strict=True)
    ]
    return SliceTruth(outputs, weights, scale, torch.tensor(gradients, dtype=torch.float64))


def weights_of(outputs: Tensor, means: Tensor) -> tuple[Tensor, Tensor]:
    """Return the weights of the loss of `truth`, as large as `outputs` [N, 13], and the scale of the means [N]."""
    weights = torch.randn(outputs.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    mean = means.double()
    scale = mean.norm(dim=1) + (outputs[:, :3] - mean).norm(dim=1) + outputs[:, [3, 7, 11]].sum(1).sqrt()
    weights[:, :3] /= scale[:, None]
    weights[:, 3:12] /= outputs[:, 3:12].norm(dim=1, keepdim=True)
    weights[:, 13:] /= outputs[:, 13:]
    weights[outputs[:, 12] < ALPHA_MIN, :12] = 0  # it is culled, so its mean and covariance do not matter
    return weights, scale


def exact_slice(observed: Observed) -> oracle.Function:
    """Return the mpmath function from the raw parameters of a Gaussian to its conditional 3D Gaussian.

    The time and the learned coefficients lambda_t and lambda_d are rounded to float32, because the models get them in
    float32.
    """
    layout = {name: value[0].numel() for name, value in observed.raw.items()}
    time: float | None = single(observed.time)
    options: dict[str, Any] = OPTIONS.get(observed.model, {})
    if observed.model in JOINT:
        options = {"log_lambda": {name: single(value) for name, value in observed.log_lambda.items()}}
    if observed.model in ("6dgs", "7dgs"):
        time = time if observed.model == "7dgs" else None
        options |= {"order": variables(observed.model), "half": 0.5 if observed.model == "7dgs" else 1.0}
    return functools.partial(
        oracle.SLICES[observed.family], layout=layout, center=observed.center.tolist(), time=time, **options
    )


def load(observed: Observed, scheme: str, backend: str, copies: int = 1) -> tuple[GaussianModel, dict[str, Tensor]]:
    """Make a model, and raw parameters that repeat the Gaussians of a case `copies` times."""
    name = "dgs" if observed.model in COUPLINGS else observed.model
    options = OPTIONS.get(observed.model, {}) | ({"scheme": scheme} if name in JOINT else {})
    model = build(name, backend=BACKENDS[backend], **options)
    for name, value in observed.log_lambda.items():
        model.log_lambda[name] = nn.Parameter(torch.tensor(value))
    model.to(device_of(backend))
    rows = torch.arange(len(observed.raw["means"])).repeat(copies)
    return model, {name: value[rows].requires_grad_() for name, value in observed.raw.items()}


def differentiate(
    model: GaussianModel, raw: dict[str, Tensor], observed: Observed, weights: Tensor
) -> tuple[Tensor, Tensor]:
    """Compute conditional 3D Gaussians in the type of `raw`, and the gradients of raw parameters; both as float64.

    The outputs are those of `SliceTruth`. The gradients are [N, parameters].
    """
    device = device_of(model.backend.name)
    there = {name: value.to(device) for name, value in raw.items()}
    moment = torch.tensor(observed.time).to(there["means"]) if "time" in model.observes else None
    sliced = model.slice_geometry(there, CameraTime(observed.center.to(there["means"]), moment))
    mean, F, opacity, *shapes = (x.cpu().double() for x in tensors_of(sliced))
    outputs = torch.cat([mean, (F @ F.mT).flatten(1), opacity[:, None], *(b[:, None] for b in shapes)], 1)
    gradients = torch.autograd.grad(outputs, list(raw.values()), weights, materialize_grads=True)
    return outputs.detach(), torch.cat([g.reshape(len(g), -1).double() for g in gradients], 1)


def compare(outputs: Tensor, gradient: Tensor, exact: SliceTruth) -> SliceErrors:
    """Compute the errors of slices [N, 13] and gradients [N, parameters]: relative, for the opacity absolute."""
    wrong = outputs - exact.outputs
    drawn = exact.outputs[:, 12] >= ALPHA_MIN
    shape = wrong[:, 3:12].norm(dim=1) / exact.outputs[:, 3:12].norm(dim=1)
    place = wrong[:, :3].norm(dim=1) / exact.scale
    geometry = torch.where(drawn, torch.maximum(shape, place), 0.0)
    others = torch.cat([wrong[:, 12:13], wrong[:, 13:] / exact.outputs[:, 13:]], 1).abs().amax(1)
    slope = (gradient - exact.gradient).norm(dim=1) / exact.gradient.norm(dim=1).clamp(min=LEAST_GRADIENT)
    bad = ~(outputs.isfinite().all(1) & gradient.isfinite().all(1))
    return SliceErrors(torch.maximum(geometry, others), slope, bad, drawn)


@torch.no_grad()
def indefinite(model: GaussianModel, raw: dict[str, Tensor]) -> Tensor:
    """Return which conditional covariances [N] have a negative eigenvalue or are not finite.

    The scheme `square_root` returns a factor F of the covariance F F^T, which has no negative eigenvalue, as models
    without schemes do.
    """
    scheme = str(getattr(model, "scheme", "square_root"))
    if scheme == "square_root":
        return torch.zeros(len(raw["means"]), dtype=torch.bool)
    cov = subtract(model.factors(raw), scheme)[1].double()  # type: ignore[operator]
    finite = cov.isfinite().all((1, 2))
    least = torch.linalg.eigvalsh(torch.where(finite[:, None, None], cov, 0.0))[:, 0]
    return ~finite | (least < 0)
