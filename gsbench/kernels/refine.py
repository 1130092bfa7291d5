"""AGR's perceptrons as one torch operation: hidden layers stay in cache, and backward computes them again."""

from typing import Any

import torch
from torch import Tensor
from torch.library import custom_op

from gsbench.errors import InputError
from gsbench.kernels import native, threads
from gsbench.kernels.arrays import check, plain, rows_like
from gsbench.kernels.cuda import observe as on_cuda

HIDDEN = 64


def refine(
    values: list[Tensor],  # of [N, c]; those of the first P - 1 are the features, F numbers in all
    weight_in: Tensor,  # [P * 64, F]
    bias_in: Tensor,  # [P * 64]
    weights_out: list[Tensor],  # P of [c, 64]
    biases_out: list[Tensor],  # P of [c]
) -> list[Tensor]:  # of [N, c], as `values`
    """Values moved by P perceptrons F x 64 x c with ReLU, x + phi(features) (7DGS eq. 14 and 15).

    Perceptron i moves values i; the last one all that are left, in their order. What does not change from Gaussian to
    Gaussian, as gamma(t), belongs into `bias_in`.

    Raises:
        InputError: not float32 on one device, or shapes that do not fit.
    """
    widths = [len(w) for w in weights_out]
    last, rows = len(widths) - 1, HIDDEN * len(widths)
    moved = [x.shape[-1] for x in values]
    if last < 1 or [*moved[:last], sum(moved[last:])] != widths:
        raise InputError(f"refine: expected a perceptron for each feature and one for all other values, got outputs "
                         f"of {widths} numbers for values of {moved}")  # fmt: skip
    N, F = len(values[0]), sum(widths[:last])
    arrays: dict[str, tuple[Tensor, tuple[int, ...]]] = {
        f"values[{i}]": (x, (N, c)) for i, (x, c) in enumerate(zip(values, moved, strict=True))
    }
    arrays |= {"weight_in": (weight_in, (rows, F)), "bias_in": (bias_in, (rows,))}
    for i, (w, b, c) in enumerate(zip(weights_out, biases_out, widths, strict=True)):
        arrays |= {f"weights_out[{i}]": (w, (c, HIDDEN)), f"biases_out[{i}]": (b, (c,))}
    check("refine", arrays)
    out: list[Tensor] = _refine(values, weight_in, bias_in, torch.cat(weights_out), torch.cat(biases_out), widths)
    return out


@custom_op("gsbench::refine", mutates_args=())
def _refine(
    values: list[Tensor], weight_in: Tensor, bias_in: Tensor, weight_out: Tensor, bias_out: Tensor, widths: list[int]
) -> list[Tensor]:
    out = [rows_like(x) for x in values]
    native().refine(list(plain(*values)), *plain(weight_in, bias_in, weight_out, bias_out), widths, threads(), out)
    return out


@_refine.register_fake
def _(values: list[Tensor], *_: Any) -> list[Tensor]:
    return [rows_like(x) for x in values]


@custom_op("gsbench::refine_backward", mutates_args=())
def _refine_backward(
    values: list[Tensor], weight_in: Tensor, bias_in: Tensor, weight_out: Tensor, bias_out: Tensor, widths: list[int],
    g_out: list[Tensor],
) -> list[Tensor]:  # fmt: skip
    """Gradients of the features, then of the weights; that of any other value is its `g_out`."""
    weights = plain(weight_in, bias_in, weight_out, bias_out)
    features, out = [rows_like(x) for x in values[: len(widths) - 1]], [rows_like(x) for x in weights]
    native().refine_backward(list(plain(*values)), *weights, widths, threads(), list(plain(*g_out)), features, *out)
    return features + out


@_refine_backward.register_fake
def _(values: list[Tensor], *arrays: Any) -> list[Tensor]:
    return [rows_like(x) for x in (*values[: len(arrays[4]) - 1], *arrays[:4])]


def _context(ctx: Any, inputs: tuple[Any, ...], output: list[Tensor]) -> None:  # noqa: ARG001
    values, *weights, widths = inputs
    ctx.save_for_backward(*values, *weights)
    ctx.widths = widths


def _gradient(ctx: Any, g_out: list[Tensor]) -> tuple[Any, ...]:
    *values, weight_in, bias_in, weight_out, bias_out = ctx.saved_tensors
    features = len(ctx.widths) - 1
    got = _refine_backward(values, weight_in, bias_in, weight_out, bias_out, ctx.widths, g_out)
    return [*got[:features], *g_out[features:]], *got[features:], None


_refine.register_kernel("cuda")(on_cuda.refine)
_refine_backward.register_kernel("cuda")(on_cuda.refine_backward)
_refine.register_autograd(_gradient, setup_context=_context)
