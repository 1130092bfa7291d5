"""Colour Gaussians by spherical harmonics and waves of time.

Gaussians that cannot be seen (opacity below 1/255 after f_temp and f_dir) are left out; no image changes by that.
"""

from typing import Any

import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.fields import Gradient, Input, Output
from gsbench.kernels.headers import MAX_WAVES
from gsbench.kernels.operation import Operation


def _bases(given: dict[str, Tensor], numbers: dict[str, Any]) -> dict[str, int]:
    """Return the number of harmonics that are stored for each frequency."""
    shN, degree, waves = given["shN"], numbers["degree"], numbers["waves"]
    stored = shN.shape[1] + 1 if shN.dim() == 3 else 0
    if stored % waves or stored // waves < (degree + 1) ** 2:
        raise InputError(f"show_colors: expected (degree + 1)^2 coefficients for each frequency, got degree={degree}, "
                         f"waves={waves} and {stored} coefficients")  # fmt: skip
    if waves > 1 and "times" not in given:
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
        "orders": Input("N", Gradient.REFUSED, torch.int32, left_out_with="orders"),
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
    """Return colours max(0, sum beta_nlm cos(2 pi n (t - mu_t)) Y_lm(d) + 0.5), d from `center` to the mean.

    Colours are those of `gsbench.models.appearance.sh_colors` (waves = 1) and `sh_time_colors`, and zero for Gaussians
    whose opacity is below 1/255.

    Args:
        sh0: the constant coefficient.
        shN: the other coefficients: K harmonics for each frequency, of which (degree + 1)^2 are used.
        means: the means of the Gaussians, world units.
        opacities: the opacities after slicing, in [0, 1]; colours give them no gradient.
        center: the camera's centre, world units.
        degree: the degree of the harmonics, 0 to 3.
        times: the mean times mu_t, if colours change with time.
        time: the time at which to compute colours; 1 is the length of the sequence.
        waves: the number of frequencies in time, including the constant.
        orders: each colour's own degree and waves, packed as degree + 4 (waves - 1); coefficients above it are not
            read, and their gradient is zero. None: all colours have `degree` and `waves`.

    Raises:
        InputError: tensors are not float32 on one device, or their shapes do not fit.
    """
    if degree not in range(4) or waves not in range(1, MAX_WAVES + 1):
        raise InputError(f"show_colors: expected degree 0 to 3 and 1 to {MAX_WAVES} frequencies, got "
                         f"degree={degree!r:.40} and waves={waves!r:.40}")  # fmt: skip
    if waves == 1:
        times = time = None
    return _show(sh0, shN, means, opacities, times, center, time, orders, degree, waves)[0]
