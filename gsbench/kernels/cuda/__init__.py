"""The CUDA kernels: the extension `_cuda`, linked to no torch, and how tensors reach it.

The extension is optional, and where it was built it imports on machines without a GPU too. Outputs and scratch are
torch's, so that its caching allocator serves them, and kernels run on torch's current stream.
"""

import functools
import importlib
import importlib.util
import math
from collections.abc import Callable
from types import ModuleType
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor

from gsbench.errors import InputError

P = ParamSpec("P")
R = TypeVar("R")

_cuda: ModuleType | None = None
if importlib.util.find_spec("gsbench.kernels._cuda") is not None:  # an extension that is there but broken raises
    _cuda = importlib.import_module("gsbench.kernels._cuda")


def built() -> bool:
    """Whether the CUDA kernels are part of this installation."""
    return _cuda is not None


def available() -> bool:
    """Whether they are, and there is a device to run them."""
    return built() and _has_device()


@functools.cache
def _has_device() -> bool:
    return torch.cuda.is_available()


def cuda() -> ModuleType:
    """The compiled extension.

    Raises:
        InputError: it was not built.
    """
    if _cuda is None:
        raise InputError("the CUDA kernels are not built in this installation: reinstall where nvcc is on the PATH "
                         "(pip install . -C cmake.define.CUDA=on)")  # fmt: skip
    return _cuda


def on_device(function: Callable[P, R]) -> Callable[P, R]:
    """Make the device of a function's first tensor the current one while it runs: kernels start there."""

    @functools.wraps(function)
    def run(*args: P.args, **kwargs: P.kwargs) -> R:
        first: Any = args[0][0] if isinstance(args[0], list) else args[0]
        with torch.cuda.device_of(first):
            return function(*args, **kwargs)

    return run


def stream(tensor: Tensor) -> int:
    """Address of the stream that work on this tensor's device goes to."""
    # A CPU tensor has none: tests run the kernels on the CPU.
    return torch.cuda.current_stream(tensor.device).cuda_stream if tensor.is_cuda else 0


def pointers(*tensors: Tensor | None) -> tuple[int, ...]:
    """Addresses of tensors in rows; 0 for None. The tensors must live until the call they are passed to returns."""
    return tuple(0 if t is None else t.data_ptr() for t in tensors)


def allocate(what: str, like: Tensor, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
    """An uninitialised tensor on the device of another, for `what`.

    Raises:
        torch.OutOfMemoryError: in one line, with what it was for, its size and what to lower.
    """
    try:
        return torch.empty(shape, dtype=dtype, device=like.device)
    except torch.OutOfMemoryError as error:
        size = math.prod(shape) * dtype.itemsize
        reason = " ".join(str(error).split())
        raise torch.OutOfMemoryError(
            f"{what} need {size / 2**20:.1f} MiB on {like.device}: lower the picture's size, the cameras drawn at once "
            f"or the number of Gaussians ({reason:.160})"
        ) from None
