"""Call compiled kernels on the CPU or on a GPU, with arguments given by name."""

import math
from functools import partial
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from gsbench import kernels
from gsbench.errors import InputError
from gsbench.kernels import cuda, recording
from gsbench.kernels.headers import argument_structures

# The prefix of a kernel argument's name, by the role of its C++ structure (kernels/arguments.h).
_PREFIX = {"INPUTS": "", "OUTPUTS": "out.", "GIVEN": "given.", "GRADS": "grad."}

Slots = dict[str, Any]  # kernel arguments by name: a number, an address as an int, or a tuple of these


class Library:
    """The compiled kernels for tensors on the CPU."""

    needs_scratch = False  # whether torch must provide scratch memory; the kernels of the CPU allocate their own
    # Whether one call of AGR, slices and colours computes several views; on a CPU, the data of one view stay in caches.
    takes_views = False

    def __init__(self, extension: ModuleType) -> None:
        """Store the compiled extension and read the argument names of its kernels.

        Raises:
            InputError: a kernel has other arguments than its source; it would ignore what it does not know.
        """
        declared = argument_structures()
        for name, signature in extension.SIGNATURES.items():
            if not declared.issuperset(signature):
                raise InputError(
                    f"the compiled kernel {name} is not of this source: run `make setup` to build it again"
                )
        self.extension = extension
        self._fields = {name: _fields(signature) for name, signature in extension.SIGNATURES.items()}

    def call(self, name: str, slots: Slots, like: Tensor) -> None:
        """Run a kernel on the device of `like`; raises InputError if it does not support these sizes or options."""
        slots["threads"] = torch.get_num_threads()
        run = partial(self._run, like.device, name, *[slots[field] for field in self._fields[name]])
        run()
        active = recording.current()
        if active is not None:
            active.add(run)

    def _run(self, device: torch.device, name: str, *values: Any) -> None:
        """Call the function of the extension; the ValueError that it may raise becomes an InputError."""
        try:
            getattr(self.extension, name)(*values)
        except ValueError as error:
            raise InputError(str(error)) from None

    def zero(self, tensors: list[Tensor]) -> None:
        """Set contiguous float32 tensors to zero; torch would first read those that do not fit into a cache."""
        sizes, addresses = zip(*[(x.numel(), x.data_ptr()) for x in tensors], strict=True)
        self.call("zero_arrays", {"count": len(tensors), "numbers": sizes, "arrays": addresses}, tensors[0])

    def has(self, name: str) -> bool:
        """Return whether there is a kernel with this name; some exist only on a GPU."""
        return name in self._fields

    def takes(self, name: str, field: str) -> bool:
        """Return whether a kernel has an argument with this name."""
        return field in self._fields[name]

    def similarity_parts(self, height: int, width: int) -> int:
        """Return the number of partial sums that the kernel of `l1_ssim` writes: 1 on the CPU."""
        return 1


class CudaLibrary(Library):
    """The compiled kernels for tensors on a GPU; they are enqueued on torch's current stream."""

    needs_scratch = True  # by torch's caching allocator
    takes_views = True

    def _run(self, device: torch.device, name: str, *values: Any) -> None:
        if device.type != "cuda":  # tests run these kernels on the CPU
            super()._run(device, name, *values, 0)
            return
        with torch.cuda.device(device):
            super()._run(device, name, *values, torch.cuda.current_stream(device).cuda_stream)

    def zero(self, tensors: list[Tensor]) -> None:
        """Set tensors to zero, in one launch."""
        torch._foreach_zero_(tensors)

    def similarity_parts(self, height: int, width: int) -> int:
        """Return the number of partial sums that the kernel of `l1_ssim` writes: one per thread block."""
        return int(self.extension.similarity_parts(height, width))


_LIBRARIES: dict[str, Library] = {}  # by device type, filled on first use


def library_of(device: str) -> Library:
    """Return the compiled kernels for a device type, "cpu" or "cuda"; raises InputError if there are none."""
    if device not in _LIBRARIES:
        if device not in ("cpu", "cuda"):
            raise InputError(f"expected tensors on the CPU or a CUDA device, got them on '{device}'")
        _LIBRARIES[device] = Library(kernels.native()) if device == "cpu" else CudaLibrary(cuda.cuda())
    return _LIBRARIES[device]


def allocate(what: str, like: Tensor, shape: tuple[int, ...], dtype: torch.dtype = torch.float32) -> Tensor:
    """Allocate an uninitialised tensor on the device of `like`.

    Raises:
        torch.OutOfMemoryError: the memory is not sufficient; the message says what needs the memory (`what`) and what
            to reduce.
    """
    try:
        return like.new_empty(shape, dtype=dtype)
    except torch.OutOfMemoryError as error:
        size = dtype.itemsize * math.prod(shape)  # bytes
        reason = " ".join(str(error).split())
        raise torch.OutOfMemoryError(
            f"{what} need {size / 2**20:.1f} MiB on {like.device}: lower the image's size, the cameras drawn at once "
            f"or the number of Gaussians ({reason:.160})"
        ) from None


def _fields(signature: tuple[tuple[str, str], ...]) -> list[str]:
    return [_PREFIX[role] + name for role, names in signature for name in names.replace(",", " ").split()]
