"""Locate the embedded scenes, which are package data in the layout of `gsbench.scenes.blender`."""

from importlib import resources
from pathlib import Path


def folder() -> Path:
    """Return the folder that holds `moving-matte` and `suzanne`, in a checkout as in an installed wheel."""
    return Path(str(resources.files(__name__)))
