"""Compute exp, log, sqrt, sin, cos and layers of networks with the same bits on every processor.

On the CPU, torch leaves these functions to MKL, whose float32 results have another last bit on processors of another
vendor. In float64 they differ too, but only behind the digits that float32 keeps. MKL's products of matrices also
depend on the number of threads.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor


def _in_float64(function: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
    """Apply a function in float64 and round the results to the type of `x`; GPUs use their own float32 functions."""

    def portable(x: Tensor) -> Tensor:
        return function(x) if x.is_cuda else function(x.double()).to(x.dtype)

    return portable


exp, log, log1p, sqrt, sin, cos = map(
    _in_float64, (torch.exp, torch.log, torch.log1p, torch.sqrt, torch.sin, torch.cos)
)


def linear(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:  # [N, C], [K, C], [K] -> [N, K]
    """Compute a layer x W^T + b of a network; on a CPU, one thread computes its products and their gradients."""
    product: Tensor = _Product.apply(x, weight.mT)
    return product + bias


class _Product(torch.autograd.Function):
    """The product of two matrices, whose gradients are products too."""

    @staticmethod
    def forward(ctx: Any, a: Tensor, b: Tensor) -> Tensor:
        ctx.save_for_backward(a, b)
        return torch.ops.gsbench.product(a, b)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        a, b = ctx.saved_tensors
        of_a, of_b = ctx.needs_input_grad
        return _Product.apply(gradient, b.mT) if of_a else None, _Product.apply(a.mT, gradient) if of_b else None


def _multiply(a: Tensor, b: Tensor) -> Tensor:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # MKL adds in another order for another number of threads
    try:
        return a @ b
    finally:
        torch.set_num_threads(threads)


# An operation of its own, because a recorded training step repeats operations, and not the Python code around them.
_library = torch.library.Library("gsbench", "FRAGMENT")
_library.define("product(Tensor a, Tensor b) -> Tensor")
_library.impl("product", _multiply, "CompositeExplicitAutograd")
