"""Compute exp, log, sqrt, sin and cos with the same bits on every processor.

On the CPU, torch leaves these functions to MKL, whose float32 results have another last bit on processors of another
vendor. In float64 they differ too, but only behind the digits that float32 keeps.
"""

from collections.abc import Callable

import torch
from torch import Tensor


def exp(x: Tensor) -> Tensor:
    """Return the exponential of each entry."""
    return _in_float64(torch.exp, x)


def log(x: Tensor) -> Tensor:
    """Return the natural logarithm of each entry."""
    return _in_float64(torch.log, x)


def log1p(x: Tensor) -> Tensor:
    """Return the natural logarithm of one plus each entry."""
    return _in_float64(torch.log1p, x)


def sqrt(x: Tensor) -> Tensor:
    """Return the square root of each entry."""
    return _in_float64(torch.sqrt, x)


def sin(x: Tensor) -> Tensor:
    """Return the sine of each entry, an angle in radians."""
    return _in_float64(torch.sin, x)


def cos(x: Tensor) -> Tensor:
    """Return the cosine of each entry, an angle in radians."""
    return _in_float64(torch.cos, x)


def _in_float64(function: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """Apply a function in float64 and round the results to the type of `x`; GPUs use their own float32 functions."""
    return function(x) if x.is_cuda else function(x.double()).to(x.dtype)
