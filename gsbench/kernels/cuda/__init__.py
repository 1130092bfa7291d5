"""Load the CUDA kernels: the extension `_cuda`, which is not linked to torch.

The extension is optional. If it was built, it can be imported on machines without a GPU too. Torch's caching allocator
gives the memory of outputs and scratch, and kernels run on torch's current stream.
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
    """Tell whether the CUDA kernels were built and there is a GPU to run them."""
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
