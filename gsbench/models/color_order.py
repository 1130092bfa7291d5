"""Define the order of a colour: the degree of its spherical harmonics and its number of frequencies of time.

Kernels, checkpoints and `EffectSets` store an order as one number, degree + 4 (waves - 1) (math/harmonics.h).
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
    """The order of one colour (ints), or of each Gaussian's colour (tensors [N])."""

    degree: Number  # of the spherical harmonics (3DGS, section 4)
    waves: Number  # frequencies n = 0 .. waves - 1 of cos(2 pi n (t - mu_t) / T) (4DGS, eq. 12); 1: constant in time

    @property
    def packed(self) -> Number:
        """Return the number degree + 4 (waves - 1)."""
        return self.degree + _DEGREES * (self.waves - 1)


def order_of(packed: Number) -> ColorOrder[Number]:
    """Read an order from its number."""
    return ColorOrder(packed % _DEGREES, packed // _DEGREES + 1)


def at_most(packed: Tensor, limit: int) -> Tensor:
    """Limit each packed order [N] to the degree and the waves of another one."""
    own, most = order_of(packed), order_of(limit)
    return ColorOrder(own.degree.clamp(max=most.degree), own.waves.clamp(max=most.waves)).packed


def coefficients_within(
    packed: Tensor,  # [N]
    degree: int,
    waves: int = 1,
) -> Tensor:  # [N, waves, (degree + 1)^2] bool
    """Tell which of the stored coefficients are within each Gaussian's order.

    Args:
        packed: the harmonic degree and Fourier order of each Gaussian, packed in one number.
        degree: the harmonic degree of the coefficients that are stored for each frequency.
        waves: the number of frequencies that are stored.
    """
    own = order_of(packed)
    degrees = packed.new_tensor([math.isqrt(k) for k in range((degree + 1) ** 2)])
    frequencies = torch.arange(waves, device=packed.device)
    return (frequencies[:, None] < own.waves[:, None, None]) & (degrees <= own.degree[:, None, None])
