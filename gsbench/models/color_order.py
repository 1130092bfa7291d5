"""Define the order of a colour: its SH degree and its number of frequencies in time (`waves`, 1 = constant in time).

Kernels and checkpoints store the order of a Gaussian's colour as one number, degree + 4 (waves - 1).
"""

import math
from dataclasses import dataclass
from typing import Generic, TypeVar

import torch
from torch import Tensor

_DEGREES = 4  # 0 to 3
MOST_PACKED = 31  # degree 3 and 8 waves

Number = TypeVar("Number", int, Tensor)


@dataclass(frozen=True)
class ColorOrder(Generic[Number]):
    """Hold the SH degree and the number of frequencies in time of a colour (ints), or of N colours (tensors [N])."""

    degree: Number  # of the spherical harmonics (3DGS, section 4)
    waves: Number  # frequencies n = 0 .. waves - 1 of cos(2 pi n (t - mu_t) / T) (4DGS, eq. 12); 1: constant in time

    @property
    def packed(self) -> Number:
        """The SH degree and the number of frequencies in one number: degree + 4 (waves - 1)."""
        return self.degree + _DEGREES * (self.waves - 1)


def order_of(packed: Number) -> ColorOrder[Number]:
    """Decode the SH degree and the number of frequencies (waves) from the number degree + 4 (waves - 1)."""
    return ColorOrder(packed % _DEGREES, packed // _DEGREES + 1)


def at_most(packed: Tensor, limit: int) -> Tensor:
    """Limit the SH degree and the number of frequencies of each colour [N] to those of `limit`.

    All are encoded as degree + 4 (waves - 1).
    """
    own, most = order_of(packed), order_of(limit)
    return ColorOrder(own.degree.clamp(max=most.degree), own.waves.clamp(max=most.waves)).packed


def coefficients_within(
    packed: Tensor,  # [N]
    degree: int,
    waves: int = 1,
) -> Tensor:  # [N, waves, (degree + 1)^2] bool
    """Return a mask of the colour coefficients that each Gaussian uses, given its SH degree and frequencies in time.

    Args:
        packed: the SH degree and the number of frequencies of each Gaussian, as degree + 4 (waves - 1).
        degree: the SH degree of the stored coefficients.
        waves: the number of frequencies of the stored coefficients.
    """
    own = order_of(packed)
    degrees = packed.new_tensor([math.isqrt(k) for k in range((degree + 1) ** 2)])
    frequencies = torch.arange(waves, device=packed.device)
    return (frequencies[:, None] < own.waves[:, None, None]) & (degrees <= own.degree[:, None, None])
