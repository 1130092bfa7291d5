"""Measure the errors of slicing schemes against condition number and precision, and the time of each scheme.

A slicing scheme is an algorithm that computes the conditional 3D Gaussian at a time and view direction.
"""

import itertools
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsbench import kernels
from gsbench.kernels.backends import BACKENDS
from gsbench.measure.speed import synchroniser
from gsbench.models import Query, build
from gsbench.models.sliced import tensors_of
from gsbench.models.slicing import SCHEMES
from gsbench.models.triangular import FACTOR_ORDERS, TriangularModel
from gsbench.stability import picture_cases, pictures, population, slices
from gsbench.stability.cases import backends_with, device_of
from gsbench.stability.picture_cases import Arguments

SPREAD = 40_000  # Gaussians in the measurement of errors against condition number
DECADES = 8.0  # diagonal entries go down to 10^-u, with u random in [0, DECADES] for each Gaussian
BINS = np.arange(0, 13)  # powers of ten of the condition number
LEAST = 50  # a bin with fewer Gaussians is not shown
TIMED = 100_000  # Gaussians in the comparison of times
REPEATS = 9  # torch, which is slow, is timed once
SLICED = 20_000  # 7D Gaussians that are sliced ..
DRAWN = 1_500  # .. and 3D Gaussians that are rendered, for the plots of error against time
PICTURE = 96
PERCENTILE = 0.999  # the quantile of errors over random Gaussians that must be below the bound


@dataclass(frozen=True)
class ConditionCurve:
    """The float32 errors of one slicing scheme as a function of the condition number of the covariance's factor.

    A slicing scheme is an algorithm that computes the conditional 3D Gaussian.
    """

    scheme: str
    condition: list[float]  # middle of each bin
    median: list[float]
    percentile99: list[float]
    bad: list[float]  # share of covariances that are not finite or indefinite


@dataclass(frozen=True)
class SliceTime:
    """The milliseconds of the forward and the backward pass of conditioning `TIMED` 7D Gaussians, for one method.

    The Gaussians are conditioned on time and direction. Kernels are timed by the median of several calls (`REPEATS`),
    torch by one call.
    """

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


def accuracy_for_time(backends: list[str]) -> Iterator[AccuracyPoint]:
    """Yield error and time of conditioning, for each algorithm and precision, and of rendering, for each instruction
    set.

    Conditioning computes the 3D Gaussians of `SLICED` 7D Gaussians with ill-conditioned covariance factors. Rendering
    draws `DRAWN` 3D Gaussians.
    """
    hard = population.draw(torch.Generator().manual_seed(4), SLICED, "paper")
    known = population.truth(hard, "paper")
    for scheme in SCHEMES:
        for dtype in (torch.float32, torch.float64):
            yield _sliced(hard, known, scheme, "reference", dtype)
    for scheme in SCHEMES:
        for backend in backends_with(scheme, "7dgs", backends):
            if backend != "reference":
                yield _sliced(hard, known, scheme, backend, torch.float32)
    arguments = picture_cases.crowd(torch.Generator().manual_seed(5), DRAWN, 0.05)
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


def _sliced(
    hard: population.Hard, known: population.PopulationTruth, scheme: str, backend: str, dtype: torch.dtype
) -> AccuracyPoint:
    model = population.all_seen("paper", scheme, backend).to(dtype)
    device = device_of(backend)
    raw = {
        name: value.to(device, dtype).requires_grad_() for name, value in population.raw_parameters(hard, model).items()
    }
    center, moment = torch.zeros(3, device=device, dtype=dtype), torch.zeros((), device=device, dtype=dtype)

    def both() -> Tensor:
        out = tensors_of(model.slice_geometry(raw, Query(center, moment)))
        torch.autograd.grad(out, list(raw.values()), [torch.ones_like(x) for x in out], allow_unused=True)
        synchroniser(device)()
        return out[1].detach().cpu().double()

    F = both()
    exact = torch.from_numpy(known.cov)
    errors = ((F @ F.mT - exact).norm(dim=(1, 2)) / exact.norm(dim=(1, 2))).numpy()
    precision = str(dtype).removeprefix("torch.")
    return AccuracyPoint("slicing", f"{scheme} {backend} {precision}", percentile(errors), slices.fastest(both))


def _drawn(
    arguments: Arguments, truth: pictures.ImageTruth, backend: str, dtype: torch.dtype, way: str
) -> AccuracyPoint:
    image, _, decided, _ = truth
    weights = pictures.weights(arguments)
    cast = {name: value.to(dtype) if isinstance(value, Tensor) else value for name, value in arguments.items()}
    got, _, _ = pictures.differentiate(cast, backend, *weights)
    error = float(torch.where(decided, (got - image).abs().amax(-1), 0.0).max())
    return AccuracyPoint("picture", way, error, slices.fastest(lambda: pictures.differentiate(cast, backend, *weights)))


def percentile(errors: population.Floats) -> float:
    """Return the 99.9th percentile of errors; NaN counts as infinite."""
    return float(np.quantile(np.nan_to_num(errors, nan=np.inf), PERCENTILE, method="higher"))


def by_condition() -> Iterator[ConditionCurve]:
    """Yield the float32 errors of each algorithm for conditional Gaussians, over the condition number of the factor.

    The algorithms run in torch. The rows of the covariances' factors are in the paper's order, with position first. In
    the default order the conditional Gaussian is a block of the factor, so that the default algorithm would have
    nothing to compute.
    """
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


def safety(backends: list[str]) -> Iterator[SliceTime]:
    """Yield the times of the forward and the backward pass of each conditioning algorithm on each backend."""
    for order in FACTOR_ORDERS:
        hard = population.draw(torch.Generator().manual_seed(3), TIMED, order, 1.0)
        for scheme in SCHEMES:
            for backend in backends_with(scheme, "7dgs", backends):
                model = build("7dgs", lambda_d=0.35, lambda_t=0.35, factor_order=order, scheme=scheme,
                              backend=BACKENDS[backend])  # fmt: skip
                assert isinstance(model, TriangularModel)
                device, forward, backward = device_of(backend), [], []
                wait = synchroniser(device)
                model.to(device)
                raw = {k: v.to(device).requires_grad_() for k, v in population.raw_parameters(hard, model).items()}
                for _ in range(1 if backend == "reference" else REPEATS):
                    start = time.perf_counter()
                    query = Query(torch.zeros(3, device=device), torch.zeros((), device=device))
                    out = tensors_of(model.slice_geometry(raw, query))
                    wait()
                    middle = time.perf_counter()
                    torch.autograd.grad(out, list(raw.values()), [torch.ones_like(x) for x in out], allow_unused=True)
                    wait()
                    forward.append(1e3 * (middle - start))
                    backward.append(1e3 * (time.perf_counter() - middle))
                yield SliceTime(order, scheme, backend, float(np.median(forward)), float(np.median(backward)))
