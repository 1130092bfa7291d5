"""Measure the errors of slicing schemes against condition number, and what the safe scheme costs."""

import itertools
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Generator, Tensor

from gsbench.measure.speed import synchroniser
from gsbench.models import CameraTime, GaussianModel
from gsbench.models.cholesky import FACTOR_ORDERS
from gsbench.models.gaussian_batch import tensors_of
from numerics import population
from numerics.cases import backends_with, device_of
from numerics.population import SCHEMES
from numerics.slices import load

SPREAD = 40_000  # Gaussians in the measurement of errors against condition number
DECADES = 8.0  # diagonal entries go down to 10^-u, with u random in [0, DECADES] for each Gaussian
BINS = np.arange(0, 13)  # powers of ten of the condition number
LEAST = 50  # a bin with fewer Gaussians is not shown
TIMED = 100_000  # Gaussians in the comparison of times
REPEATS = 9  # torch, which is slow, is timed once


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


def by_condition() -> Iterator[ConditionCurve]:
    """Yield the float32 errors of each scheme in torch over the condition number of the factor. The rows of the factors
    are in the paper's order, with position first. In the default order the conditional Gaussian is a block of the
    factor, so that the default scheme would have nothing to compute."""
    order, generator = "paper", Generator().manual_seed(2)
    decades = DECADES * torch.rand(SPREAD, 1, generator=generator, dtype=torch.float64)
    hard = population.draw_factors(generator, order, SPREAD, decades)
    exact = population.truth(hard)
    model, _ = load(hard, "square_root", "reference")
    factors = model.factors({name: value.double() for name, value in hard.raw.items()})
    condition = np.log10(np.linalg.cond(factors.numpy()))
    for scheme in SCHEMES:
        errors = population.judge(hard, exact, scheme, "reference")
        cov, bad = np.nan_to_num(errors.shape.numpy(), nan=np.inf), errors.bad.numpy()
        curve = ConditionCurve(scheme)
        for low, high in itertools.pairwise(BINS):
            inside = (low <= condition) & (condition < high)
            if inside.sum() >= LEAST:
                curve.condition.append(float(10 ** ((low + high) / 2)))
                curve.median.append(float(np.quantile(cov[inside], 0.5, method="higher")))
                curve.percentile99.append(float(np.quantile(cov[inside], 0.99, method="higher")))
                curve.bad.append(float(bad[inside].mean()))
        yield curve


def _passes(
    model: GaussianModel, raw: dict[str, Tensor]
) -> tuple[Callable[[], tuple[Tensor, ...]], Callable[[tuple[Tensor, ...]], None]]:
    """Return the forward pass of slicing, and the backward pass from its result; each waits for its device."""
    device = device_of(model.backend.name)
    raw = {name: value.detach().to(device).requires_grad_() for name, value in raw.items()}
    query, wait = CameraTime(torch.zeros(3, device=device), torch.zeros((), device=device)), synchroniser(device)

    def forward() -> tuple[Tensor, ...]:
        out = tensors_of(model.slice_geometry(raw, query))
        wait()
        return out

    def backward(out: tuple[Tensor, ...]) -> None:
        torch.autograd.grad(out, list(raw.values()), [torch.ones_like(x) for x in out], allow_unused=True)
        wait()

    return forward, backward


def safety(backends: list[str]) -> Iterator[SliceTime]:
    """Yield the times of the forward and the backward pass of each scheme on each backend."""
    for order in FACTOR_ORDERS:
        hard = population.draw_factors(Generator().manual_seed(3), order, TIMED, 1.0)
        for scheme in SCHEMES:
            for backend in backends_with(scheme, "7dgs", backends):
                forward, backward = _passes(*load(hard, scheme, backend))
                times = []
                for _ in range(1 if backend == "reference" else REPEATS):
                    start = time.perf_counter()
                    out = forward()
                    middle = time.perf_counter()
                    backward(out)
                    times.append((1e3 * (middle - start), 1e3 * (time.perf_counter() - middle)))
                yield SliceTime(order, scheme, backend, *map(float, np.median(times, axis=0)))
