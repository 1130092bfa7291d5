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
from gsbench.stability import moving_cases, moving_oracle, oracle
from gsbench.stability.cases import Case, Cell, backends_with, device_of
from gsbench.stability.population import indefinite
from gsbench.stability.slicing_cases import ALL, COUNT, Observed, variables

OPTIONS: dict[str, dict[str, Any]] = {
    "4dgs": {},
    "6dgs": {"lambda_d": 0.35, "directional_half": False},
    "7dgs": {"lambda_d": 0.35, "lambda_t": 0.35},
} | {name: {"coupling": coupling} for name, coupling in moving_cases.COUPLINGS.items()}
ONE_SCHEME = "-"  # of models that do not condition a covariance, or by one algorithm only
LEAST_GRADIENT = 1e-20  # errors of a smaller gradient are relative to this, because float32 underflows
SLOW_MS = 500.0
COPIES = 1024  # copies of the Gaussians in a test case, for timing


@dataclass(frozen=True)
class SliceTruth:
    """The exact conditional mean, covariance and opacity of Gaussians, and the gradient of a loss.

    A Beta profile has an exponent too.
    """

    outputs: Tensor  # [N, 13] float64: mean (3), covariance (9), opacity; [N, 14] with the exponent
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
    """Yield the errors of conditional 3D Gaussians in one test case, for each model, algorithm and backend.

    They are timed with the Gaussians repeated `copies` times.
    """
    for model in case.subjects:
        observed = case(model=model)
        known = truth(observed)
        for scheme in schemes if model in ALL else (ONE_SCHEME,):
            for backend in backends_with(scheme, model, backends):
                yield _cell(case, observed, known, scheme, backend, copies)


def truth(observed: Observed) -> SliceTruth:
    """Compute exact conditional Gaussians in mpmath, and the exact gradient of a loss.

    The loss is a random weighted sum of mean, covariance and opacity; mean and covariance are divided by their size. If
    a Gaussian is too faint to be rendered, only its opacity counts.
    """
    function, rows = exact(observed), []
    for i in range(len(observed.raw["means"])):
        rows.append(torch.cat([value[i].flatten() for value in observed.raw.values()]).tolist())
    seen = [[*x, *mean] for x, mean in zip(rows, observed.raw["means"].tolist(), strict=True)]
    values = [[float(v) for v in oracle.evaluate(function, x)] for x in seen]
    outputs = torch.tensor(values, dtype=torch.float64)
    weights, scale = weights_of(outputs, observed.raw["means"])
    gradients = [
        [float(v) for v in oracle.gradient(function, x, weight, first=len(rows[0]))]
        for x, weight in zip(seen, weights.tolist(), strict=True)
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


def exact(observed: Observed) -> oracle.Function:
    """Return the mpmath function from the raw parameters of a Gaussian to its conditional 3D Gaussian.

    The time and the learned coefficients lambda_t and lambda_d are rounded to float32, because the models get them in
    float32.
    """
    layout = {name: value[0].numel() for name, value in observed.raw.items()}
    if observed.model not in ALL:
        return functools.partial(
            moving_oracle.SLICES[moving_cases.family(observed.model)], layout=layout, center=observed.center.tolist(),
            time=_single(observed.time), **OPTIONS.get(observed.model, {}),
        )  # fmt: skip
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
    """Make a model and raw parameters that repeat the Gaussians of a test case `copies` times.

    Only 4DGS, 6DGS and 7DGS have schemes.
    """
    name = "dgs" if observed.model in moving_cases.COUPLINGS else observed.model
    options = OPTIONS.get(observed.model, {}) | ({"scheme": scheme} if name in ALL else {})
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
    seen = model.slice_geometry(there, Query(observed.center.to(there["means"]), moment))
    mean, F, opacity, *shapes = (x.cpu().double() for x in tensors_of(seen))
    outputs = torch.cat([mean, (F @ F.mT).flatten(1), opacity[:, None], *(b[:, None] for b in shapes)], 1)
    inputs = list(raw.values())
    gradients = torch.autograd.grad(outputs, inputs, weights, materialize_grads=True)
    return outputs.detach(), torch.cat([g.reshape(len(g), -1).double() for g in gradients], 1)


def compare(outputs: Tensor, gradient: Tensor, known: SliceTruth) -> SliceErrors:
    """Compute the errors of slices [N, 13] and gradients [N, parameters]: relative, for the opacity absolute."""
    wrong = outputs - known.outputs
    drawn = known.outputs[:, 12] >= ALPHA_MIN
    shape = wrong[:, 3:12].norm(dim=1) / known.outputs[:, 3:12].norm(dim=1)
    place = wrong[:, :3].norm(dim=1) / known.scale
    geometry = torch.where(drawn, torch.maximum(shape, place), 0.0)
    others = torch.cat([wrong[:, 12:13], wrong[:, 13:] / known.outputs[:, 13:]], 1).abs().amax(1)
    slope = (gradient - known.gradient).norm(dim=1) / known.gradient.norm(dim=1).clamp(min=LEAST_GRADIENT)
    bad = ~(outputs.isfinite().all(1) & gradient.isfinite().all(1))
    return SliceErrors(torch.maximum(geometry, others), slope, bad, drawn)


def _cell(case: Case, observed: Observed, known: SliceTruth, scheme: str, backend: str, copies: int) -> Cell:
    model, raw = load(observed, scheme, backend)
    errors = compare(*differentiate(model, raw, observed, known.weights), known)
    bad = errors.bad | indefinite(model, raw)
    return Cell(
        case.area, case.name, observed.model, scheme, backend, worst(errors.forward), worst(errors.gradient),
        bad.double().mean().item(), _milliseconds(observed, known, scheme, backend, copies), case.bound,
        note=f"{int(errors.drawn.sum())} of {COUNT} drawn",
    )  # fmt: skip


def worst(errors: Tensor) -> float:
    """Return the largest error, or NaN if an error is not finite."""
    return float(errors.max()) if bool(errors.isfinite().all()) else float("nan")


def _milliseconds(observed: Observed, known: SliceTruth, scheme: str, backend: str, copies: int) -> float:
    model, raw = load(observed, scheme, backend, copies)
    weights = known.weights.repeat(copies, 1)
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
