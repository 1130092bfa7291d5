"""Describe a tensor that a kernel reads or returns: its shape, type and gradient."""

from dataclasses import dataclass
from enum import Enum, auto

import torch

Shape = tuple[int | str, ...]


class Gradient(Enum):
    """How a backward kernel returns the gradient of an input: by overwriting memory, by adding to it, or not at all."""

    WRITTEN = auto()  # overwrites every entry
    ADDED = auto()  # adds to every entry, so that all views of a batch share one gradient
    SUMMED = auto()  # a sum over all Gaussians: each GPU block adds its part, to memory that is zero at first
    ON_REQUEST = auto()  # as SUMMED, but computed only if the caller needs it
    NONE = auto()  # no gradient is computed; inputs may require one
    REFUSED = auto()  # there is no gradient; an input that requires one is an error


@dataclass(frozen=True)
class Input:
    """A tensor that an operation (a pair of forward and backward kernels) reads.

    Args:
        shape: dimensions such as "N 3" or "C height width D". A dimension is a number or a name; equal names in one
            operation mean equal sizes. A first dimension that may be missing starts with a question mark.
        gradient: how the backward kernel returns the gradient.
        dtypes: the accepted types: float32, or int32 for indices.
        left_out_with: makes the input optional; inputs with the same value here are left out together.
        is_list: the tensor has one dimension, whose size changes from call to call and is used for no other tensor.
    """

    shape: str
    gradient: Gradient = Gradient.WRITTEN
    dtypes: tuple[torch.dtype, ...] = (torch.float32,)
    left_out_with: str | None = None
    is_list: bool = False


@dataclass(frozen=True)
class Output:
    """A tensor that an operation returns: its shape as in `Input`, and whether it has a gradient."""

    shape: str
    gradient: bool = True


def sizes_of(shape: str) -> Shape:
    """Split a shape such as "N 3" into its dimensions; numbers become integers."""
    return tuple(int(size) if size.isdigit() else size for size in shape.split())
