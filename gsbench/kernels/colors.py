"""Colours of Gaussians as one torch operation: spherical harmonics, and waves of time.

What cannot be drawn (an opacity below 1/255 after f_temp and f_dir) is left out, which changes no picture.
"""

from typing import Any

import torch
from torch import Tensor
from torch.library import custom_op

from gsbench.errors import InputError
from gsbench.kernels import native, threads
from gsbench.kernels.arrays import check, check_constant, number, plain, rows_like
from gsbench.kernels.cuda import observe as on_cuda

MAX_WAVES = 8  # as math/harmonics.h has it


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
    check("show_colors", arrays)
    check_constant("show_colors", "center", center)
    if not 0 <= degree <= 3 or not 1 <= waves <= MAX_WAVES or all_of % waves or all_of // waves < (degree + 1) ** 2:
        raise InputError(f"show_colors: expected degree 0 to 3 and 1 to 8 frequencies with (degree + 1)^2 coefficients "
                         f"each, got degree={degree}, waves={waves} and {all_of} coefficients")  # fmt: skip
    if waves == 1:
        times, time = means.new_empty(0, 1), means.new_empty(0)
    if times is None or time is None:
        raise InputError("show_colors: expected times and a time, as colours change with them (waves > 1)")
    return _show(sh0, shN, means, opacities.detach(), times[:, 0], center, time, degree, waves)


@custom_op("gsbench::show_colors", mutates_args=())
def _show(
    sh0: Tensor, shN: Tensor, means: Tensor, opacities: Tensor, times: Tensor, center: Tensor,
    time: Tensor, degree: int, waves: int,
) -> Tensor:  # fmt: skip
    colors = means.new_empty(len(means), 3)
    arrays = plain(sh0, shN, means, opacities, times, center)
    native().show_colors(*arrays, number(time), degree, waves, threads(), colors)
    return colors


@_show.register_fake
def _(_sh0: Tensor, _shN: Tensor, means: Tensor, *_: Any) -> Tensor:
    return means.new_empty(len(means), 3)


@custom_op("gsbench::show_colors_backward", mutates_args=())
def _show_backward(
    sh0: Tensor, shN: Tensor, means: Tensor, opacities: Tensor, times: Tensor, center: Tensor,
    time: Tensor, degree: int, waves: int, g_colors: Tensor, rows: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """Gradients of sh0, shN, means and times; with `rows` that of shN has those rows only, and no other has any."""
    out = _gradients(sh0, shN, means, times, rows)
    native().show_colors_backward(*plain(sh0, shN, means, opacities, times, center), number(time), degree, waves,
                                  threads(), *plain(g_colors), *out, rows)  # fmt: skip
    return out


@_show_backward.register_fake
def _(sh0: Tensor, shN: Tensor, means: Tensor, _opacities: Tensor, times: Tensor, *rest: Any) -> tuple[Tensor, ...]:
    return _gradients(sh0, shN, means, times, rest[-1])


def _gradients(
    sh0: Tensor, shN: Tensor, means: Tensor, times: Tensor, rows: Tensor | None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    written = len(shN) if rows is None else len(rows)
    return rows_like(sh0), shN.new_empty(written, *shN.shape[1:]), rows_like(means), rows_like(times)


def _show_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:  # noqa: ARG001
    ctx.save_for_backward(*inputs[:7])
    ctx.rest = inputs[7:]


def _show_gradient(ctx: Any, g_colors: Tensor) -> tuple[Tensor | None, ...]:
    shN, opacities = ctx.saved_tensors[1], ctx.saved_tensors[3]
    rows = None
    # Most of a model's numbers are in shN, most Gaussians of a clip are not there at any one time, and memory is what a
    # step waits for: where autograd will add this view's gradient to that of others, it gets the rows that have one.
    if shN.is_leaf and shN.grad is not None and not shN.is_cuda:
        rows = ((opacities >= 1 / 255) & (g_colors != 0).any(1)).nonzero()[:, 0]
    g_sh0, g_shN, g_means, g_times = _show_backward(*ctx.saved_tensors, *ctx.rest, g_colors, rows)
    if rows is not None:
        g_shN = torch.sparse_coo_tensor(rows[None], g_shN, shN.shape, is_coalesced=True, check_invariants=False)
    return g_sh0, g_shN, g_means, None, g_times, None, None, None, None


_show.register_kernel("cuda")(on_cuda.show)
_show_backward.register_kernel("cuda")(on_cuda.show_backward)
_show.register_autograd(_show_gradient, setup_context=_show_context)
