"""AGR's perceptrons as one torch operation: hidden layers stay in cache, and backward computes them again."""

from typing import Any

import torch
from torch import Tensor
from torch.library import custom_op

from gsbench.errors import InputError
from gsbench.kernels import native, threads
from gsbench.kernels.arrays import plain, rows_like
from gsbench.kernels.cuda import observe as on_cuda

HIDDEN = 64


def refine(
    features: Tensor,  # [N, F]
    weight_in: Tensor,  # [P * 64, F]
    bias_in: Tensor,  # [P * 64]
    weights_out: list[Tensor],  # P of [c, 64]
    biases_out: list[Tensor],  # P of [c]
) -> list[Tensor]:  # P of [N, c]
    """P perceptrons F x 64 x c with ReLU on the same features (7DGS eq. 14).

    What does not change from Gaussian to Gaussian, as gamma(t), belongs into `bias_in`.

    Raises:
        InputError: not float32 on one device, or shapes that do not fit.
    """
    widths = [len(w) for w in weights_out]
    rows, F = HIDDEN * len(widths), features.shape[-1]
    shapes = [(features, (len(features), F)), (weight_in, (rows, F)), (bias_in, (rows,))]
    shapes += [(w, (c, HIDDEN)) for w, c in zip(weights_out, widths, strict=True)]
    shapes += [(b, (c,)) for b, c in zip(biases_out, widths, strict=True)]
    for tensor, shape in shapes:
        here = tensor.device == features.device and tensor.device.type in ("cpu", "cuda")
        if tuple(tensor.shape) != shape or tensor.dtype != torch.float32 or not here:
            raise InputError(f"refine: expected {list(shape)} float32 on the CPU or a GPU, all on one, got "
                             f"{list(tensor.shape)} {tensor.dtype} on {tensor.device}")  # fmt: skip
    out = _refine(features, weight_in, bias_in, torch.cat(weights_out), torch.cat(biases_out), widths)
    return list(out.split(widths, -1))


@custom_op("gsbench::refine", mutates_args=())
def _refine(
    features: Tensor, weight_in: Tensor, bias_in: Tensor, weight_out: Tensor, bias_out: Tensor, widths: list[int]
) -> Tensor:
    out = features.new_empty(len(features), len(weight_out))
    native().refine(*plain(features, weight_in, bias_in, weight_out, bias_out), widths, threads(), out)
    return out


@_refine.register_fake
def _(features: Tensor, _in: Tensor, _bias: Tensor, weight_out: Tensor, *_: Any) -> Tensor:
    return features.new_empty(len(features), len(weight_out))


@custom_op("gsbench::refine_backward", mutates_args=())
def _refine_backward(
    features: Tensor, weight_in: Tensor, bias_in: Tensor, weight_out: Tensor, bias_out: Tensor, widths: list[int],
    g_out: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    arrays = plain(features, weight_in, bias_in, weight_out, bias_out)
    out = tuple(rows_like(x) for x in arrays)
    native().refine_backward(*arrays, widths, threads(), *plain(g_out), *out)
    return out[0], out[1], out[2], out[3], out[4]


@_refine_backward.register_fake
def _(*arrays: Any) -> tuple[Tensor, ...]:
    return tuple(rows_like(x) for x in arrays[:5])


def _context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:  # noqa: ARG001
    ctx.save_for_backward(*inputs[:5])
    ctx.widths = inputs[5]


def _gradient(ctx: Any, g_out: Tensor) -> tuple[Tensor | None, ...]:
    return *_refine_backward(*ctx.saved_tensors, ctx.widths, g_out), None


_refine.register_kernel("cuda")(on_cuda.refine)
_refine_backward.register_kernel("cuda")(on_cuda.refine_backward)
_refine.register_autograd(_gradient, setup_context=_context)
