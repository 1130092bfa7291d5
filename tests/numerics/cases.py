"""Define a case of the audit: a function that builds numerically hard inputs, with a bound on the errors."""

import math
import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.backends import resolve

AREAS = ("slicing", "colour", "projection", "blending", "training", "drift")
BACKENDS = ("cpu", "cuda", "reference")
TORCH_ONLY = ("dgs_interpolated", "dgs_o")  # models without a kernel
ONE_SCHEME = "-"  # of models that do not condition a covariance, or by one algorithm only
COPIES = 1024  # of the Gaussians of a case, for timing
SLOW_MS = 500.0


@dataclass(frozen=True)
class Bound:
    """The largest errors, usually relative, that a default setting may have; NaN: the gradient is not judged."""

    forward: float = 1e-4
    gradient: float = 1e-3


@dataclass(frozen=True)
class Case:
    """A case of the audit. Inputs are ordinary at severity 0 and hardest at 1, so that tests can search between."""

    name: str
    area: str
    build: Callable[..., Any]  # (generator, severity, ..) -> inputs
    subjects: tuple[str, ...]  # the models that are tested with it; empty if the case has no model
    bound: Bound

    @property
    def stresses(self) -> str:
        """The docstring of `build`, which says why the inputs are numerically hard."""
        return " ".join((self.build.__doc__ or "").split())

    def __call__(self, severity: float = 1.0, seed: int = 0, **more: Any) -> Any:
        """Build the inputs; the same seed gives the same inputs."""
        mixed = zlib.crc32(f"{self.name}/{seed}".encode())
        return self.build(torch.Generator().manual_seed(mixed), severity, **more)


@dataclass(frozen=True)
class Cell:
    """The errors and the time of one case with one model, backend and slicing scheme (square_root, schur, cholesky)."""

    area: str
    case: str
    subject: str  # the model; "-" if the case has none
    scheme: str
    backend: str
    forward: float  # error of the result; NaN if it is not finite
    gradient: float  # error of its gradient; NaN if it is not finite or not tested
    bad: float  # share of Gaussians (pixels, steps) whose result is not finite or is an indefinite covariance
    ms: float  # milliseconds of forward and backward
    bound: Bound
    note: str = ""

    @property
    def is_default(self) -> bool:
        """Whether it is judged: `schur` and `cholesky`, which subtract covariances, are for comparison only."""
        return self.scheme in ("square_root", ONE_SCHEME)

    @property
    def holds(self) -> bool:
        """Whether the errors are within their bounds, values finite and covariances definite."""
        gradient = math.isnan(self.bound.gradient) or self.gradient <= self.bound.gradient
        return self.bad == 0 and self.forward <= self.bound.forward and gradient


CASES: dict[str, Case] = {}


def case(area: str, *subjects: str, forward: float = 1e-4, gradient: float = 1e-3) -> Callable[..., Any]:
    """Return a decorator that enters a function into CASES."""

    def enter(build: Callable[..., Any]) -> Case:
        CASES[build.__name__] = Case(build.__name__, area, build, subjects, Bound(forward, gradient))
        return CASES[build.__name__]

    return enter


def of_area(area: str) -> list[Case]:
    """Return the cases of one of AREAS, in the order of their definition."""
    return [case for case in CASES.values() if case.area == area]


# ---- backends


def present() -> list[str]:
    """Return the names of the backends that work on this machine, the fastest first."""
    names = []
    for name in BACKENDS:
        try:
            names.append(resolve(name, device_of(name)).name)
        except InputError:
            continue
    return names


def device_of(backend: str) -> str:
    """Return the torch device type on which a backend computes."""
    return "cuda" if backend == "cuda" else "cpu"


def backends_with(scheme: str, model: str, backends: list[str]) -> list[str]:
    """Return the backends that implement a slicing scheme: `cholesky` runs in torch, and for 6D and 7D on the CPU."""
    if scheme in ("square_root", ONE_SCHEME):
        return [name for name in backends if name == "reference" or model not in TORCH_ONLY]
    if scheme == "cholesky" and model != "4dgs":
        return [backend for backend in backends if backend != "cuda"]
    return ["reference"]


# ---- what is measured


def worst(errors: Tensor) -> float:
    """Return the largest error, or NaN if an error is not finite."""
    return float(errors.max()) if bool(errors.isfinite().all()) else float("nan")


def fastest(call: Callable[[], object], repeats: int = 3) -> float:
    """Return the milliseconds of the fastest of some calls, because other processes may slow some of them. A call that
    takes more than half a second is not repeated."""
    times: list[float] = []
    while len(times) < repeats and (not times or times[0] < SLOW_MS):
        start = time.perf_counter()
        call()
        times.append(1e3 * (time.perf_counter() - start))
    return min(times)
