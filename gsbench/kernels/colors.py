"""Compute the view-dependent colours of Gaussians from SH, and time-dependent colours from a Fourier series.

Gaussians with an opacity below 1/255 at the rendered time and direction are skipped, because they change no pixel.
On a GPU, one call computes the colours of several views.
"""

from typing import Any

import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.headers import MAX_WAVES
from gsbench.kernels.operation import Gradient, Input, Operation, Output, has_leading


def _sizes(tensors: dict[str, Tensor], numbers: dict[str, Any]) -> dict[str, int]:
    """Return the number of SH coefficients that are stored for each frequency in time, and what each view has."""
    shN, degree, waves = tensors["shN"], numbers["degree"], numbers["waves"]
    if degree not in range(4) or waves not in range(1, MAX_WAVES + 1):
        raise InputError(
            f"show_colors: expected degree 0 to 3 and 1 to {MAX_WAVES} frequencies, got "
            f"degree={degree!r:.40} and waves={waves!r:.40}"
        )
    stored = shN.shape[1] + 1 if shN.dim() == 3 else 0  # with sh0; 0 of another shape, which is refused below
    if stored % waves or stored // waves < (degree + 1) ** 2:
        raise InputError(
            f"show_colors: expected (degree + 1)^2 coefficients for each frequency, got degree={degree}, "
            f"waves={waves} and {stored} coefficients"
        )
    if waves > 1 and "times" not in tensors:
        raise InputError("show_colors: expected times and a time, as colours change with them (waves > 1)")
    gaussian_per_view = has_leading("show_colors", tensors, {"means": 2, "opacities": 1})
    time_per_view = has_leading("show_colors", tensors, {"times": 2})
    many = has_leading("show_colors", tensors, {"center": 1, "time": 0})
    if not many and (gaussian_per_view or time_per_view):
        raise InputError("show_colors: expected center and time of each view, as Gaussians are, got those of one")
    return {
        "bases": stored // waves,
        "V": len(tensors["center"]) if many else 1,
        "gaussian_per_view": int(gaussian_per_view),
        "time_per_view": int(time_per_view),
    }


# A colour is max(0, 0.5 + sum of beta_nlm cos(2 pi n (t - mu_t)) Y_lm(d)), with the direction d from the centre to the
# mean, as `gsbench.models.appearance.sh_colors` (one frequency) or `sh_time_colors`; it is zero if the Gaussian is
# skipped. Opacities are those after slicing.
show_colors = Operation(
    "show_colors",
    inputs={
        "sh0": Input("N 1 3", Gradient.ADDED),  # the constant coefficient
        "shN": Input("N rest 3", Gradient.ADDED),  # the others: as many harmonics for each frequency
        "means": Input("?views N 3"),
        "opacities": Input("?views N", Gradient.NONE),
        "times": Input("?views N 1", left_out_with="time"),  # mu_t, if colours change with time
        "center": Input("?views 3", Gradient.REFUSED),
        "time": Input("?views", Gradient.REFUSED, left_out_with="time"),
        # Degree and frequencies of each Gaussian, as `ColorOrder.packed`; coefficients above them have no gradient.
        "orders": Input("N", Gradient.REFUSED, (torch.int32,), left_out_with="orders"),
    },
    outputs={"colors": Output("?views N 3")},
    numbers={"degree": int, "waves": int},  # the SH degree, and the number of frequencies including 0
    defaults={"waves": 1},
    derive=_sizes,
    memory="colours",
)
