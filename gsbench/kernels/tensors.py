"""Check tensors and numbers that are passed to public functions."""

import math

import torch
from torch import Tensor

from gsbench.errors import InputError

FLOATS = (torch.float32, torch.float64)
LARGEST = 1e300


def check_tensor(x: object, name: str, dtypes: tuple[torch.dtype, ...] = FLOATS) -> None:
    """Raise InputError unless `x` is a dense tensor with one of the given dtypes; the message contains `name`."""
    if not isinstance(x, Tensor):
        raise InputError(f"{name}: expected a tensor, got {type(x).__name__}")
    if x.layout != torch.strided or x.is_quantized:
        kind = "quantized" if x.is_quantized else _brief(x.layout)
        raise InputError(f"{name}: expected a dense tensor, got a {kind} one: convert it to a dense one")
    if x.is_meta:
        raise InputError(f"{name}: expected a tensor with values, got one on the meta device: create it elsewhere")
    if x.dtype not in dtypes:
        expected = " or ".join(map(_brief, dtypes))
        raise InputError(f"{name}: expected {expected}, got {_brief(x.dtype)}: convert it by .to({dtypes[0]})")


def check_number(x: object, name: str, low: float = -LARGEST, high: float = LARGEST) -> None:
    """Raise InputError unless `x` is a finite number from `low` to `high`; the message contains `name`."""
    if isinstance(x, bool) or not isinstance(x, int | float) or not low <= x <= high:
        raise InputError(f"{name}: expected a number in [{low:g}, {high:g}], got {x!r:.80}")


def check_whole(x: object, name: str, low: int, high: int) -> None:
    """Raise InputError unless `x` is a whole number from `low` to `high`; the message contains `name`."""
    if isinstance(x, bool) or not isinstance(x, int) or not low <= x <= high:
        raise InputError(f"{name}: expected {low}, {low + 1}, .., {high}, got {x!r:.80}")


def check_positive(x: object, name: str) -> None:
    """Raise InputError unless `x` is a positive finite number; the message contains `name`."""
    if not isinstance(x, int | float) or not 0 < x < math.inf:
        raise InputError(f"{name}: expected a positive number, got {x}")


def _brief(kind: object) -> str:
    """Return the name of a dtype or layout without the prefix "torch."."""
    return str(kind).removeprefix("torch.")
