"""Error against condition number, and what the square-root scheme costs beside the two that subtract."""

import itertools
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch

from gsbench.models import build
from gsbench.models.slicing import SCHEMES
from gsbench.models.triangular import FACTOR_ORDERS
from gsbench.stability import population

SPREAD = 40_000  # Gaussians of the curve by condition number
DECADES = 8.0  # their factors' diagonals go down to 10^-DECADES, each Gaussian's to somewhere between that and 1
BINS = np.arange(0, 13)  # powers of ten of the condition number
LEAST = 50  # Gaussians in a bin, below which it is not shown
TIMED = 100_000  # Gaussians of the comparison of costs
REPEATS = 5


@dataclass(frozen=True)
class ConditionCurve:
    """Errors of one scheme by the condition number of the factor, in float32."""

    scheme: str
    condition: list[float]  # middle of each bin
    median: list[float]
    percentile99: list[float]
    bad: list[float]  # share not finite or indefinite


@dataclass(frozen=True)
class Cost:
    """Milliseconds of slicing TIMED 7D Gaussians, medians over REPEATS."""

    order: str
    scheme: str
    backend: str
    forward: float
    backward: float


def by_condition() -> Iterator[ConditionCurve]:
    """The paper's order of the factor, where every scheme has something to do; the backend is torch for all."""
    order = "paper"
    generator = torch.Generator().manual_seed(2)
    decades = DECADES * torch.rand(SPREAD, 1, generator=generator, dtype=torch.float64)
    hard = population.draw(generator, SPREAD, order, decades)
    known = population.truth(hard, order)
    condition = np.log10(np.linalg.cond(population.factor(hard)))
    for scheme in SCHEMES:
        errors = population.judge(hard, known, order, scheme, "reference")
        cov = np.nan_to_num(errors.cov, nan=np.inf)
        curve = ConditionCurve(scheme, [], [], [], [])
        for low, high in itertools.pairwise(BINS):
            inside = (low <= condition) & (condition < high)
            if inside.sum() >= LEAST:
                curve.condition.append(float(10 ** ((low + high) / 2)))
                curve.median.append(float(np.quantile(cov[inside], 0.5, method="higher")))
                curve.percentile99.append(float(np.quantile(cov[inside], 0.99, method="higher")))
                curve.bad.append(float(errors.bad[inside].mean()))
        yield curve


def safety(backends: list[str]) -> Iterator[Cost]:
    """Every scheme on every backend; schur and cholesky have no kernels and run in torch on all of them."""
    for order in FACTOR_ORDERS:
        hard = population.draw(torch.Generator().manual_seed(3), TIMED, order, 1.0)
        raw = population.raw_parameters(hard)
        for scheme in SCHEMES:
            for backend in backends if scheme == "square_root" else ["reference"]:
                model = build("7dgs", lambda_d=0.35, lambda_t=0.35, factor_order=order, scheme=scheme)
                model.backend = backend
                inputs = [value.requires_grad_() for value in raw.values()]
                forward, backward = [], []
                for _ in range(REPEATS):
                    start = time.perf_counter()
                    out = model.observe(raw, torch.zeros(3), torch.tensor(0.0))
                    middle = time.perf_counter()
                    torch.autograd.grad(out, inputs, [torch.ones_like(x) for x in out], allow_unused=True)
                    forward.append(1e3 * (middle - start))
                    backward.append(1e3 * (time.perf_counter() - middle))
                yield Cost(order, scheme, backend, float(np.median(forward)), float(np.median(backward)))
