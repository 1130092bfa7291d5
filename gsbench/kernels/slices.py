"""Compute the conditional 3D Gaussians (slice) of 7D, 6D, 4D or Universal Beta Gaussians for one camera and time.

3D Gaussians are converted to the same form.
"""

from typing import Any

from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.fields import Gradient, Input, Output
from gsbench.kernels.operation import EVERY_ROW, Operation, first_rows

SLICE = {"means": Output("N 3"), "factors": Output("N 3 3"), "opacities": Output("N")}

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
    outputs=SLICE,
    numbers={"half": float, "conditioned_first": bool, "form": int, "subtracts": bool, "conditioned": int},
    derive=lambda tensors, numbers: _entries(tensors) | conditioned_rows(tensors, numbers),
    memory="a slice's Gaussians",
)


def conditioned_rows(tensors: dict[str, Tensor], numbers: dict[str, Any]) -> dict[str, int]:
    """Return how many Gaussians, counted from the first, change with the camera and the time."""
    return {"conditioned": first_rows("conditioned", numbers["conditioned"], tensors["means"])}


def _entries(tensors: dict[str, Tensor]) -> dict[str, int]:
    """Return the numbers of rows and of trained entries of a Cholesky factor over position, time and direction."""
    k = 3 * ("directions" in tensors) + ("times" in tensors)
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
    """Compute the conditional 3D Gaussians of 6DGS or 7DGS Gaussians for a camera centre and a time.

    Return means [N, 3], factors [N, 3, 3] of the covariances, and opacities [N], which include f_temp and f_dir (7DGS
    eq. 9 to 12). The method is `square_root` of `gsbench.models.slicing`. Variables are position p, direction d and
    time t; 6DGS has no t, and a model may have no d.

    Only the first `conditioned` Gaussians depend on the camera and the time. The others are static: their mean does not
    change, their factor is its block for p, and their opacity has no f_temp and f_dir. Their other parameters get zero
    gradients.

    Args:
        means: the mean positions mu_p, world units.
        directions: the mean directions mu_d.
        times: the mean times mu_t; 1 is the length of the sequence.
        log_diagonal: the logarithms of the triangular factor's diagonal.
        shape: the entries of the factor between components of p, below its diagonal.
        motion: the entries of the factor between p and d or t, world units.
        coupling: the entries of the factor between components of d and t.
        opacities: the opacities before the sigmoid (logits).
        center: the camera's centre, world units.
        time: the time at which to slice; 1 is the length of the sequence.
        log_lambda_d: ln lambda_d, the coefficient in the exponent of f_dir.
        log_lambda_t: ln lambda_t, the coefficient in the exponent of f_temp.
        conditioned_first: whether the factor's rows are ordered (d, t, p); otherwise (p, t, d).
        form: how entries below the diagonal are parametrised, an index of `gsbench.models.factors.OFF_DIAGONALS`.
        directional_half: whether the exponent of f_dir has the factor 1/2 of 7DGS eq. 12.
        subtracts: whether to use the method `cholesky`, which subtracts covariances (CPU only, for comparison).
        conditioned: how many Gaussians depend on camera and time; None for all.

    Raises:
        InputError: tensors are not float32 on one device, their shapes do not match, both `directions` and `times` are
            missing, `center` or `time` requires a gradient, or `conditioned` exceeds N.
    """
    timed = times is not None
    outputs = _triangular(means, directions, times, log_diagonal, shape, motion, coupling, opacities, center,
                       time if timed else None, log_lambda_d, log_lambda_t if timed else None,
                       0.5 if directional_half else 1.0, conditioned_first, form, subtracts,
                       EVERY_ROW if conditioned is None else conditioned)  # fmt: skip
    return outputs[0], outputs[1], outputs[2]


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
    outputs=SLICE,
    numbers={"conditioned": int},
    derive=conditioned_rows,
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
    """Compute the conditional 3D Gaussians of 4DGS Gaussians at `time`: means [N, 3], factors [N, 3, 3], opacities [N].

    The 4D covariance is F F^T with F = M_left M_right diag(exp scales), in which two quaternions give the rotation
    matrices. The method is `square_root` of `gsbench.models.slicing`. Opacities include f_temp, and are zero if f_temp
    is at most 0.05 (4DGS).

    Only the first `conditioned` Gaussians change with time. The others are static: their factor is R diag(exp scales)
    over (x, y, z) as in 3DGS, with the rotation R of `gsbench.models.factors.turn_of_space`, and their opacity has no
    f_temp. Their other parameters get zero gradients.

    Args:
        means: the mean positions, world units.
        times: the mean times mu_t; 1 is the length of the sequence.
        scales: the logarithms of the standard deviations along four axes, world units.
        left_quats: the left quaternions, of any length but zero.
        right_quats: the right quaternions, of any length but zero.
        opacities: the opacities before the sigmoid (logits).
        clock: how many world units along the fourth axis equal the length of the sequence.
        time: the time at which to slice; 1 is the length of the sequence.
        log_lambda_t: ln lambda_t, the coefficient in the exponent of f_temp.
        conditioned: how many Gaussians change with time; None for all.

    Raises:
        InputError: tensors are not float32 on one device, their shapes do not match, or `conditioned` exceeds N.
    """
    outputs = _rotated(means, times, scales, left_quats, right_quats, opacities, clock, time, log_lambda_t,
                    EVERY_ROW if conditioned is None else conditioned)  # fmt: skip
    return outputs[0], outputs[1], outputs[2]


_universal = Operation(
    "slice_universal",
    inputs={
        "means": Input("N 3", Gradient.ADDED),
        "directions": Input("N 3", Gradient.ADDED),
        "times": Input("N 1", Gradient.ADDED, left_out_with="time"),
        "scales": Input("N rows", Gradient.ADDED),
        "skew": Input("N 3", Gradient.ADDED),
        "lower": Input("N entries", Gradient.ADDED),
        "betas": Input("N exponents", Gradient.ADDED),
        "opacities": Input("N", Gradient.ADDED),
        "center": Input("3", Gradient.REFUSED),
        "time": Input("", Gradient.REFUSED, left_out_with="time"),
    },
    outputs=SLICE | {"shapes": Output("N")},
    derive=lambda tensors, _: (
        {"rows": 7, "entries": 18, "exponents": 5} if "times" in tensors else {"rows": 6, "entries": 12, "exponents": 4}
    ),
    memory="a slice's Gaussians",
)


def slice_universal(
    means: Tensor,  # [N, 3]
    directions: Tensor,  # [N, 3]
    times: Tensor | None,  # [N, 1], None: time is not observed
    scales: Tensor,  # [N, 3 + k], k numbers are observed
    skew: Tensor,  # [N, 3]
    lower: Tensor,  # [N, 3 k + k (k - 1) / 2]
    betas: Tensor,  # [N, 1 + k]
    opacities: Tensor,  # [N] logits
    center: Tensor,  # [3]
    time: Tensor | None,  # []
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Compute the conditional 3D Gaussians of UBS for a camera centre and a time, by `gsbench.models.beta`, `whitened`.

    Return means [N, 3], factors [N, 3, 3] of the covariances, opacities [N] and exponents of the Beta profiles [N].

    Args:
        means: the mean positions, world units.
        directions: the mean directions.
        times: the mean times; 1 is the length of the sequence.
        scales: the sizes of position, direction and time before softplus.
        skew: the entries A_01, A_02, A_12 of the rotation I + A.
        lower: the entries below the diagonal of the factor's rows of direction and time, row by row.
        betas: the exponents before 4 exp: of the profile, of direction and of time.
        opacities: the opacities before the sigmoid (logits).
        center: the camera's centre, world units.
        time: the time at which to slice; 1 is the length of the sequence.

    Raises:
        InputError: tensors are not float32 on one device, their shapes do not match, or `center` or `time` requires a
            gradient.
    """
    outputs = _universal(means, directions, times, scales, skew, lower, betas, opacities, center,
                      time if times is not None else None)  # fmt: skip
    return outputs[0], outputs[1], outputs[2], outputs[3]


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
    """Return the factors F = R diag(exp scales) [N, 3, 3] (3DGS eq. 6) and the opacities [N] of 3D Gaussians.

    Raises:
        InputError: tensors are not float32 on one device, or their shapes do not match.
    """
    outputs = _static(scales, quats, opacities)
    return outputs[0], outputs[1]
