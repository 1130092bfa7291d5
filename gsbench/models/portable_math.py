"""Compute exp, log, sqrt, sin and cos with the same bits on every processor.

On the CPU, torch leaves these functions to MKL, whose float32 results have another last bit on processors of another
vendor. In float64 they differ too, but only behind the digits that float32 keeps.
"""

from collections.abc import Callable

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
