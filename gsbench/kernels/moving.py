"""Compute the slices of 3D Gaussians that move and fade (dGS, dBS, FreeTimeGS) for one camera and time."""

from typing import Any

from torch import Tensor

from gsbench.kernels.fields import Gradient, Input, Output
from gsbench.kernels.operation import EVERY_ROW, Operation
from gsbench.kernels.slices import SLICE, conditioned_rows

_direct = Operation(
    "slice_direct",
    inputs={
        "means": Input("N 3", Gradient.ADDED),
        "directions": Input("N 3", Gradient.ADDED),
        "times": Input("N 1", Gradient.ADDED),
        "scales": Input("N 3", Gradient.ADDED),
        "quats": Input("N 4", Gradient.ADDED),
        "precision": Input("N 7", Gradient.ADDED),
        "coupling": Input("N 12", Gradient.ADDED),
        "shares": Input("N 2", Gradient.ADDED),
        "opacities": Input("N", Gradient.ADDED),
        "center": Input("3", Gradient.REFUSED),
        "time": Input("", Gradient.REFUSED),
    },
    outputs=SLICE,
    numbers={"conditioned": int},
    derive=conditioned_rows,
    memory="a slice's Gaussians",
)


def slice_direct(
    means: Tensor,  # [N, 3]
    directions: Tensor,  # [N, 3] of any length
    times: Tensor,  # [N, 1] logits
    scales: Tensor,  # [N, 3] log scales
    quats: Tensor,  # [N, 4] wxyz
    precision: Tensor,  # [N, 7]
    coupling: Tensor,  # [N, 12]
    shares: Tensor,  # [N, 2] logits
    opacities: Tensor,  # [N] logits
    center: Tensor,  # [3]
    time: Tensor,  # []
    *,
    conditioned: int | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return means [N, 3], factors [N, 3, 3] and opacities [N] of dGS Gaussians for a camera centre and a time.

    `gsbench.models.moving.DirectModel` has the formulas and the parameters; its `coupling` is `text`. Only the
    first `conditioned` Gaussians (None: all) depend on the camera and the time. The others are static.

    Raises:
        InputError: tensors are not float32 on one device, their shapes do not match, `center` or `time` requires a
            gradient, or `conditioned` exceeds N.
    """
    outputs = _direct(means, directions, times, scales, quats, precision, coupling, shares, opacities, center, time,
                   EVERY_ROW if conditioned is None else conditioned)  # fmt: skip
    return outputs[0], outputs[1], outputs[2]


def _beta_widths(tensors: dict[str, Tensor], numbers: dict[str, Any]) -> dict[str, int]:
    """Return how many Gaussians change, and the numbers of parameters over direction and, if it is given, time."""
    K = 3 + ("times" in tensors)
    return conditioned_rows(tensors, numbers) | {"precisions": 3 + K, "couplings": 3 * K, "exponents": 1 + K}


_direct_beta = Operation(
    "slice_direct_beta",
    inputs={
        "means": Input("N 3", Gradient.ADDED),
        "directions": Input("N 3", Gradient.ADDED),
        "times": Input("N 1", Gradient.ADDED, left_out_with="time"),
        "scales": Input("N 3", Gradient.ADDED),
        "skew": Input("N 3", Gradient.ADDED),
        "precision": Input("N precisions", Gradient.ADDED),
        "coupling": Input("N couplings", Gradient.ADDED),
        "betas": Input("N exponents", Gradient.ADDED),
        "opacities": Input("N", Gradient.ADDED),
        "center": Input("3", Gradient.REFUSED),
        "time": Input("", Gradient.REFUSED, left_out_with="time"),
    },
    outputs=SLICE | {"shapes": Output("N")},
    numbers={"conditioned": int},
    derive=_beta_widths,
    memory="a slice's Gaussians",
)


def slice_direct_beta(
    means: Tensor,  # [N, 3]
    directions: Tensor,  # [N, 3]
    times: Tensor | None,  # [N, 1], None: time is not observed
    scales: Tensor,  # [N, 3], of which sizes are softplus
    skew: Tensor,  # [N, 3]
    precision: Tensor,  # [N, 6 or 7]
    coupling: Tensor,  # [N, 3 K], K numbers are observed
    betas: Tensor,  # [N, 1 + K]
    opacities: Tensor,  # [N] logits
    center: Tensor,  # [3]
    time: Tensor | None,  # []
    *,
    conditioned: int | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return means [N, 3], factors [N, 3, 3], opacities [N] and profile exponents [N] of dBS Gaussians for a view.

    `gsbench.models.moving.DirectBetaModel` has the formulas and describes the parameters. Only the first `conditioned`
    Gaussians (None: all) depend on the camera and the time. The others are static.

    Raises:
        InputError: tensors are not float32 on one device, their shapes do not match, `center` or `time` requires a
            gradient, or `conditioned` exceeds N.
    """
    outputs = _direct_beta(means, directions, times, scales, skew, precision, coupling, betas, opacities, center,
                        None if times is None else time, EVERY_ROW if conditioned is None else conditioned)  # fmt: skip
    return outputs[0], outputs[1], outputs[2], outputs[3]


_free_time = Operation(
    "slice_free_time",
    inputs={
        "means": Input("N 3", Gradient.ADDED),
        "times": Input("N 1", Gradient.ADDED),
        "scales": Input("N 3", Gradient.ADDED),
        "quats": Input("N 4", Gradient.ADDED),
        "durations": Input("N 1", Gradient.ADDED),
        "velocities": Input("N 3", Gradient.ADDED),
        "opacities": Input("N", Gradient.ADDED),
        "time": Input("", Gradient.REFUSED),
    },
    outputs=SLICE,
    numbers={"conditioned": int},
    derive=conditioned_rows,
    memory="a slice's Gaussians",
)


def slice_free_time(
    means: Tensor,  # [N, 3]
    times: Tensor,  # [N, 1]
    scales: Tensor,  # [N, 3] log scales
    quats: Tensor,  # [N, 4] wxyz
    durations: Tensor,  # [N, 1] log standard deviations in time
    velocities: Tensor,  # [N, 3]
    opacities: Tensor,  # [N] logits
    time: Tensor,  # []
    *,
    conditioned: int | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return means [N, 3], factors [N, 3, 3] and opacities [N] of FreeTimeGS Gaussians at a time.

    `gsbench.models.moving.FreeTimeModel` has the formulas. Only the first `conditioned` Gaussians (None: all) change
    with time. The others are static.

    Raises:
        InputError: tensors are not float32 on one device, their shapes do not match, `time` requires a gradient, or
            `conditioned` exceeds N.
    """
    outputs = _free_time(means, times, scales, quats, durations, velocities, opacities, time,
                      EVERY_ROW if conditioned is None else conditioned)  # fmt: skip
    return outputs[0], outputs[1], outputs[2]
