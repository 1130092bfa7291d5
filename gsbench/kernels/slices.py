"""Compute the 3D Gaussians (slice) of each model for one camera and time; `gsbench.models` has the formulas.

A slice has means, factors F of the covariances F F^T, and opacities in [0, 1]; Beta profiles have exponents too. Raw
opacities are logits. Time is in [0, 1], and lengths are in world units. Only the first `conditioned` Gaussians depend
on the camera and the time; all do by default. The others are static: a static Gaussian keeps its mean, its covariance
is that of position alone, its opacity does not change, and parameters of time and direction get zero gradients.

On a GPU, one call slices for several views, with centres [views, 3] and times [views]; the outputs are [views, N, ..].
"""

from collections.abc import Callable
from typing import Any

from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.operation import EVERY_ROW, Gradient, Input, Operation, Output, Sizes, first_rows, has_leading

SLICE = {"means": Output("?views N 3"), "factors": Output("?views N 3 3"), "opacities": Output("?views N")}
MEMORY = "a slice's Gaussians"  # what is too large, for messages
BETA_SLICE = SLICE | {"shapes": Output("?views N")}  # exponents of the Beta profiles
OPACITIES = Input("N", Gradient.ADDED)

Derive = Callable[[dict[str, Tensor], dict[str, Any]], Sizes]


def _parameter(shape: str, left_out_with: str | None = None) -> Input:
    """Declare a parameter of Gaussians; AGR, the neural refinement, may have changed it for each view."""
    return Input(f"?views {shape}", Gradient.ADDED, left_out_with=left_out_with)


def _of_view(shape: str, left_out_with: str | None = None) -> Input:
    """Declare a camera centre or a time, by which there is no gradient."""
    return Input(f"?views {shape}", Gradient.REFUSED, left_out_with=left_out_with)


def _views(name: str, inputs: dict[str, Input], tensors: dict[str, Tensor]) -> Sizes:
    """Return the number of views V of a slice, and whether each has parameters of its own.

    Raises:
        InputError: only some of the centres and times, or of the parameters, are those of several views.
    """
    dims = {key: len(x.shape.split()) - 1 for key, x in inputs.items() if "?views" in x.shape}  # without views
    of_view = {key: count for key, count in dims.items() if inputs[key].gradient is Gradient.REFUSED}  # see `_of_view`
    raw = {key: count for key, count in dims.items() if key not in of_view}
    many = has_leading(name, tensors, of_view)
    raw_per_view = has_leading(name, tensors, raw)
    if raw_per_view and not many:
        raise InputError(f"{name}: expected {' and '.join(of_view)} of each view, as parameters are, got those of one")
    V = next(len(tensors[key]) for key in of_view if key in tensors) if many else 1
    return {"V": V, "raw_per_view": int(raw_per_view)}


def _conditioned(tensors: dict[str, Tensor], numbers: dict[str, Any]) -> Sizes:
    """Return how many Gaussians, counted from the first, change with the camera and the time."""
    return {"conditioned": first_rows("conditioned", numbers["conditioned"], tensors["opacities"])}


def _conditional_slice(
    name: str,
    *,
    inputs: dict[str, Input],
    outputs: dict[str, Output] = SLICE,
    numbers: dict[str, type] | None = None,
    defaults: dict[str, Any] | None = None,
    derive: Derive = lambda *_: {},
) -> Operation:
    """Declare an operation whose first `conditioned` Gaussians depend on the camera and the time."""
    return Operation(
        name,
        inputs=inputs,
        outputs=outputs,
        numbers=(numbers or {}) | {"conditioned": int},
        defaults=(defaults or {}) | {"conditioned": EVERY_ROW},
        derive=lambda tensors, numbers: (
            derive(tensors, numbers) | _conditioned(tensors, numbers) | _views(name, inputs, tensors)
        ),
        memory=MEMORY,
    )


slice_static = Operation(  # 3DGS: F = R diag(exp scales)
    "slice_static",
    inputs={
        "scales": _parameter("N 3"),  # logarithms
        "quats": _parameter("N 4"),  # wxyz
        "opacities": OPACITIES,
    },
    outputs={key: SLICE[key] for key in ("factors", "opacities")},
    derive=lambda tensors, _: {
        "V": len(tensors["scales"]) if has_leading("slice_static", tensors, {"scales": 2, "quats": 2}) else 1
    },
    memory=MEMORY,
)


def _sizes(tensors: dict[str, Tensor], _: dict[str, Any]) -> Sizes:
    """Return the numbers of parameters over position and the directions and times that are there."""
    k = 3 * ("directions" in tensors) + ("times" in tensors)  # dimensions beside position
    if k == 0:
        raise InputError("slice_triangular: expected directions, times or both, got neither")
    couplings = k * (k - 1) // 2  # between any two of the k
    return {"rows": 3 + k, "moves": 3 * k, "couplings": couplings, "entries": 3 * k + couplings, "exponents": 1 + k}


slice_triangular = _conditional_slice(  # 6DGS and 7DGS, whose opacities include f_temp and f_dir (7DGS, eq. 9 to 12)
    "slice_triangular",
    inputs={
        "means": _parameter("N 3"),
        "directions": _parameter("N 3", "direction"),
        "times": _parameter("N 1", "time"),
        "log_diagonal": _parameter("N rows"),  # logarithms of the diagonal of the Cholesky factor
        "shape": _parameter("N 3"),  # its entries between components of position,
        "motion": _parameter("N moves"),  # between position and direction or time,
        "coupling": _parameter("N couplings"),  # and between components of direction and time
        "opacities": OPACITIES,
        "center": _of_view("3"),
        "time": _of_view("", "time"),
        "log_lambda_d": Input("", Gradient.SUMMED, left_out_with="direction"),
        "log_lambda_t": Input("", Gradient.SUMMED, left_out_with="time"),
    },
    numbers={
        "half": float,  # the factor in the exponent of f_dir, 1/2 in 7DGS eq. 12
        "conditioned_first": bool,  # whether rows are ordered (d, t, p), otherwise (p, t, d)
        "form": int,  # how entries below the diagonal are parametrised, an index of `models.factors.OFF_DIAGONALS`
        "subtracts": bool,  # whether covariances are subtracted, the method `cholesky`, for comparison (CPU only)
    },
    defaults={"half": 0.5, "form": 0, "subtracts": False},
    derive=_sizes,
)

slice_rotated = (
    _conditional_slice(  # 4DGS: F = M_left M_right diag(exp scales); an f_temp of at most 0.05 counts as zero
        "slice_rotated",
        inputs={
            "means": _parameter("N 3"),
            "times": _parameter("N 1"),
            "scales": _parameter("N 4"),  # logarithms, along four axes
            "left_quats": _parameter("N 4"),
            "right_quats": _parameter("N 4"),
            "opacities": OPACITIES,
            "clock": Input("", Gradient.REFUSED),  # world units along the fourth axis that equal the sequence's length
            "time": _of_view(""),
            "log_lambda_t": Input("", Gradient.SUMMED),
        },
    )
)

_UNIVERSAL = {
    "means": _parameter("N 3"),
    "directions": _parameter("N 3"),
    "times": _parameter("N 1", "time"),
    "scales": _parameter("N rows"),  # of position, direction and time; sizes are their softplus
    "skew": _parameter("N 3"),  # A_01, A_02, A_12 of the rotation I + A
    "lower": _parameter("N entries"),  # of direction and time, below the diagonal of the factor
    "betas": _parameter("N exponents"),  # of the profile, of direction and of time
    "opacities": OPACITIES,
    "center": _of_view("3"),
    "time": _of_view("", "time"),
}


slice_universal = Operation(  # UBS
    "slice_universal",
    inputs=_UNIVERSAL,
    outputs=BETA_SLICE,
    derive=lambda tensors, numbers: _sizes(tensors, numbers) | _views("slice_universal", _UNIVERSAL, tensors),
    memory=MEMORY,
)

slice_direct = _conditional_slice(  # dGS
    "slice_direct",
    inputs={
        "means": _parameter("N 3"),
        "directions": _parameter("N 3"),
        "times": _parameter("N 1"),  # logits
        "scales": _parameter("N 3"),  # logarithms
        "quats": _parameter("N 4"),
        "precision": _parameter("N 7"),
        "coupling": _parameter("N 12"),
        "shares": _parameter("N 2"),  # logits
        "opacities": OPACITIES,
        "center": _of_view("3"),
        "time": _of_view(""),
    },
)


slice_direct_beta = _conditional_slice(  # dBS
    "slice_direct_beta",
    inputs={
        "means": _parameter("N 3"),
        "directions": _parameter("N 3"),
        "times": _parameter("N 1", "time"),
        "scales": _parameter("N 3"),  # sizes are their softplus
        "skew": _parameter("N 3"),
        "precision": _parameter("N rows"),
        "coupling": _parameter("N moves"),
        "betas": _parameter("N exponents"),
        "opacities": OPACITIES,
        "center": _of_view("3"),
        "time": _of_view("", "time"),
    },
    outputs=BETA_SLICE,
    derive=_sizes,
)

slice_free_time = _conditional_slice(  # FreeTimeGS and, with plateaus, SharpTimeGS
    "slice_free_time",
    inputs={
        "means": _parameter("N 3"),
        "times": _parameter("N 1"),
        "scales": _parameter("N 3"),  # logarithms
        "quats": _parameter("N 4"),
        "durations": _parameter("N 1"),  # logarithms
        "plateaus": _parameter("N 1", "plateau"),  # logarithms
        "velocities": _parameter("N 3"),
        "opacities": OPACITIES,
        "time": _of_view(""),
    },
)
