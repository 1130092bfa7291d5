"""Slice the geometry of a model: Gaussians with triangular and with rotated factors, or none to condition on."""

from typing import Any

from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.fields import Gradient, Input, Output
from gsbench.kernels.operation import EVERY_ROW, Operation, first_rows

_SLICE = {"means": Output("N 3"), "factors": Output("N 3 3"), "opacities": Output("N")}

_triangular = Operation(
    "observe_triangular",
    inputs={
        "means": Input("N 3"),
        "directions": Input("N 3", left_out_with="direction"),
        "times": Input("N 1", left_out_with="time"),
        "log_diagonal": Input("N rows"),
        "shape": Input("N 3"),
        "motion": Input("N moves"),
        "coupling": Input("N couplings"),
        "opacities": Input("N"),
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
    """How many rows change with the query."""
    return {"conditioned": first_rows("conditioned", numbers["conditioned"], given["means"])}


def _entries(given: dict[str, Tensor]) -> dict[str, int]:
    """How many numbers of each kind a factor over p and k conditioned variables has."""
    k = 3 * ("directions" in given) + ("times" in given)
    if k == 0:
        raise InputError("observe_triangular: expected directions, times or both, got neither")
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

    The square-root scheme of `gsbench.models.slicing` for the parameters of `gsbench.models.triangular`, with
    f_temp and f_dir (7DGS eq. 9 to 12) in the opacities. With `subtracts` by the scheme `cholesky` instead, which is
    there on the CPU only.

    Rows from `conditioned` on are static: no query changes their mean, their factor is L_pp alone, and their opacity
    has no f_temp and no f_dir. By all that they do not depend on their gradient is zero.

    Args:
        means: mu_p, world units.
        directions: mu_d.
        times: mu_t, clips.
        log_diagonal: logarithms of the factor's diagonal.
        shape: its entries within p.
        motion: those of p by d and t, world units.
        coupling: those within d and t.
        opacities: before the sigmoid.
        center: the camera's, world units.
        time: clips.
        log_lambda_d: ln lambda_d, the sensitivity of f_dir.
        log_lambda_t: ln lambda_t, that of f_temp.
        conditioned_first: whether the factor's rows are ordered (d, t, p), else (p, t, d).
        form: what entries below the diagonal are, a place in `gsbench.models.factors.OFF_DIAGONALS`.
        directional_half: whether f_dir has the 1/2 of 7DGS eq. 12.
        subtracts: by the scheme that forms S.
        conditioned: how many rows change with the query; all by default.

    Raises:
        InputError: not float32 on one device, shapes that do not fit, nothing is observed, a gradient by `center` or
            `time` is asked for, or more rows are conditioned than there are.
    """
    timed = times is not None
    seen = _triangular(means, directions, times, log_diagonal, shape, motion, coupling, opacities, center,
                       time if timed else None, log_lambda_d, log_lambda_t if timed else None,
                       0.5 if directional_half else 1.0, conditioned_first, form, subtracts,
                       EVERY_ROW if conditioned is None else conditioned)  # fmt: skip
    return seen[0], seen[1], seen[2]


_rotated = Operation(
    "observe_rotated",
    inputs={
        "means": Input("N 3"),
        "times": Input("N 1"),
        "scales": Input("N 4"),
        "left_quats": Input("N 4"),
        "right_quats": Input("N 4"),
        "opacities": Input("N"),
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

    The square-root scheme of `gsbench.models.slicing` for the parameters of `gsbench.models.gaussians4d`, with f_temp
    in the opacities, zero where it is not above 0.05 (4DGS).

    Rows from `conditioned` on are static: their factor is R diag(exp scales) over (x, y, z) as in 3DGS, with the
    rotation of `gsbench.models.factors.turn_of_space`, and their opacity has no f_temp. Their gradient by all else is
    zero.

    Args:
        means: world units.
        times: mu_t, clips.
        scales: logarithms of world units, that of time too.
        left_quats: any length but zero.
        right_quats: the same.
        opacities: before the sigmoid.
        clock: world units a clip.
        time: clips.
        log_lambda_t: ln lambda_t, the sensitivity of f_temp.
        conditioned: how many rows change with the time; all by default.

    Raises:
        InputError: not float32 on one device, shapes that do not fit, or more rows are conditioned than there are.
    """
    seen = _rotated(means, times, scales, left_quats, right_quats, opacities, clock, time, log_lambda_t,
                    EVERY_ROW if conditioned is None else conditioned)  # fmt: skip
    return seen[0], seen[1], seen[2]


_static = Operation(
    "observe_static",
    inputs={"scales": Input("N 3"), "quats": Input("N 4"), "opacities": Input("N")},
    outputs={"factors": Output("N 3 3"), "opacities": Output("N")},
    memory="a slice's Gaussians",
)


def slice_static(
    scales: Tensor,  # [N, 3] log scales
    quats: Tensor,  # [N, 4] wxyz
    opacities: Tensor,  # [N] logits
) -> tuple[Tensor, Tensor]:
    """Factors F = R diag(exp scales) [N, 3, 3] (3DGS eq. 6) and opacities [N] of Gaussians that are their own slice.

    Raises:
        InputError: not float32 on one device, or shapes that do not fit.
    """
    seen = _static(scales, quats, opacities)
    return seen[0], seen[1]
