"""Define hard cases: each has a name, a bound on its errors, and a severity that hypothesis can search."""

import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch

AREAS = ("slicing", "colour", "projection", "blending", "training", "drift")


@dataclass(frozen=True)
class Bound:
    """The largest errors that the defaults may have in a case. They are relative unless the case says otherwise."""

    forward: float = 1e-4
    gradient: float = 1e-3


@dataclass(frozen=True)
class Case:
    """A hard case, made by `build(generator, severity, **more)`: ordinary at severity 0 and hardest at 1."""

    name: str
    area: str
    build: Callable[..., Any]
    subjects: tuple[str, ...]  # the models that are tested with it; empty: it needs none
    bound: Bound

    @property
    def stresses(self) -> str:
        """Return what the case stresses, and where it was met in practice: the builder's docstring."""
        return " ".join((self.build.__doc__ or "").split())

    def __call__(self, severity: float = 1.0, seed: int = 0, **more: Any) -> Any:
        """Build the case; the same arguments give the same numbers."""
        mixed = zlib.crc32(f"{self.name}/{seed}".encode())
        return self.build(torch.Generator().manual_seed(mixed), severity, **more)


@dataclass(frozen=True)
class Cell:
    """The result of a case for one model, scheme and backend."""

    area: str
    case: str
    subject: str  # the model; "-" where there is none
    scheme: str
    backend: str
    forward: float  # error of the result; NaN where it is not finite
    gradient: float  # error of its gradient; NaN where it is not finite or not judged
    bad: float  # share of Gaussians (pixels, steps) whose result or gradient is not finite, or is indefinite
    ms: float  # forward and backward
    bound: Bound
    note: str = ""

    @property
    def is_default(self) -> bool:
        """Tell whether the result is that of a default setting; other slicing schemes are only for comparison."""
        return self.scheme in ("square_root", "-")

    @property
    def holds(self) -> bool:
        """Tell whether both errors are within their bounds, and no number is NaN, infinite or otherwise wrong."""
        gradient = math.isnan(self.bound.gradient) or self.gradient <= self.bound.gradient
        return self.bad == 0 and self.forward <= self.bound.forward and gradient


def device_of(backend: str) -> str:
    """Return the kind of device on which a backend computes."""
    return "cuda" if backend == "cuda" else "cpu"


def backends_with(scheme: str, model: str, backends: list[str]) -> list[str]:
    """List the backends with code for a scheme: square_root all, cholesky for 6D and 7D the CPU too, schur torch."""
    if scheme == "square_root":
        return backends
    if scheme == "cholesky" and model != "4dgs":
        return [backend for backend in backends if backend != "cuda"]
    return ["reference"]


CASES: dict[str, Case] = {}


def case(area: str, *subjects: str, forward: float = 1e-4, gradient: float = 1e-3) -> Callable[..., Any]:
    """Decorate a builder so that CASES lists its case under its name.

    Args:
        area: the part of gsbench that the case tests, one of AREAS.
        subjects: the models that are tested with the case.
        forward: the largest error allowed in the result.
        gradient: the largest error allowed in the gradient.
    """

    def enter(build: Callable[..., Any]) -> Case:
        made = Case(build.__name__, area, build, subjects, Bound(forward, gradient))
        CASES[made.name] = made
        return made

    return enter


def of_area(area: str) -> list[Case]:
    """List the cases of one area, in the order of their definition."""
    return [found for found in CASES.values() if found.area == area]
