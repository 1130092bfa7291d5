"""Torch operations that observe the geometry of a model: slices with triangular and rotated factors, or none."""

from typing import Any

from torch import Tensor
from torch.library import custom_op

from gsbench.kernels import native, threads
from gsbench.kernels.arrays import check, check_constant, number, plain, rows_like
from gsbench.kernels.cuda import observe as on_cuda


def observe_triangular(
    means: Tensor,  # [N, 3]
    directions: Tensor,  # [N, 3]
    times: Tensor | None,  # [N, 1], None: time is not observed
    log_diagonal: Tensor,  # [N, k + 3], k = 3 without time, 4 with
    shape: Tensor,  # [N, 3]
    motion: Tensor,  # [N, 3 k]
    coupling: Tensor,  # [N, k (k - 1) / 2]
    opacities: Tensor,  # [N] logits
    center: Tensor,  # [3]
    time: Tensor | None,  # []
    lambda_d: Tensor,  # []
    lambda_t: Tensor | None,  # []
    *,
    conditioned_first: bool,
    form: int = 0,
    directional_half: bool = True,
    subtracts: bool = False,
) -> tuple[Tensor, Tensor, Tensor]:
    """Slice 6D or 7D Gaussians as seen from `center` at `time`: means [N, 3], factors [N, 3, 3], opacities [N].

    The square-root scheme of `gsbench.models.slicing` for the parameters of `gsbench.models.triangular`, with
    f_temp and f_dir (7DGS eq. 9 to 12) in the opacities. `conditioned_first` is the order of the factor's rows,
    (d, t, p), else (p, t, d); `form`, what its entries below the diagonal are, is a place in
    `gsbench.models.factors.OFF_DIAGONALS`. With `subtracts` by the scheme `cholesky` instead, which is there on the CPU
    only.

    Raises:
        InputError: not float32 on one device, shapes that do not fit, or a gradient by `center` is asked for.
    """
    N, k = len(means), 3 if times is None else 4
    empty = means.new_empty(0)
    arrays = {"means": (means, (N, 3)), "directions": (directions, (N, 3)), "log_diagonal": (log_diagonal, (N, k + 3)),
              "shape": (shape, (N, 3)), "motion": (motion, (N, 3 * k)), "coupling": (coupling, (N, k * (k - 1) // 2)),
              "opacities": (opacities, (N,)), "center": (center, (3,))}  # fmt: skip
    if times is not None:
        arrays["times"] = (times, (N, 1))
    check("observe_triangular", arrays)
    check_constant("observe_triangular", "center", center)
    return _observe(
        means, directions, empty if times is None else times[:, 0], log_diagonal, shape, motion, coupling, opacities,
        center, empty if time is None or times is None else time, lambda_d, empty if lambda_t is None else lambda_t,
        0.5 if directional_half else 1.0, conditioned_first, form, subtracts,
    )  # fmt: skip


@custom_op("gsbench::observe_triangular", mutates_args=())
def _observe(
    means: Tensor, directions: Tensor, times: Tensor, log_diagonal: Tensor, shape: Tensor, motion: Tensor,
    coupling: Tensor, opacities: Tensor, center: Tensor, time: Tensor, lambda_d: Tensor, lambda_t: Tensor, half: float,
    conditioned_first: bool, form: int, subtracts: bool,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    out = means.new_empty(len(means), 3), means.new_empty(len(means), 3, 3), means.new_empty(len(means))
    arrays = plain(means, directions, times, log_diagonal, shape, motion, coupling, opacities, center)
    native().observe_triangular(*arrays, *map(number, (time, lambda_d, lambda_t)), half, conditioned_first, form,
                                subtracts, threads(), *out)  # fmt: skip
    return out


@_observe.register_fake
def _(means: Tensor, *_: Any) -> tuple[Tensor, Tensor, Tensor]:
    N = len(means)
    return means.new_empty(N, 3), means.new_empty(N, 3, 3), means.new_empty(N)


@custom_op("gsbench::observe_triangular_backward", mutates_args=())
def _observe_backward(
    means: Tensor, directions: Tensor, times: Tensor, log_diagonal: Tensor, shape: Tensor, motion: Tensor,
    coupling: Tensor, opacities: Tensor, center: Tensor, time: Tensor, lambda_d: Tensor, lambda_t: Tensor, half: float,
    conditioned_first: bool, form: int, subtracts: bool, g_means: Tensor, g_factors: Tensor, g_opacities: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    arrays = plain(means, directions, times, log_diagonal, shape, motion, coupling, opacities)
    out = tuple(rows_like(x) for x in arrays)
    lambdas = means.new_empty(2)
    native().observe_triangular_backward(
        *arrays, *plain(center), *map(number, (time, lambda_d, lambda_t)), half, conditioned_first, form,
        subtracts, threads(), *plain(g_means, g_factors, g_opacities), *out, lambdas,
    )  # fmt: skip
    return out[0], out[1], out[2], out[3], out[4], out[5], out[6], out[7], lambdas


@_observe_backward.register_fake
def _(*arrays: Any) -> tuple[Tensor, ...]:
    return *(rows_like(x) for x in arrays[:8]), arrays[0].new_empty(2)


def _observe_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:  # noqa: ARG001
    ctx.save_for_backward(*inputs[:12])
    ctx.rest = inputs[12:]


def _observe_gradient(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
    *g, lambdas = _observe_backward(*ctx.saved_tensors, *ctx.rest, *grads)
    return *g, None, None, lambdas[0], lambdas[1] if ctx.needs_input_grad[11] else None, None, None, None, None


_observe.register_kernel("cuda")(on_cuda.observe)
_observe_backward.register_kernel("cuda")(on_cuda.observe_backward)
_observe.register_autograd(_observe_gradient, setup_context=_observe_context)


def _keep(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:  # noqa: ARG001
    ctx.save_for_backward(*inputs)


def observe_rotated(
    means: Tensor,  # [N, 3]
    times: Tensor,  # [N, 1]
    scales: Tensor,  # [N, 4] log scales of x, y, z, t
    left_quats: Tensor,  # [N, 4]
    right_quats: Tensor,  # [N, 4]
    opacities: Tensor,  # [N] logits
    time: Tensor,  # []
    lambda_t: Tensor,  # []
) -> tuple[Tensor, Tensor, Tensor]:
    """Slice 4D Gaussians F = M_left M_right diag(exp scales) at `time`: means [N, 3], factors [N, 3, 3], opacities [N].

    The square-root scheme of `gsbench.models.slicing` for the parameters of `gsbench.models.gaussians4d`, with f_temp
    in the opacities, zero where it is not above 0.05 (4DGS).

    Raises:
        InputError: not float32 on one device, or shapes that do not fit.
    """
    N = len(means)
    check("observe_rotated", {"means": (means, (N, 3)), "times": (times, (N, 1)), "scales": (scales, (N, 4)),
                              "left_quats": (left_quats, (N, 4)), "right_quats": (right_quats, (N, 4)),
                              "opacities": (opacities, (N,))})  # fmt: skip
    return _rotated(means, times[:, 0], scales, left_quats, right_quats, opacities, time, lambda_t)


@custom_op("gsbench::observe_rotated", mutates_args=())
def _rotated(
    means: Tensor, times: Tensor, scales: Tensor, left: Tensor, right: Tensor, opacities: Tensor,
    time: Tensor, lambda_t: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    out = means.new_empty(len(means), 3), means.new_empty(len(means), 3, 3), means.new_empty(len(means))
    native().observe_rotated(
        *plain(means, times, scales, left, right, opacities), number(time), number(lambda_t), threads(), *out
    )
    return out


@_rotated.register_fake
def _(means: Tensor, *_: Any) -> tuple[Tensor, Tensor, Tensor]:
    N = len(means)
    return means.new_empty(N, 3), means.new_empty(N, 3, 3), means.new_empty(N)


@custom_op("gsbench::observe_rotated_backward", mutates_args=())
def _rotated_backward(
    means: Tensor, times: Tensor, scales: Tensor, left: Tensor, right: Tensor, opacities: Tensor, time: Tensor,
    lambda_t: Tensor, g_means: Tensor, g_factors: Tensor, g_opacities: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    arrays = plain(means, times, scales, left, right, opacities)
    out = tuple(rows_like(x) for x in arrays)
    g_lambda = native().observe_rotated_backward(*arrays, number(time), number(lambda_t), threads(),
                                                 *plain(g_means, g_factors, g_opacities), *out)  # fmt: skip
    return out[0], out[1], out[2], out[3], out[4], out[5], means.new_tensor(g_lambda)


@_rotated_backward.register_fake
def _(*arrays: Any) -> tuple[Tensor, ...]:
    return *(rows_like(x) for x in arrays[:6]), rows_like(arrays[7])


def _rotated_gradient(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
    *g, g_lambda = _rotated_backward(*ctx.saved_tensors, *grads)
    return *g, None, g_lambda


_rotated.register_kernel("cuda")(on_cuda.rotated)
_rotated_backward.register_kernel("cuda")(on_cuda.rotated_backward)
_rotated.register_autograd(_rotated_gradient, setup_context=_keep)


def observe_still(
    scales: Tensor,  # [N, 3] log scales
    quats: Tensor,  # [N, 4] wxyz
    opacities: Tensor,  # [N] logits
) -> tuple[Tensor, Tensor]:
    """Factors F = R diag(exp scales) [N, 3, 3] (3DGS eq. 6) and opacities [N] of Gaussians that are their own slice.

    Raises:
        InputError: not float32 on one device, or shapes that do not fit.
    """
    N = len(scales)
    check("observe_still", {"scales": (scales, (N, 3)), "quats": (quats, (N, 4)), "opacities": (opacities, (N,))})
    factors, out = _still(scales, quats, opacities)
    return factors, out


@custom_op("gsbench::observe_still", mutates_args=())
def _still(scales: Tensor, quats: Tensor, opacities: Tensor) -> tuple[Tensor, Tensor]:
    out = scales.new_empty(len(scales), 3, 3), rows_like(opacities)
    native().observe_still(*plain(scales, quats, opacities), threads(), *out)
    return out


@_still.register_fake
def _(scales: Tensor, _quats: Tensor, opacities: Tensor) -> tuple[Tensor, Tensor]:
    return scales.new_empty(len(scales), 3, 3), rows_like(opacities)


@custom_op("gsbench::observe_still_backward", mutates_args=())
def _still_backward(
    scales: Tensor, quats: Tensor, opacities: Tensor, g_factors: Tensor, g_opacities: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    arrays = plain(scales, quats, opacities)
    out = tuple(rows_like(x) for x in arrays)
    native().observe_still_backward(*arrays, threads(), *plain(g_factors, g_opacities), *out)
    return out[0], out[1], out[2]


@_still_backward.register_fake
def _(*arrays: Tensor) -> tuple[Tensor, ...]:
    return tuple(rows_like(x) for x in arrays[:3])


def _still_gradient(ctx: Any, *grads: Tensor) -> tuple[Tensor, ...]:
    return tuple(_still_backward(*ctx.saved_tensors, *grads))


_still.register_kernel("cuda")(on_cuda.still)
_still_backward.register_kernel("cuda")(on_cuda.still_backward)
_still.register_autograd(_still_gradient, setup_context=_keep)
