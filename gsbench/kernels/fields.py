"""Describe one tensor that an operation takes or returns: its shape, its type and its gradient."""

from dataclasses import dataclass
from enum import Enum, auto

import torch

Shape = tuple[int | str, ...]


class Gradient(Enum):
    """What the backward kernel does with the gradient of an input."""

    WRITTEN = auto()  # writes every entry
    ADDED = auto()  # adds to every entry, so that the views of a batch share one memory
    SUMMED = auto()  # adds a part of a sum over Gaussians from each block of a GPU, to memory that starts at zero
    ON_REQUEST = auto()  # as SUMMED, and only where the caller wants it, since it costs something
    NONE = auto()  # leaves it out, in silence
    REFUSED = auto()  # there is none; asking for it is an error


@dataclass(frozen=True)
class Input:
    """A tensor that an operation takes.

    Args:
        shape: sizes such as "N 3" or "C height width D". A size is a number, or a name that means one size wherever it
            stands in the operation. A first size that may be left out has a question mark.
        gradient: what the backward kernel does with the input's gradient.
        dtype: the type, float32 or, for indices, int32.
        left_out_with: makes the input optional; inputs with the same name are left out together.
        is_list: the tensor is [n]; n differs from call to call and is no other size.
    """

    shape: str
    gradient: Gradient = Gradient.WRITTEN
    dtype: torch.dtype = torch.float32
    left_out_with: str | None = None
    is_list: bool = False


@dataclass(frozen=True)
class Output:
    """A tensor that an operation returns: its shape, as in `Input`, and whether a gradient goes through it."""

    shape: str
    gradient: bool = True


def sizes_of(shape: str) -> Shape:
    """Split a shape into its sizes; numbers become ints."""
    return tuple(int(size) if size.isdigit() else size for size in shape.split())
