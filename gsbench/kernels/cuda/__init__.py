"""The CUDA kernels: the extension `_cuda`, linked to no torch, and how tensors reach it.

The extension is optional, and where it was built it imports on machines without a GPU too. Outputs and scratch are
torch's, so that its caching allocator serves them, and kernels run on torch's current stream.
"""

import functools
import importlib
import importlib.util
from types import ModuleType

import torch

from gsbench.errors import InputError

_cuda: ModuleType | None = None
if importlib.util.find_spec("gsbench.kernels._cuda") is not None:  # an extension that is there but broken raises
    _cuda = importlib.import_module("gsbench.kernels._cuda")


def built() -> bool:
    """Tell whether the CUDA kernels are part of this installation."""
    return _cuda is not None


def available() -> bool:
    """Tell whether they are, and there is a device to run them."""
    return built() and _has_device()


@functools.cache
def _has_device() -> bool:
    return torch.cuda.is_available()


def cuda() -> ModuleType:
    """Return the compiled extension.

    Raises:
        InputError: it was not built.
    """
    if _cuda is None:
        raise InputError("the CUDA kernels are not built in this installation: reinstall where nvcc is on the PATH "
                         "(pip install . -C cmake.define.CUDA=on)")  # fmt: skip
    return _cuda
