"""The CUDA kernels: the extension `_cuda`, linked to no torch, and how tensors reach it.

The extension is optional, and where it was built it imports on machines without a GPU too. Outputs and scratch are
torch's, so that its caching allocator serves them, and kernels run on torch's current stream.
"""

import importlib
import importlib.util
from types import ModuleType

import torch
from torch import Tensor

from gsbench.errors import InputError

_cuda: ModuleType | None = None
if importlib.util.find_spec("gsbench.kernels._cuda") is not None:  # an extension that is there but broken raises
    _cuda = importlib.import_module("gsbench.kernels._cuda")


def available() -> bool:
    """Whether the CUDA kernels are part of this installation and there is a device to run them."""
    return _cuda is not None and torch.cuda.is_available()


def cuda() -> ModuleType:
    """The compiled extension.

    Raises:
        InputError: it was not built.
    """
    if _cuda is None:
        raise InputError("the CUDA kernels are not built in this installation: reinstall where nvcc is on the PATH "
                         "(pip install . -C cmake.define.CUDA=on)")  # fmt: skip
    return _cuda


def stream(tensor: Tensor) -> int:
    """Address of the stream that work on this tensor's device goes to."""
    # A CPU tensor has none: tests run the kernels on the CPU.
    return torch.cuda.current_stream(tensor.device).cuda_stream if tensor.is_cuda else 0


def plain(*tensors: Tensor) -> tuple[Tensor, ...]:
    """The same values in rows, without their graph."""
    return tuple(t.detach().contiguous() for t in tensors)


def pointers(*tensors: Tensor | None) -> tuple[int, ...]:
    """Addresses of tensors in rows; 0 for None. The tensors must live until the call they are passed to returns."""
    return tuple(0 if t is None else t.data_ptr() for t in tensors)
