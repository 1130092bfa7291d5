"""What every operation does with its tensors: check them at the door, and strip them for the kernels."""

import torch
from torch import Tensor

from gsbench.errors import InputError


def plain(*tensors: Tensor) -> tuple[Tensor, ...]:
    """The same values in rows, without their graph, which may not cross DLPack."""
    return tuple(t.detach().contiguous() for t in tensors)


def rows_like(tensor: Tensor) -> Tensor:
    """Memory of the same shape, row by row whatever the strides of `tensor`."""
    return tensor.new_empty(tensor.shape)


def check(operation: str, arrays: dict[str, tuple[Tensor, tuple[int, ...]]]) -> None:
    """Raise InputError unless each named tensor has its shape and is float32, all on the CPU or all on one GPU."""
    device = next(iter(arrays.values()))[0].device
    for name, (tensor, shape) in arrays.items():
        if tuple(tensor.shape) != shape:
            raise InputError(f"{operation}: expected {name} of shape {list(shape)}, got {list(tensor.shape)}")
        if tensor.dtype != torch.float32 or tensor.device != device or device.type not in ("cpu", "cuda"):
            raise InputError(f"{operation}: expected {name} as float32 on the CPU or a GPU, all on one, got "
                             f"{tensor.dtype} on {tensor.device}")  # fmt: skip


def check_constant(operation: str, name: str, tensor: Tensor) -> None:
    """Raise InputError if a gradient is asked for where there is none."""
    if tensor.requires_grad:
        raise InputError(f"{operation} has no gradient by {name}: detach it")


def number(scalar: Tensor) -> float:
    """The value of a scalar on the CPU, 0 of an empty tensor. Kernels on a GPU read it there instead."""
    return float(scalar.item()) if scalar.numel() else 0.0
