"""Compute exp, log, sqrt, sigmoid and other functions, and layers of networks, with the same bits on every processor.

On the CPU, torch leaves these functions to MKL, whose float32 results have another last bit on processors of another
vendor. In float64 they differ too, but only behind the digits that float32 keeps. MKL's products of matrices also
depend on the number of threads, and its code that is the same for all vendors takes five times as long as the kernel.
"""

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from gsbench.kernels.backends import CPU
from gsbench.kernels.fields import linear as kernel


def _in_float64(function: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
    """Apply a function in float64 and round the results to the type of `x`; GPUs use their own float32 functions."""

    def portable(x: Tensor) -> Tensor:
        return function(x) if x.is_cuda else function(x.double()).to(x.dtype)

    return portable


exp, expm1, log, log1p, sqrt, sigmoid, logit, sin, cos, acos = map(
    _in_float64,
    (
        *(torch.exp, torch.expm1, torch.log, torch.log1p, torch.sqrt, torch.sigmoid, torch.logit),
        *(torch.sin, torch.cos, torch.acos),
    ),
)


def linear(
    x: Tensor,  # [N, C]
    weight: Tensor,  # [K, C]
    bias: Tensor,  # [K]
    *,
    relu: bool = False,
) -> Tensor:  # [N, K]
    """Compute a layer x W^T + b of a network, or max(0, x W^T + b); in float32 on a CPU, by a kernel of gsbench."""
    if CPU.serves(x):
        return kernel(x, weight, bias, relu)[0]
    y = F.linear(x, weight, bias)
    return torch.relu(y) if relu else y
