"""Provide compiled kernels for conditional Gaussians, rasterization and losses, as differentiable functions.

The compiled extension `_native` is optional. Without it this package can be imported, but its operations raise
InputError; the backend "reference" (plain PyTorch) computes the same.
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
    """Return whether the compiled CPU kernels are installed."""
    return _native is not None


def native() -> ModuleType:
    """Return the compiled extension with the CPU kernels; raises InputError if it is not built."""
    if _native is None:
        raise InputError(
            "the native kernels are not built in this installation: reinstall with a C++20 compiler, "
            "or go on with raster.backend=reference",
            docs="install.md#without-a-compiler",
        )
    return _native


def instruction_set() -> str | None:
    """Return the instruction set of the CPU kernels, such as `v3` (an x86-64 level), or None if they are not built."""
    return None if _native is None else str(_native.active())


def use_instruction_set(name: str) -> None:
    """Select the instruction set of the CPU kernels, as the environment variable GSBENCH_ISA does: `v2`, `v3` or `v4`.

    The default is the best one that the processor supports. Raises InputError for one that is not built or supported.
    """
    known = native().instruction_sets()
    if name not in known:
        raise InputError(f"instruction set '{name}' is not built or does not run here. {did_you_mean(name, known)}")
    native().use(name)


if _native is not None and os.environ.get("GSBENCH_ISA"):
    use_instruction_set(os.environ["GSBENCH_ISA"])
