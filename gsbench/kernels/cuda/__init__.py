"""Load the CUDA kernels from the compiled extension `_cuda`, which does not link to torch.

The extension is optional, and it can be imported on machines without a GPU. Torch allocates the memory of outputs and
scratch, and kernels run on torch's current stream.
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
    """Return whether the CUDA kernels are installed."""
    return _cuda is not None


def available() -> bool:
    """Return whether the CUDA kernels are installed and a GPU is available."""
    return built() and _has_device()


@functools.cache
def _has_device() -> bool:
    return torch.cuda.is_available()


def cuda() -> ModuleType:
    """Return the compiled extension with the CUDA kernels; raises InputError if it is not built."""
    if _cuda is None:
        raise InputError(
            "the CUDA kernels are not built in this installation: reinstall where nvcc is on the PATH "
            "(pip install . -C cmake.define.CUDA=on)"
        )
    return _cuda
