"""Compute the view-dependent colours of Gaussians from SH, and time-dependent colours from a Fourier series.

Gaussians with an opacity below 1/255 at the rendered time and direction are skipped, because they change no pixel.
"""

from typing import Any

import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.headers import MAX_WAVES
from gsbench.kernels.operation import Gradient, Input, Operation, Output


def _bases(tensors: dict[str, Tensor], numbers: dict[str, Any]) -> dict[str, int]:
    """Return the number of SH coefficients that are stored for each frequency in time."""
    shN, degree, waves = tensors["shN"], numbers["degree"], numbers["waves"]
    stored = shN.shape[1] + 1 if shN.dim() == 3 else 0
    if stored % waves or stored // waves < (degree + 1) ** 2:
        raise InputError(f"show_colors: expected (degree + 1)^2 coefficients for each frequency, got degree={degree}, "
                         f"waves={waves} and {stored} coefficients")  # fmt: skip
    if waves > 1 and "times" not in tensors:
        raise InputError("show_colors: expected times and a time, as colours change with them (waves > 1)")
    return {"bases": stored // waves}


_show = Operation(
    "show_colors",
    inputs={
        "sh0": Input("N 1 3", Gradient.ADDED),
        "shN": Input("N rest 3", Gradient.ADDED),
        "means": Input("N 3"),
        "opacities": Input("N", Gradient.NONE),
        "times": Input("N 1", left_out_with="time"),
        "center": Input("3", Gradient.REFUSED),
        "time": Input("", Gradient.REFUSED, left_out_with="time"),
        "orders": Input("N", Gradient.REFUSED, (torch.int32,), left_out_with="orders"),
    },
    outputs={"colors": Output("N 3")},
    numbers={"degree": int, "waves": int},
    derive=_bases,
    memory="colours",
)


def show_colors(
    sh0: Tensor,  # [N, 1, 3]
    shN: Tensor,  # [N, waves * K - 1, 3]
    means: Tensor,  # [N, 3]
    opacities: Tensor,  # [N]
    center: Tensor,  # [3]
    degree: int,
    times: Tensor | None = None,  # [N, 1]
    time: Tensor | None = None,  # []
    waves: int = 1,
    orders: Tensor | None = None,  # [N] int32
) -> Tensor:  # [N, 3]
    """Return the colours [N, 3] of Gaussians, from spherical harmonics and, for 4DGS, a Fourier series in time.

    A colour is max(0, 0.5 + sum of beta_nlm cos(2 pi n (t - mu_t)) Y_lm(d)), with the direction d from `center` to the
    mean. It equals `gsbench.models.appearance.sh_colors` (one frequency) or `sh_time_colors`, and is zero if the
    opacity is below 1/255.

    Args:
        sh0: the constant coefficient.
        shN: the other coefficients: K harmonics for each frequency, of which (degree + 1)^2 are used.
        means: the means of the Gaussians, world units.
        opacities: the opacities after slicing, in [0, 1]; they get no gradient.
        center: the camera's centre, world units.
        degree: the SH degree, 0 to 3.
        times: the mean times mu_t, if colours change with time.
        time: the time at which to compute colours; 1 is the length of the sequence.
        waves: the number of frequencies in time, including frequency 0.
        orders: the degree and number of frequencies of each Gaussian, packed as degree + 4 (waves - 1). Its
            coefficients above them are not read, and their gradient is zero. None: all Gaussians have `degree` and
            `waves`.

    Raises:
        InputError: tensors are not float32 on one device, or their shapes do not match.
    """
    if degree not in range(4) or waves not in range(1, MAX_WAVES + 1):
        raise InputError(f"show_colors: expected degree 0 to 3 and 1 to {MAX_WAVES} frequencies, got "
                         f"degree={degree!r:.40} and waves={waves!r:.40}")  # fmt: skip
    if waves == 1:
        times = time = None
    return _show(sh0, shN, means, opacities, times, center, time, orders, degree, waves)[0]
