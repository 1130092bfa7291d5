"""Test the conditional 3D Gaussians that models compute in float32, against exact ones from mpmath."""

import functools
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from gsbench.kernels.backends import BACKENDS
from gsbench.kernels.headers import ALPHA_MIN
from gsbench.models import GaussianModel, Query, build
from gsbench.models.sliced import tensors_of
from gsbench.models.slicing import SCHEMES
from gsbench.stability import oracle
from gsbench.stability.cases import Case, Cell, backends_with, device_of
from gsbench.stability.population import indefinite
from gsbench.stability.slicing_cases import COUNT, Observed, variables

OPTIONS: dict[str, dict[str, Any]] = {
    "4dgs": {},
    "6dgs": {"lambda_d": 0.35, "directional_half": False},
    "7dgs": {"lambda_d": 0.35, "lambda_t": 0.35},
}
SLOW_MS = 500.0
COPIES = 1024  # copies of the Gaussians in a test case, for timing


@dataclass(frozen=True)
class SliceTruth:
    """The exact conditional mean, covariance and opacity of Gaussians in a test case, and the gradient of a loss."""

    outputs: Tensor  # [COUNT, 13] float64
    weights: Tensor  # [COUNT, 13]: the loss is the sum of weights x outputs
    scale: Tensor  # [COUNT]: errors of the mean are divided by this
    gradient: Tensor  # [COUNT, parameters], in the order of `Observed.raw`


def judge(case: Case, backends: list[str], schemes: Sequence[str] = SCHEMES) -> Iterator[Cell]:
    """Yield the errors of conditional 3D Gaussians in one test case, for each model, algorithm and backend."""
    for model in case.subjects:
        observed = case(model=model)
        known = truth(observed)
        for scheme in schemes:
            for backend in backends_with(scheme, model, backends):
                yield _cell(case, observed, known, scheme, backend)


def truth(observed: Observed) -> SliceTruth:
    """Compute exact conditional Gaussians in mpmath, and the exact gradient of a loss.

    The loss is a random weighted sum of mean, covariance and opacity; mean and covariance are divided by their size. If
    a Gaussian is too faint to be rendered, only its opacity counts.
    """
    outputs, scales, gradients = [], [], []
    weights = torch.randn(COUNT, 13, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    function = exact(observed)
    for i in range(COUNT):
        x = torch.cat([value[i].flatten() for value in observed.raw.values()]).tolist()
        values = torch.tensor([float(v) for v in oracle.evaluate(function, x)], dtype=torch.float64)
        mean = observed.raw["means"][i].double()
        scale = mean.norm() + (values[:3] - mean).norm() + values[[3, 7, 11]].sum().sqrt()
        weights[i, :3] /= scale
        weights[i, 3:12] /= values[3:12].norm()
        if values[12] < ALPHA_MIN:  # it is culled, so its mean and covariance do not matter
            weights[i, :12] = 0
        outputs.append(values)
        scales.append(scale)
        gradients.append([float(v) for v in oracle.gradient(function, x, weights[i].tolist())])
    return SliceTruth(torch.stack(outputs), weights, torch.stack(scales), torch.tensor(gradients, dtype=torch.float64))


def exact(observed: Observed) -> oracle.Function:
    """Return the mpmath function from the raw parameters of a Gaussian to its conditional 3D Gaussian.

    The time and the learned coefficients lambda_t and lambda_d are rounded to float32, because the models get them in
    float32.
    """
    layout = {name: value[0].numel() for name, value in observed.raw.items()}
    log_lambda = {name: _single(value) for name, value in observed.log_lambda.items()}
    if observed.model == "4dgs":
        return functools.partial(
            oracle.slice_rotated, layout=layout, log_lambda=log_lambda, time=_single(observed.time)
        )
    return functools.partial(
        oracle.slice_triangular, layout=layout, order=variables(observed.model),
        half=0.5 if observed.model == "7dgs" else 1.0, log_lambda=log_lambda, center=observed.center.tolist(),
        time=_single(observed.time) if observed.model == "7dgs" else None,
    )  # fmt: skip


def load(observed: Observed, scheme: str, backend: str, copies: int = 1) -> tuple[GaussianModel, dict[str, Tensor]]:
    """Make a model and raw parameters that repeat the Gaussians of a test case `copies` times."""
    model = build(observed.model, scheme=scheme, backend=BACKENDS[backend], **OPTIONS[observed.model])
    for name, value in observed.log_lambda.items():
        model.log_lambda[name] = nn.Parameter(torch.tensor(value))
    model.to(device_of(backend))
    rows = torch.arange(COUNT).repeat(copies)
    return model, {name: value[rows].requires_grad_() for name, value in observed.raw.items()}


def differentiate(
    model: GaussianModel, raw: dict[str, Tensor], observed: Observed, weights: Tensor
) -> tuple[Tensor, Tensor]:
    """Compute conditional 3D Gaussians in float32, and the gradients of raw parameters; return both as float64.

    The outputs [N, 13] are mean (3), covariance (9) and opacity. The gradients are [N, parameters].
    """
    device = device_of(model.backend.name)
    moment = torch.tensor(observed.time, device=device) if "time" in model.observes else None
    there = {name: value.to(device) for name, value in raw.items()}
    seen = model.slice_geometry(there, Query(observed.center.to(device), moment))
    mean, F, opacity = (x.cpu().double() for x in tensors_of(seen))
    outputs = torch.cat([mean, (F @ F.mT).flatten(1), opacity[:, None]], 1)
    inputs = list(raw.values())
    gradients = torch.autograd.grad(outputs, inputs, weights, materialize_grads=True)
    return outputs.detach(), torch.cat([g.reshape(len(g), -1).double() for g in gradients], 1)


def _cell(case: Case, observed: Observed, known: SliceTruth, scheme: str, backend: str) -> Cell:
    model, raw = load(observed, scheme, backend)
    outputs, gradient = differentiate(model, raw, observed, known.weights)
    bad = ~(outputs.isfinite().all(1) & gradient.isfinite().all(1))
    bad |= indefinite(model, raw)
    wrong = outputs - known.outputs
    drawn = known.outputs[:, 12] >= ALPHA_MIN
    shape = wrong[:, 3:12].norm(dim=1) / known.outputs[:, 3:12].norm(dim=1)
    place = wrong[:, :3].norm(dim=1) / known.scale
    geometry = torch.where(drawn, torch.maximum(shape, place), 0.0)
    size = known.gradient.norm(dim=1)
    slope = (gradient - known.gradient).norm(dim=1) / torch.where(size > 0, size, 1.0)
    return Cell(
        case.area, case.name, observed.model, scheme, backend, worst(torch.maximum(geometry, wrong[:, 12].abs())),
        worst(slope), bad.double().mean().item(), _milliseconds(observed, known, scheme, backend), case.bound,
        note=f"{int(drawn.sum())} of {COUNT} drawn",
    )  # fmt: skip


def worst(errors: Tensor) -> float:
    """Return the largest error, or NaN if an error is not finite."""
    return float(errors.max()) if bool(errors.isfinite().all()) else float("nan")


def _milliseconds(observed: Observed, known: SliceTruth, scheme: str, backend: str) -> float:
    model, raw = load(observed, scheme, backend, COPIES)
    weights = known.weights.repeat(COPIES, 1)
    return fastest(lambda: differentiate(model, raw, observed, weights))


def fastest(call: Callable[[], object], repeats: int = 3) -> float:
    """Return the milliseconds of the fastest of `repeats` calls, because other processes may slow some of them.

    A call that takes more than half a second is not repeated.
    """
    times: list[float] = []
    while len(times) < repeats and (not times or times[0] < SLOW_MS):
        start = time.perf_counter()
        call()
        times.append(1e3 * (time.perf_counter() - start))
    return min(times)


def _single(x: float) -> float:
    return float(torch.tensor(x, dtype=torch.float32))
