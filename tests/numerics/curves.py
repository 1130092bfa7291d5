"""Measure the errors of slicing schemes against condition number and time, and what the safe scheme costs."""

import itertools
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Generator, Tensor

from gsbench import kernels
from gsbench.kernels.backends import BACKENDS
from gsbench.measure.speed import synchroniser
from gsbench.models import build
from gsbench.models.cholesky import CholeskyModel
from gsbench.models.gaussian_batch import tensors_of
from numerics import picture_cases, pictures, population
from numerics.brute import Arguments
from numerics.cases import backends_with, device_of, fastest
from numerics.population import FACTOR_ORDERS, SCHEMES, percentile

SPREAD = 40_000  # Gaussians in the measurement of errors against condition number
DECADES = 8.0  # diagonal entries go down to 10^-u, with u random in [0, DECADES] for each Gaussian
BINS = np.arange(0, 13)  # powers of ten of the condition number
LEAST = 50  # a bin with fewer Gaussians is not shown
TIMED = 100_000  # Gaussians in the comparison of times
REPEATS = 9  # torch, which is slow, is timed once
SLICED = 20_000  # 7D Gaussians that are sliced ..
DRAWN = 1_500  # .. and 3D Gaussians that are rendered, for the plots of error against time
PICTURE = 96


@dataclass(frozen=True)
class ConditionCurve:
    """The float32 errors of one slicing scheme over the condition number of the covariance's factor."""

    scheme: str
    condition: list[float] = field(default_factory=list)  # middle of each bin
    median: list[float] = field(default_factory=list)
    percentile99: list[float] = field(default_factory=list)
    bad: list[float] = field(default_factory=list)  # share of covariances that are not finite or indefinite


@dataclass(frozen=True)
class SliceTime:
    """The milliseconds of conditioning `TIMED` 7D Gaussians on time and direction; medians of REPEATS, torch: once."""

    order: str
    scheme: str
    backend: str
    forward: float
    backward: float


@dataclass(frozen=True)
class AccuracyPoint:
    """The error and the time of one algorithm that conditions or renders Gaussians, as a point of a plot."""

    thing: str  # "slicing" or "picture"
    way: str
    error: float  # slicing: 99.9th percentile over covariances; picture: largest error of a pixel
    ms: float  # forward and backward


def by_condition() -> Iterator[ConditionCurve]:
    """Yield the float32 errors of each scheme in torch over the condition number of the factor.

    The rows of the factors are in the paper's order, with position first. In the default order the conditional Gaussian
    is a block of the factor, so that the default scheme would have nothing to compute.
    """
    order, generator = "paper", Generator().manual_seed(2)
    decades = DECADES * torch.rand(SPREAD, 1, generator=generator, dtype=torch.float64)
    hard = population.draw(generator, SPREAD, order, decades)
    exact = population.truth(hard, order)
    condition = np.log10(np.linalg.cond(population.factor(hard)))
    for scheme in SCHEMES:
        errors = population.judge(hard, exact, order, scheme, "reference")
        cov, curve = np.nan_to_num(errors.cov, nan=np.inf), ConditionCurve(scheme)
        for low, high in itertools.pairwise(BINS):
            inside = (low <= condition) & (condition < high)
            if inside.sum() >= LEAST:
                curve.condition.append(float(10 ** ((low + high) / 2)))
                curve.median.append(float(np.quantile(cov[inside], 0.5, method="higher")))
                curve.percentile99.append(float(np.quantile(cov[inside], 0.99, method="higher")))
                curve.bad.append(float(errors.bad[inside].mean()))
        yield curve


def accuracy_for_time(backends: list[str]) -> Iterator[AccuracyPoint]:
    """Yield error and time of slicing for each scheme and precision, and of rendering for each instruction set."""
    hard = population.draw(Generator().manual_seed(4), SLICED, "paper")
    exact = population.truth(hard, "paper")
    for scheme in SCHEMES:
        for dtype in (torch.float32, torch.float64):
            yield _sliced(hard, exact, scheme, "reference", dtype)
    for scheme in SCHEMES:
        for backend in backends_with(scheme, "7dgs", backends):
            if backend != "reference":
                yield _sliced(hard, exact, scheme, backend, torch.float32)
    arguments = picture_cases.crowd(Generator().manual_seed(5), DRAWN, 0.05)
    scale = picture_cases.intrinsics(6 * picture_cases.FOCAL, 6 * picture_cases.FOCAL, PICTURE / 2, PICTURE / 2)
    arguments |= {"width": PICTURE, "height": PICTURE, "Ks": scale}
    truth = pictures.together(arguments)
    for backend in backends:
        if backend == "cpu":
            active = kernels.native().active()
            for level in kernels.native().instruction_sets():
                kernels.use_instruction_set(level)
                yield _drawn(arguments, truth, backend, torch.float32, f"cpu, {level}")
            kernels.use_instruction_set(active)
        else:
            yield _drawn(arguments, truth, backend, torch.float32, f"{backend} float32")
    yield _drawn(arguments, truth, "reference", torch.float64, "reference float64")


def _passes(
    model: CholeskyModel, hard: population.Hard, dtype: torch.dtype = torch.float32
) -> tuple[Callable[[], tuple[Tensor, ...]], Callable[[tuple[Tensor, ...]], None]]:
    """Return the forward pass of slicing, and the backward pass from its result; each waits for its device."""
    device = device_of(model.backend.name)
    raw = {name: value.to(device, dtype).requires_grad_()
           for name, value in population.raw_parameters(hard, model).items()}  # fmt: skip
    query, wait = population.at_the_origin(model, dtype), synchroniser(device)

    def forward() -> tuple[Tensor, ...]:
        out = tensors_of(model.slice_geometry(raw, query))
        wait()
        return out

    def backward(out: tuple[Tensor, ...]) -> None:
        torch.autograd.grad(out, list(raw.values()), [torch.ones_like(x) for x in out], allow_unused=True)
        wait()

    return forward, backward


def _sliced(
    hard: population.Hard, exact: population.PopulationTruth, scheme: str, backend: str, dtype: torch.dtype
) -> AccuracyPoint:
    forward, backward = _passes(population.all_seen("paper", scheme, backend).to(dtype), hard, dtype)

    def both() -> Tensor:
        out = forward()
        backward(out)
        return out[1].detach().cpu().double()

    F, cov = both(), exact.cov
    errors = ((F @ F.mT - cov).norm(dim=(1, 2)) / cov.norm(dim=(1, 2))).numpy()
    way = f"{scheme} {backend} {str(dtype).removeprefix('torch.')}"
    return AccuracyPoint("slicing", way, percentile(errors), fastest(both))


def _drawn(
    arguments: Arguments, truth: pictures.ImageTruth, backend: str, dtype: torch.dtype, way: str
) -> AccuracyPoint:
    image, _, decided, _ = truth
    weights = pictures.weights(arguments)
    cast = {name: value.to(dtype) if isinstance(value, Tensor) else value for name, value in arguments.items()}
    got, _, _ = pictures.differentiate(cast, backend, *weights)
    error = float(torch.where(decided, (got - image).abs().amax(-1), 0.0).max())
    return AccuracyPoint("picture", way, error, fastest(lambda: pictures.differentiate(cast, backend, *weights)))


def safety(backends: list[str]) -> Iterator[SliceTime]:
    """Yield the times of the forward and the backward pass of each scheme on each backend."""
    for order in FACTOR_ORDERS:
        hard = population.draw(Generator().manual_seed(3), TIMED, order, 1.0)
        for scheme in SCHEMES:
            for backend in backends_with(scheme, "7dgs", backends):
                model = build("7dgs", lambda_d=0.35, lambda_t=0.35, factor_order=order, scheme=scheme,
                              backend=BACKENDS[backend])  # fmt: skip
                assert isinstance(model, CholeskyModel)
                forward, backward = _passes(model.to(device_of(backend)), hard)
                times = []
                for _ in range(1 if backend == "reference" else REPEATS):
                    start = time.perf_counter()
                    out = forward()
                    middle = time.perf_counter()
                    backward(out)
                    times.append((1e3 * (middle - start), 1e3 * (time.perf_counter() - middle)))
                yield SliceTime(order, scheme, backend, *map(float, np.median(times, axis=0)))
