"""Define the test cases of the stability audit: numerically hard inputs, each with a bound on its errors."""

import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch

TORCH_ONLY = ("dgs_interpolated", "dgs_o")  # models without a kernel
AREAS = ("slicing", "colour", "projection", "blending", "training", "drift")


@dataclass(frozen=True)
class Bound:
    """The largest errors, usually relative, that a default setting may have in a test case."""

    forward: float = 1e-4
    gradient: float = 1e-3


@dataclass(frozen=True)
class Case:
    """A test case of the stability audit: a function that builds numerically hard inputs, and a bound on the errors.

    The inputs are ordinary at severity 0 and hardest at severity 1, so that tests can search the values between.
    """

    name: str
    area: str
    build: Callable[..., Any]
    subjects: tuple[str, ...]  # the models that are tested with it; empty if the case has no model
    bound: Bound

    @property
    def stresses(self) -> str:
        """Return the docstring of the function that builds the inputs, which says why they are numerically hard."""
        return " ".join((self.build.__doc__ or "").split())

    def __call__(self, severity: float = 1.0, seed: int = 0, **more: Any) -> Any:
        """Build the inputs of this test case at a severity between 0 and 1; the same seed gives the same inputs."""
        mixed = zlib.crc32(f"{self.name}/{seed}".encode())
        return self.build(torch.Generator().manual_seed(mixed), severity, **more)


@dataclass(frozen=True)
class Cell:
    """The errors and the time of one test case with one model, backend and slicing scheme.

    The slicing scheme is the algorithm that computes the conditional 3D Gaussian at a time and view direction.
    """

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
        """Return whether the result comes from a default setting.

        The other algorithms for conditional Gaussians (`schur`, `cholesky`) are measured for comparison only.
        """
        return self.scheme in ("square_root", "-")

    @property
    def holds(self) -> bool:
        """Return whether errors of result and gradient are within bounds, values finite and covariances definite."""
        gradient = math.isnan(self.bound.gradient) or self.gradient <= self.bound.gradient
        return self.bad == 0 and self.forward <= self.bound.forward and gradient


def device_of(backend: str) -> str:
    """Return the torch device type on which a backend computes: "cuda" or "cpu"."""
    return "cuda" if backend == "cuda" else "cpu"


def backends_with(scheme: str, model: str, backends: list[str]) -> list[str]:
    """Return the backends that implement a slicing scheme, which computes the conditional 3D Gaussian.

    All backends implement `square_root`, and the only one of a model without schemes ("-"). `cholesky` runs in torch,
    and for 6D and 7D also in the CPU kernels. `schur` runs in torch only.
    """
    if scheme in ("square_root", "-"):
        return [name for name in backends if name == "reference" or model not in TORCH_ONLY]
    if scheme == "cholesky" and model != "4dgs":
        return [backend for backend in backends if backend != "cuda"]
    return ["reference"]


CASES: dict[str, Case] = {}


def case(area: str, *subjects: str, forward: float = 1e-4, gradient: float = 1e-3) -> Callable[..., Any]:
    """Return a decorator that adds a function to CASES, the test cases of the stability audit.

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
    """Return the test cases of one area, such as "slicing" or "blending", in the order of their definition."""
    return [found for found in CASES.values() if found.area == area]
