"""Compute the colours of Gaussians by spherical harmonics (3DGS), which 4DGS multiplies by a Fourier series in time."""

import math
from dataclasses import dataclass
from typing import Generic, TypeVar

import torch
from torch import Tensor

from gsbench.scenes.points import SH_C0

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
    order, most = order_of(packed), order_of(limit)
    return ColorOrder(order.degree.clamp(max=most.degree), order.waves.clamp(max=most.waves)).packed


def coefficients_within(
    packed: Tensor,  # [N] as `ColorOrder.packed`
    degree: int,  # of the stored coefficients
    waves: int = 1,  # of the stored coefficients
) -> Tensor:  # [N, waves, (degree + 1)^2] bool
    """Return a mask of the colour coefficients that each Gaussian uses, given its SH degree and frequencies in time."""
    order = order_of(packed)
    degrees = packed.new_tensor([math.isqrt(k) for k in range((degree + 1) ** 2)])  # of each coefficient
    frequencies = torch.arange(waves, device=packed.device)
    return (frequencies[:, None] < order.waves[:, None, None]) & (degrees <= order.degree[:, None, None])


# Constants of the real spherical harmonics of degrees 1 to 3, with the order and the signs of 3DGS.
_C1 = 0.4886025119029199
_C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
_C3 = (-0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154,
       -0.4570457994644658, 1.445305721320277, -0.5900435899266435)  # fmt: skip


def sh_basis(directions: Tensor, degree: int) -> Tensor:
    """Evaluate the real spherical harmonics up to `degree` (0 to 3) at unit vectors, [N, 3] -> [N, (degree + 1)^2]."""
    x, y, z = directions.unbind(-1)
    basis = [torch.full_like(x, SH_C0)]
    if degree > 0:
        basis += [-_C1 * y, _C1 * z, -_C1 * x]
    if degree > 1:
        xx, yy, zz = x * x, y * y, z * z
        basis += [_C2[0] * x * y, _C2[1] * y * z, _C2[2] * (2 * zz - xx - yy), _C2[3] * x * z, _C2[4] * (xx - yy)]
    if degree > 2:
        basis += [
            _C3[0] * y * (3 * xx - yy),
            _C3[1] * x * y * z,
            _C3[2] * y * (4 * zz - xx - yy),
            _C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
            _C3[4] * x * (4 * zz - xx - yy),
            _C3[5] * z * (xx - yy),
            _C3[6] * x * (xx - 3 * yy),
        ]
    return torch.stack(basis, -1)


def sh_colors(
    coefficients: Tensor,  # [N, K, 3] SH coefficients beta
    directions: Tensor,  # [N, 3] unit vectors d from the camera to the Gaussians
    degree: int,  # the SH degree in use, 0 to 3
    orders: Tensor | None = None,  # [N] int32: the SH degree of each Gaussian if it is lower; None: `degree` for all
) -> Tensor:  # [N, 3]
    """Compute SH colours max(0, sum_lm beta_lm Y_lm(d) + 0.5), as in 3DGS and 7DGS eq. 2."""
    return sh_features(coefficients, directions, degree, orders).clamp(min=0)


def sh_features(coefficients: Tensor, directions: Tensor, degree: int, orders: Tensor | None = None) -> Tensor:
    """Compute the sums of `sh_colors`, which may be negative, [N, 3]."""
    basis = _basis_within(directions, degree, orders)
    used = coefficients[:, : basis.shape[-1]]
    return (basis[..., None] * used).sum(1) + 0.5


def sh_time_colors(
    coefficients: Tensor,  # [N, M, K, 3] SH coefficients for each frequency n = 0 .. M-1
    directions: Tensor,  # [N, 3] unit vectors d from the camera to the Gaussians
    degree: int,  # the SH degree in use, 0 to 3
    time_offset: Tensor,  # [N] t - mu_t
    orders: Tensor
    | None = None,  # [N] int32: lower orders of Gaussians, as `ColorOrder.packed`; None: all coefficients
) -> Tensor:  # [N, 3]
    """Compute the colours of 4DGS, whose basis functions are Y_lm(d) cos(2 pi n (t - mu_t)) (4DGS, eq. 12)."""
    frequencies = torch.arange(coefficients.shape[1], device=time_offset.device, dtype=time_offset.dtype)
    waves = torch.cos(2 * math.pi * frequencies * time_offset[:, None])  # [N, M]
    if orders is not None:
        waves = torch.where(frequencies < order_of(orders).waves[:, None], waves, 0.0)
    basis = _basis_within(directions, degree, orders)
    used = (coefficients[:, :, : basis.shape[-1]] * waves[..., None, None]).sum(1)
    return ((basis[..., None] * used).sum(1) + 0.5).clamp(min=0)


def _basis_within(directions: Tensor, degree: int, orders: Tensor | None) -> Tensor:
    """Evaluate the spherical harmonics at unit vectors, and set those above each Gaussian's own SH degree to zero."""
    basis = sh_basis(directions, degree)
    if orders is None:
        return basis
    return torch.where(coefficients_within(orders, degree)[:, 0], basis, 0.0)
