"""Torch operations that observe a model: slices of Gaussians with triangular factors, and colours.

Both leave out what cannot be drawn (an opacity below 1/255 after f_temp and f_dir), which changes no picture.
"""

from typing import Any

import torch
from torch import Tensor
from torch.library import custom_op

from gsbench.errors import InputError
from gsbench.kernels import native, threads
from gsbench.kernels.cuda import observe as on_cuda


def observe_triangular(
    means: Tensor,  # [N, 3]
    directions: Tensor,  # [N, 3]
    times: Tensor | None,  # [N, 1], None: time is not observed
    log_diagonal: Tensor,  # [N, n], n = 6 without time, 7 with
    off_diagonal: Tensor,  # [N, n (n - 1) / 2]
    opacities: Tensor,  # [N] logits
    center: Tensor,  # [3]
    time: Tensor | None,  # []
    lambda_d: Tensor,  # []
    lambda_t: Tensor | None,  # []
    *,
    conditioned_first: bool,
    row_scaled: bool = False,
    directional_half: bool = True,
) -> tuple[Tensor, Tensor, Tensor]:
    """Slice 6D or 7D Gaussians as seen from `center` at `time`: means [N, 3], factors [N, 3, 3], opacities [N].

    The square-root scheme of `gsbench.models.slicing` for the parameters of `gsbench.models.triangular`, with
    f_temp and f_dir (7DGS eq. 9 to 12) in the opacities. `conditioned_first` is the order of the factor's rows,
    (d, t, p), else (p, t, d).

    Raises:
        InputError: not float32 on one device, shapes that do not fit, or a gradient by `center` is asked for.
    """
    N, n = len(means), 6 if times is None else 7
    empty = means.new_empty(0)
    arrays = {"means": (means, (N, 3)), "directions": (directions, (N, 3)), "log_diagonal": (log_diagonal, (N, n)),
              "off_diagonal": (off_diagonal, (N, n * (n - 1) // 2)), "opacities": (opacities, (N,)),
              "center": (center, (3,))}  # fmt: skip
    if times is not None:
        arrays["times"] = (times, (N, 1))
    _check("observe_triangular", arrays)
    return _observe(
        means, directions, empty if times is None else times[:, 0], log_diagonal, off_diagonal, opacities, center,
        empty if time is None or times is None else time, lambda_d, empty if lambda_t is None else lambda_t,
        0.5 if directional_half else 1.0, conditioned_first, row_scaled,
    )  # fmt: skip


@custom_op("gsbench::observe_triangular", mutates_args=())
def _observe(
    means: Tensor, directions: Tensor, times: Tensor, log_diagonal: Tensor, off_diagonal: Tensor, opacities: Tensor,
    center: Tensor, time: Tensor, lambda_d: Tensor, lambda_t: Tensor, half: float, conditioned_first: bool,
    row_scaled: bool,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    out = means.new_empty(len(means), 3), means.new_empty(len(means), 3, 3), means.new_empty(len(means))
    arrays = _plain(means, directions, times, log_diagonal, off_diagonal, opacities, center)
    native().observe_triangular(*arrays, *map(_number, (time, lambda_d, lambda_t)), half, conditioned_first, row_scaled,
                                threads(), *out)  # fmt: skip
    return out


@_observe.register_fake
def _(means: Tensor, *_: Any) -> tuple[Tensor, Tensor, Tensor]:
    N = len(means)
    return means.new_empty(N, 3), means.new_empty(N, 3, 3), means.new_empty(N)


@custom_op("gsbench::observe_triangular_backward", mutates_args=())
def _observe_backward(
    means: Tensor, directions: Tensor, times: Tensor, log_diagonal: Tensor, off_diagonal: Tensor, opacities: Tensor,
    center: Tensor, time: Tensor, lambda_d: Tensor, lambda_t: Tensor, half: float, conditioned_first: bool,
    row_scaled: bool, g_means: Tensor, g_factors: Tensor, g_opacities: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    arrays = _plain(means, directions, times, log_diagonal, off_diagonal, opacities)
    out = tuple(x.new_empty(x.shape) for x in arrays)
    lambdas = means.new_empty(2)
    native().observe_triangular_backward(
        *arrays, *_plain(center), *map(_number, (time, lambda_d, lambda_t)), half, conditioned_first, row_scaled,
        threads(), *_plain(g_means, g_factors, g_opacities), *out, lambdas,
    )  # fmt: skip
    return out[0], out[1], out[2], out[3], out[4], out[5], lambdas


@_observe_backward.register_fake
def _(*arrays: Any) -> tuple[Tensor, ...]:
    return *(x.new_empty(x.shape) for x in arrays[:6]), arrays[0].new_empty(2)


def _observe_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:  # noqa: ARG001
    ctx.save_for_backward(*inputs[:10])
    ctx.rest = inputs[10:]


def _observe_gradient(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
    *g, lambdas = _observe_backward(*ctx.saved_tensors, *ctx.rest, *grads)
    return *g, None, None, lambdas[0], lambdas[1] if ctx.needs_input_grad[9] else None, None, None, None


_observe.register_kernel("cuda")(on_cuda.observe)
_observe_backward.register_kernel("cuda")(on_cuda.observe_backward)
_observe.register_autograd(_observe_gradient, setup_context=_observe_context)


def show_colors(
    sh0: Tensor,  # [N, 1, 3]
    shN: Tensor,  # [N, waves * K - 1, 3]
    means: Tensor,  # [N, 3]
    opacities: Tensor,  # [N]
    center: Tensor,  # [3]
    degree: int,
    times: Tensor | None = None,  # [N, 1]
    time: float = 0.0,
    waves: int = 1,
) -> Tensor:  # [N, 3]
    """Colours max(0, sum beta_nlm cos(2 pi n (t - mu_t)) Y_lm(d) + 0.5), d the direction from `center` to the mean.

    The same as `gsbench.models.appearance.sh_colors` (waves = 1) and `sh_time_colors`, and zero for Gaussians whose
    opacity is below 1/255. K harmonics are stored a frequency, (degree + 1)^2 of them are used.

    Raises:
        InputError: not float32 on one device, or shapes that do not fit.
    """
    N, all_of = len(means), shN.shape[1] + 1 if shN.dim() == 3 else 0
    arrays = {"sh0": (sh0, (N, 1, 3)), "shN": (shN, (N, all_of - 1, 3)), "means": (means, (N, 3)),
              "opacities": (opacities, (N,)), "center": (center, (3,))}  # fmt: skip
    if times is not None:
        arrays["times"] = (times, (N, 1))
    _check("show_colors", arrays)
    if not 0 <= degree <= 3 or not 1 <= waves <= 8 or all_of % waves or all_of // waves < (degree + 1) ** 2:
        raise InputError(f"show_colors: expected degree 0 to 3 and 1 to 8 frequencies with (degree + 1)^2 coefficients "
                         f"each, got degree={degree}, waves={waves} and {all_of} coefficients")  # fmt: skip
    if waves > 1 and times is None:
        raise InputError("show_colors: expected times, as colours change with them (waves > 1)")
    mu_t = means.new_empty(0) if times is None or waves == 1 else times[:, 0]
    return _show(sh0, shN, means, opacities.detach(), mu_t, center, time, degree, waves)


@custom_op("gsbench::show_colors", mutates_args=())
def _show(
    sh0: Tensor, shN: Tensor, means: Tensor, opacities: Tensor, times: Tensor, center: Tensor,
    time: float, degree: int, waves: int,
) -> Tensor:  # fmt: skip
    colors = means.new_empty(len(means), 3)
    native().show_colors(*_plain(sh0, shN, means, opacities, times, center), time, degree, waves, threads(), colors)
    return colors


@_show.register_fake
def _(_sh0: Tensor, _shN: Tensor, means: Tensor, *_: Any) -> Tensor:
    return means.new_empty(len(means), 3)


@custom_op("gsbench::show_colors_backward", mutates_args=())
def _show_backward(
    sh0: Tensor, shN: Tensor, means: Tensor, opacities: Tensor, times: Tensor, center: Tensor,
    time: float, degree: int, waves: int, g_colors: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    out = tuple(x.new_empty(x.shape) for x in (sh0, shN, means, times))
    native().show_colors_backward(*_plain(sh0, shN, means, opacities, times, center), time, degree, waves, threads(),
                                  *_plain(g_colors), *out)  # fmt: skip
    return out[0], out[1], out[2], out[3]


@_show_backward.register_fake
def _(sh0: Tensor, shN: Tensor, means: Tensor, _opacities: Tensor, times: Tensor, *_: Any) -> tuple[Tensor, ...]:
    return tuple(x.new_empty(x.shape) for x in (sh0, shN, means, times))


def _show_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:  # noqa: ARG001
    ctx.save_for_backward(*inputs[:6])
    ctx.rest = inputs[6:]


def _show_gradient(ctx: Any, g_colors: Tensor) -> tuple[Tensor | None, ...]:
    g = _show_backward(*ctx.saved_tensors, *ctx.rest, g_colors)
    return g[0], g[1], g[2], None, g[3], None, None, None, None


_show.register_kernel("cuda")(on_cuda.show)
_show_backward.register_kernel("cuda")(on_cuda.show_backward)
_show.register_autograd(_show_gradient, setup_context=_show_context)


def _number(tensor: Tensor) -> float:
    """The value of a scalar, 0 of an empty tensor."""
    return float(tensor.item()) if tensor.numel() else 0.0


def _plain(*tensors: Tensor) -> tuple[Tensor, ...]:
    """The same values in rows, without their graph, which may not cross DLPack."""
    return tuple(t.detach().contiguous() for t in tensors)


def _check(operation: str, arrays: dict[str, tuple[Tensor, tuple[int, ...]]]) -> None:
    for name, (tensor, shape) in arrays.items():
        if tuple(tensor.shape) != shape:
            raise InputError(f"{operation}: expected {name} of shape {list(shape)}, got {list(tensor.shape)}")
        device = arrays["means"][0].device
        if tensor.dtype != torch.float32 or tensor.device != device or device.type not in ("cpu", "cuda"):
            raise InputError(f"{operation}: expected {name} as float32 on the CPU or a GPU, all on one, got "
                             f"{tensor.dtype} on {tensor.device}")  # fmt: skip
    if arrays["center"][0].requires_grad:
        raise InputError(f"{operation} has no gradient by center: detach it")
