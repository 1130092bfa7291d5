"""What a hard case is, and the list of them all: named, bounded, and grown by a severity that hypothesis can search."""

import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch

AREAS = ("slicing", "colour", "projection", "blending", "training", "drift")


@dataclass(frozen=True)
class Bound:
    """What the defaults promise in one case. An error is relative unless the case says otherwise."""

    forward: float = 1e-4
    gradient: float = 1e-3


@dataclass(frozen=True)
class Case:
    """One hard case: `build(generator, severity, **more)` makes it, tame at severity 0 and at its hardest at 1."""

    name: str
    area: str
    build: Callable[..., Any]
    subjects: tuple[str, ...]  # the models it is put to; empty: it needs none
    bound: Bound

    @property
    def stresses(self) -> str:
        """What it stresses, and where it was met in practice: the builder's docstring."""
        return " ".join((self.build.__doc__ or "").split())

    def __call__(self, severity: float = 1.0, seed: int = 0, **more: Any) -> Any:
        """Build it; the same numbers for the same arguments."""
        mixed = zlib.crc32(f"{self.name}/{seed}".encode())
        return self.build(torch.Generator().manual_seed(mixed), severity, **more)


@dataclass(frozen=True)
class Cell:
    """What came out of one case, for one model, scheme and backend."""

    area: str
    case: str
    subject: str  # the model; "-" where there is none
    scheme: str
    backend: str
    forward: float  # error of the result; NaN where it is not finite
    gradient: float  # error of its gradient; NaN where it is not finite, or there is none to judge
    bad: float  # share of Gaussians (pixels, steps) whose result or gradient is not finite, or is indefinite
    ms: float  # forward and backward
    bound: Bound
    note: str = ""

    @property
    def is_default(self) -> bool:
        """Whether users meet it without asking for it; the other schemes are there to be compared with."""
        return self.scheme in ("square_root", "-")

    @property
    def holds(self) -> bool:
        """Whether it keeps its bound: nothing bad, and both errors below theirs."""
        gradient = math.isnan(self.bound.gradient) or self.gradient <= self.bound.gradient
        return self.bad == 0 and self.forward <= self.bound.forward and gradient


def device_of(backend: str) -> str:
    """Where a backend computes."""
    return "cuda" if backend == "cuda" else "cpu"


def backends_with(scheme: str, model: str, backends: list[str]) -> list[str]:
    """Where a scheme has code of its own: square_root everywhere, cholesky for 6D and 7D on the CPU, schur in torch."""
    if scheme == "square_root":
        return backends
    if scheme == "cholesky" and model != "4dgs":
        return [backend for backend in backends if backend != "cuda"]
    return ["reference"]


CASES: dict[str, Case] = {}


def case(area: str, *subjects: str, forward: float = 1e-4, gradient: float = 1e-3) -> Callable[..., Any]:
    """Enter a builder into CASES under its own name."""

    def enter(build: Callable[..., Any]) -> Case:
        made = Case(build.__name__, area, build, subjects, Bound(forward, gradient))
        CASES[made.name] = made
        return made

    return enter


def of_area(area: str) -> list[Case]:
    """The cases of one area, in the order they were written."""
    return [found for found in CASES.values() if found.area == area]
