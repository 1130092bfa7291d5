"""Locate the three small scenes that come with gsbench, moving-matte, pendulum and suzanne, as package data."""

from importlib import resources
from pathlib import Path


def folder() -> Path:
    """Return the folder of `moving-matte`, `pendulum` and `suzanne`, in a git checkout or in the installed package."""
    return Path(str(resources.files(__name__)))
