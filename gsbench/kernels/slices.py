"""Compute 3D Gaussians at a camera and a time (a slice) from 7D, 6D or 4D ones, or from 3D ones that do not change."""

from typing import Any

from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.fields import Gradient, Input, Output
from gsbench.kernels.operation import EVERY_ROW, Operation, first_rows

_SLICE = {"means": Output("N 3"), "factors": Output("N 3 3"), "opacities": Output("N")}

_triangular = Operation(
    "slice_triangular",
    inputs={
        "means": Input("N 3", Gradient.ADDED),
        "directions": Input("N 3", Gradient.ADDED, left_out_with="direction"),
        "times": Input("N 1", Gradient.ADDED, left_out_with="time"),
        "log_diagonal": Input("N rows", Gradient.ADDED),
        "shape": Input("N 3", Gradient.ADDED),
        "motion": Input("N moves", Gradient.ADDED),
        "coupling": Input("N couplings", Gradient.ADDED),
        "opacities": Input("N", Gradient.ADDED),
        "center": Input("3", Gradient.REFUSED),
        "time": Input("", Gradient.REFUSED, left_out_with="time"),
        "log_lambda_d": Input("", Gradient.SUMMED, left_out_with="direction"),
        "log_lambda_t": Input("", Gradient.SUMMED, left_out_with="time"),
    },
    outputs=_SLICE,
    numbers={"half": float, "conditioned_first": bool, "form": int, "subtracts": bool, "conditioned": int},
    derive=lambda given, numbers: _entries(given) | _conditioned(given, numbers),
    memory="a slice's Gaussians",
)


def _conditioned(given: dict[str, Tensor], numbers: dict[str, Any]) -> dict[str, int]:
    """Return how many rows change with the camera and time."""
    return {"conditioned": first_rows("conditioned", numbers["conditioned"], given["means"])}


def _entries(given: dict[str, Tensor]) -> dict[str, int]:
    """Return how many numbers of each kind a factor over p and k conditioned variables has."""
    k = 3 * ("directions" in given) + ("times" in given)
    if k == 0:
        raise InputError("slice_triangular: expected directions, times or both, got neither")
    return {"rows": k + 3, "moves": 3 * k, "couplings": k * (k - 1) // 2}


def slice_triangular(
    means: Tensor,  # [N, 3]
    directions: Tensor | None,  # [N, 3], None: direction is not observed
    times: Tensor | None,  # [N, 1], None: time is not observed
    log_diagonal: Tensor,  # [N, k + 3], k numbers are observed
    shape: Tensor,  # [N, 3]
    motion: Tensor,  # [N, 3 k]
    coupling: Tensor,  # [N, k (k - 1) / 2]
    opacities: Tensor,  # [N] logits
    center: Tensor,  # [3]
    time: Tensor | None,  # []
    log_lambda_d: Tensor | None,  # []
    log_lambda_t: Tensor | None,  # []
    *,
    conditioned_first: bool,
    form: int = 0,
    directional_half: bool = True,
    subtracts: bool = False,
    conditioned: int | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Slice Gaussians over p and d, t or both at a query: means [N, 3], factors [N, 3, 3], opacities [N].

    The scheme is `square_root` of `gsbench.models.slicing`, for the parameters of `gsbench.models.triangular`.
    Opacities include f_temp and f_dir (7DGS eq. 9 to 12). With `subtracts` the scheme is `cholesky`, on the CPU only.

    Rows from `conditioned` on are static: no query changes their mean, their factor is L_pp alone, and their opacity
    has no f_temp and no f_dir. The gradient of all other parameters is zero.

    Args:
        means: the mean positions mu_p, world units.
        directions: the mean directions mu_d.
        times: the mean times mu_t; 1 is the length of the sequence.
        log_diagonal: the logarithms of the factor's diagonal.
        shape: the entries of the factor within p (below its diagonal).
        motion: the entries of the factor between p and d or t, world units.
        coupling: the entries of the factor within d and t.
        opacities: the opacities before the sigmoid (logits).
        center: the camera's centre, world units.
        time: the time at which to slice; 1 is the length of the sequence.
        log_lambda_d: ln lambda_d, the coefficient of f_dir.
        log_lambda_t: ln lambda_t, the coefficient of f_temp.
        conditioned_first: whether the factor's rows are ordered (d, t, p), else (p, t, d).
        form: the form of entries below the diagonal, an index of `gsbench.models.factors.OFF_DIAGONALS`.
        directional_half: whether f_dir has the 1/2 of 7DGS eq. 12.
        subtracts: whether the scheme is `cholesky`, which forms S.
        conditioned: how many rows change with the query, by default all.

    Raises:
        InputError: tensors are not float32 on one device, their shapes do not fit, nothing is observed, a gradient by
            `center` or `time` is asked for, or more rows are conditioned than there are.
    """
    timed = times is not None
    seen = _triangular(means, directions, times, log_diagonal, shape, motion, coupling, opacities, center,
                       time if timed else None, log_lambda_d, log_lambda_t if timed else None,
                       0.5 if directional_half else 1.0, conditioned_first, form, subtracts,
                       EVERY_ROW if conditioned is None else conditioned)  # fmt: skip
    return seen[0], seen[1], seen[2]


_rotated = Operation(
    "slice_rotated",
    inputs={
        "means": Input("N 3", Gradient.ADDED),
        "times": Input("N 1", Gradient.ADDED),
        "scales": Input("N 4", Gradient.ADDED),
        "left_quats": Input("N 4", Gradient.ADDED),
        "right_quats": Input("N 4", Gradient.ADDED),
        "opacities": Input("N", Gradient.ADDED),
        "clock": Input("", Gradient.REFUSED),
        "time": Input("", Gradient.REFUSED),
        "log_lambda_t": Input("", Gradient.SUMMED),
    },
    outputs=_SLICE,
    numbers={"conditioned": int},
    derive=lambda given, numbers: _conditioned(given, numbers),
    memory="a slice's Gaussians",
)


def slice_rotated(
    means: Tensor,  # [N, 3]
    times: Tensor,  # [N, 1]
    scales: Tensor,  # [N, 4] log scales of x, y, z, t
    left_quats: Tensor,  # [N, 4]
    right_quats: Tensor,  # [N, 4]
    opacities: Tensor,  # [N] logits
    clock: Tensor,  # []
    time: Tensor,  # []
    log_lambda_t: Tensor,  # []
    *,
    conditioned: int | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Slice 4D Gaussians F = M_left M_right diag(exp scales) at `time`: means [N, 3], factors [N, 3, 3], opacities [N].

    The scheme is `square_root` of `gsbench.models.slicing`, for the parameters of `gsbench.models.gaussians4d`.
    Opacities include f_temp, and are zero if it is not above 0.05 (4DGS).

    Rows from `conditioned` on are static: their factor is R diag(exp scales) over (x, y, z) as in 3DGS, with the
    rotation of `gsbench.models.factors.turn_of_space`, and their opacity has no f_temp. The gradient of all other
    parameters is zero.

    Args:
        means: the mean positions, world units.
        times: the mean times mu_t; 1 is the length of the sequence.
        scales: the logarithms of the standard deviations along four axes, world units.
        left_quats: the left quaternions, of any length but zero.
        right_quats: the right quaternions, of any length but zero.
        opacities: the opacities before the sigmoid (logits).
        clock: the number of world units that the length of the sequence counts as.
        time: the time at which to slice; 1 is the length of the sequence.
        log_lambda_t: ln lambda_t, the coefficient of f_temp.
        conditioned: how many rows change with the time, by default all.

    Raises:
        InputError: tensors are not float32 on one device, their shapes do not fit, or `conditioned` exceeds the rows.
    """
    seen = _rotated(means, times, scales, left_quats, right_quats, opacities, clock, time, log_lambda_t,
                    EVERY_ROW if conditioned is None else conditioned)  # fmt: skip
    return seen[0], seen[1], seen[2]


_static = Operation(
    "slice_static",
    inputs={
        "scales": Input("N 3", Gradient.ADDED),
        "quats": Input("N 4", Gradient.ADDED),
        "opacities": Input("N", Gradient.ADDED),
    },
    outputs={"factors": Output("N 3 3"), "opacities": Output("N")},
    memory="a slice's Gaussians",
)


def slice_static(
    scales: Tensor,  # [N, 3] log scales
    quats: Tensor,  # [N, 4] wxyz
    opacities: Tensor,  # [N] logits
) -> tuple[Tensor, Tensor]:
    """Return factors F = R diag(exp scales) [N, 3, 3] (3DGS eq. 6) and opacities [N] of 3D Gaussians, their own slices.

    Raises:
        InputError: tensors are not float32 on one device, or their shapes do not fit.
    """
    seen = _static(scales, quats, opacities)
    return seen[0], seen[1]
