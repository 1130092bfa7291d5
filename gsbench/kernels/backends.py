"""Choose the backend: torch alone ("reference"), the CPU kernels ("cpu") or the CUDA kernels ("cuda")."""

import functools
import warnings
from dataclasses import dataclass

import torch
from torch import Tensor

from gsbench import kernels
from gsbench.errors import InputError, check_known
from gsbench.kernels import cuda
from gsbench.kernels.library import library_of


@dataclass(frozen=True)
class Backend:
    """A backend, which decides by device and type whether a tensor is processed by compiled kernels or by torch."""

    name: str
    devices: tuple[str, ...]  # the device types on which this backend uses kernels

    def serves(self, tensor: Tensor) -> bool:
        """Return whether kernels process this tensor; otherwise torch does."""
        device = tensor.device.type
        return tensor.dtype == torch.float32 and device in self.devices and _built(device)

    def takes_views(self, tensor: Tensor) -> bool:
        """Return whether kernels process this tensor, and compute several views in one call."""
        return self.serves(tensor) and library_of(tensor.device.type).takes_views

    def workers(self, tensor: Tensor) -> int:
        """Return how many Python threads should share independent work on tensors of this device.

        Only the CPU kernels run faster with several Python threads: torch holds the GIL between its operations, and a
        GPU runs one kernel after the other.
        """
        return torch.get_num_threads() if tensor.device.type == "cpu" and self.serves(tensor) else 1


REFERENCE = Backend("reference", ())
CPU = Backend("cpu", ("cpu",))
CUDA = Backend("cuda", ("cuda",))
AUTO = Backend("auto", ("cpu", "cuda"))  # uses the kernels of whichever device a tensor is on
BACKENDS = {backend.name: backend for backend in (AUTO, REFERENCE, CPU, CUDA)}


def resolve(name: str, device: str = "cpu") -> Backend:
    """Return the backend with this name for a device type; "auto" becomes the fastest installed one.

    Raises InputError if the backend does not exist, is not installed, or does not work on the device.
    """
    check_known("raster backend", name, BACKENDS)
    if name == "auto":
        _warn(device)
        return BACKENDS[device] if device in AUTO.devices and _built(device) else REFERENCE
    if name == "cpu" and not kernels.available():
        raise InputError(
            "raster backend 'cpu' is not built in this installation: reinstall with a C++20 compiler, "
            "or use raster.backend=reference",
            docs="install.md#without-a-compiler",
        )
    if name == "cuda" and not cuda.available():
        why = "no CUDA device was found" if cuda.built() else "it is not built here"
        raise InputError(f"raster backend 'cuda': {why}; use raster.backend=auto or reference", docs="gpu.md#building")
    if name in AUTO.devices and device in AUTO.devices and name != device:  # torch renders on any other device
        raise InputError(
            f"raster backend '{name}' does not render on device '{device}': use device={name}, "
            "or raster.backend=auto or reference"
        )
    return BACKENDS[name]


def _built(device: str) -> bool:
    return kernels.available() if device == "cpu" else cuda.available()


def _warn(device: str) -> None:
    """Warn if the backend "auto" falls back to a slower backend."""
    if cuda.built() and not cuda.available():
        _warn_once("no CUDA device was found: the CUDA kernels of this installation are idle, the CPU renders")
    if device == "cpu" and not kernels.available():
        _warn_once(
            "the native kernels are not built in this installation: the CPU renders by the reference backend, "
            "which is slow; reinstall with a C++20 compiler, see docs/install.md"
        )
    if device == "cuda" and not cuda.built():
        _warn_once(
            "the CUDA kernels are not built in this installation: the GPU renders by the reference backend, "
            "which is slow; see docs/gpu.md"
        )


@functools.cache
def _warn_once(why: str) -> None:
    """Print a warning, but only once per process."""
    warnings.warn(f"raster backend 'auto': {why}", stacklevel=4)
