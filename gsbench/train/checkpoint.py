"""Save the state of a training to a checkpoint, atomically, and read it back as untrusted input."""

import io
import pickle
from pathlib import Path
from typing import Any

import torch

from gsbench.errors import InputError
from gsbench.measure.atomic import write_atomically

VERSION = 3
FILE_NAME = "checkpoint.pt"


def save(path: Path, config_hash: str, data_hash: str, state: dict[str, Any]) -> None:
    """Write the state of a run, with the hashes of its config and its data."""
    buffer = io.BytesIO()
    torch.save({"version": VERSION, "config": config_hash, "data": data_hash, "state": state}, buffer)
    write_atomically(path, buffer.getvalue())


def load(path: Path, config_hash: str, data_hash: str, device: str) -> dict[str, Any] | None:
    """Read the state at `path`; None where there is no file, or its config, data or version differs.

    Raises:
        InputError: the file exists and is not a checkpoint.
    """
    if not path.exists():
        return None
    found, state = read(path, device)
    return state if found == (VERSION, config_hash, data_hash) else None


def read(path: Path, device: str = "cpu") -> tuple[tuple[int, str, str], dict[str, Any]]:
    """Read (version, config hash, data hash) and the state of the checkpoint at `path`, without comparing them.

    Raises:
        InputError: the file is not a checkpoint.
    """
    try:
        content = torch.load(path, map_location=device, weights_only=True)
        state: dict[str, Any] = content["state"]
        return (content["version"], content["config"], content["data"]), state
    except (OSError, RuntimeError, KeyError, TypeError, EOFError, pickle.UnpicklingError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{path}: expected a checkpoint, got {reason}; delete it to start over") from None
