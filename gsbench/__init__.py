"""Measure what a dimension of a Gaussian is worth, with one rasterizer, one trainer and one protocol for all models."""

import importlib
from typing import Any

from gsbench.openmp import sleep_when_idle

sleep_when_idle()  # before anything of gsbench imports torch or the kernels

__version__ = "0.2.0"  # the only place: pyproject.toml reads it here, and a test holds CITATION.cff to it

_PUBLIC = {"load_run": "gsbench.run.load"}  # public names and the modules that define them


def __getattr__(name: str) -> Any:
    """Import public names when they are first asked for, so that `import gsbench` alone stays quick."""
    if name in _PUBLIC:
        return getattr(importlib.import_module(_PUBLIC[name]), name)
    raise AttributeError(f"module 'gsbench' has no attribute '{name}'")
