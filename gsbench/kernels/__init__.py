"""Compute slices, images and losses by compiled kernels, and offer them as operations on tensors.

The extension `_native` is optional. If it was not built, this package can still be imported, `available()` is False and
every operation raises `InputError`. The reference backend then does the same work in torch.
"""

import importlib
import importlib.util
import os
from types import ModuleType

from gsbench.errors import InputError, did_you_mean

_native: ModuleType | None = None
if importlib.util.find_spec("gsbench.kernels._native") is not None:  # an extension that is there but broken raises
    _native = importlib.import_module("gsbench.kernels._native")


def available() -> bool:
    """Tell whether the compiled kernels are part of this installation."""
    return _native is not None


def native() -> ModuleType:
    """Return the compiled extension.

    Raises:
        InputError: it was not built.
    """
    if _native is None:
        raise InputError("the native kernels are not built in this installation: reinstall with a C++20 compiler, "
                         "or go on with raster.backend=reference")  # fmt: skip
    return _native


def instruction_set() -> str | None:
    """Return the instruction set that the CPU's kernels run with, such as `v3`; None if they are not built."""
    return None if _native is None else str(_native.active())


def use_instruction_set(name: str) -> None:
    """Run the kernels built for one instruction set (`v2`, `v3`, `v4`: x86-64 levels); the best one is the default.

    The environment variable GSBENCH_ISA does the same from outside.

    Raises:
        InputError: it is not built, or this machine does not run it.
    """
    known = native().instruction_sets()
    if name not in known:
        raise InputError(f"instruction set '{name}' is not built or does not run here. {did_you_mean(name, known)}")
    native().use(name)


if _native is not None and os.environ.get("GSBENCH_ISA"):
    use_instruction_set(os.environ["GSBENCH_ISA"])
