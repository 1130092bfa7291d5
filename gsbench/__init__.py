"""Measure what a dimension of a Gaussian is worth, with one rasterizer, one trainer and one protocol for all models."""

import importlib
import os
from typing import Any

# Idle OpenMP threads sleep instead of spinning. Spinning threads of torch take the cores from those of the kernels, and
# both take them from other programs. An OpenMP runtime reads this variable once, when torch or the kernels load it.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

__version__ = "0.1.0"

_PUBLIC = {"load_run": "gsbench.run.load"}  # public names and the modules that define them


def __getattr__(name: str) -> Any:
    """Import public names when they are first asked for, so that `import gsbench` alone stays quick."""
    if name in _PUBLIC:
        return getattr(importlib.import_module(_PUBLIC[name]), name)
    raise AttributeError(f"module 'gsbench' has no attribute '{name}'")
