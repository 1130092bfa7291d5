"""Define the tuples of 3D Gaussians that a model gives for a camera and a time, and how they are joined."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.tape import stack
from gsbench.models.portable_math import sqrt


class Gaussians3D(NamedTuple):
    """Hold the 3D Gaussians that the rasterizer renders: the slice of a model for one camera centre and time."""

    means: Tensor  # [N, 3]
    factors: Tensor  # [N, 3, 3]
    opacities: Tensor  # [N]
    colors: Tensor  # [N, 3]
    beta_exponents: Tensor | None = None  # [N] b of the alpha profile (1 - r^2)^b; None: the profile is a Gaussian


def stacked(slices: Sequence[Gaussians3D]) -> Gaussians3D:
    """Return the slices of several views as one, whose tensors are [V, N, ..]; a single one stays as it is."""
    if len(slices) == 1:
        return slices[0]
    fields = [field for field, x in slices[0]._asdict().items() if x is not None]
    parts = stack([[getattr(gaussians, field) for gaussians in slices] for field in fields])
    return slices[0]._replace(**dict(zip(fields, parts, strict=True)))


class Conditioned(NamedTuple):
    """Hold means and covariance factors of conditional 3D Gaussians, and the factors in [0, 1] of their opacities."""

    means: Tensor  # [N, 3]
    factors: Tensor  # [N, 3, 3]
    opacity_factor: Tensor  # [N] f_temp f_dir in [0, 1]
    beta_exponents: Tensor | None = None  # [N], as in `Gaussians3D`


class Geometry(NamedTuple):
    """Hold means, covariance factors and opacities of the 3D Gaussians at a camera and time, without colours."""

    means: Tensor  # [N, 3]
    factors: Tensor  # [N, 3, 3]
    opacities: Tensor  # [N]
    beta_exponents: Tensor | None = None  # [N], as in `Gaussians3D`


def tensors_of(parts: Iterable[Tensor | None]) -> list[Tensor]:
    """Return the tensors of 3D Gaussians (means, covariance factors, ...) in order, without fields that are None."""
    return [part for part in parts if part is not None]


def reach(beta_exponents: Tensor) -> Tensor:
    """Return at how many standard deviations of the Gaussian that looks like it a Beta profile ends, sqrt(2 b), [N].

    A profile (1 - r^2)^b ends at r = 1, and is close to the Gaussian exp(-b r^2), whose standard deviation is
    1 / sqrt(2 b).
    """
    return sqrt(2 * beta_exponents)


def joined_exponents(first: Tensor | None, second: Tensor | None) -> Tensor | None:
    """Concatenate the exponents b of the alpha profiles (1 - r^2)^b of two groups of Gaussians; None if both are."""
    if first is None and second is None:
        return None
    if first is None or second is None:
        raise InputError(
            "beta_exponents: expected every row of a slice to have one or none to have one, got some: "
            "let `condition` and `static` of the model agree"
        )
    return torch.cat([first, second])
