"""Read files that may be damaged or malicious: the size of files is limited, and JSON must not have duplicate keys.

This module does not import torch.
"""

import json
import stat
from pathlib import Path
from typing import Any

from gsbench.errors import InputError
from gsbench.process.memory import require

MAX_JSON = 1 << 26  # bytes; the largest record and the largest transforms_train.json known have less than a million


def read_file(
    path: Path,
    where: str,  # the path, and the file and field that name it, for the message
    most: int,  # bytes
) -> bytes:
    """Return the content of a regular file of at most `most` bytes.

    Pipes and devices are not read, because that may never end.

    Raises:
        InputError: the file is missing, is not a regular file, is too large, or cannot be read.
    """
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise InputError(f"{where}: expected a file, found {_kind(status.st_mode)}: put the file there")
        if status.st_size > most:
            raise InputError(f"{where}: expected at most {most} bytes, found {status.st_size}: is it the right file?")
        require(status.st_size, f"{where}: its bytes", "use a smaller file")
        with path.open("rb") as file:
            return file.read(status.st_size)
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"{where}: expected a file, found none: is the data complete?") from None
    except (OSError, ValueError) as error:  # ValueError: a NUL byte in the path
        raise InputError(f"{where}: cannot be read: {getattr(error, 'strerror', error)}") from None


def parse_json(
    data: bytes,
    where: str,  # the path, for the message
) -> Any:
    """Parse JSON, and raise InputError if it is invalid or if an object has the same key twice."""
    try:
        return json.loads(data, object_pairs_hook=_unique)
    except (ValueError, RecursionError) as error:  # also bad UTF-8 and integers of thousands of digits
        raise InputError(f"{where}: expected JSON: {error}") from None


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Convert the (key, value) pairs of a JSON object to a dictionary; raise ValueError if a key occurs twice."""
    unique: dict[str, Any] = {}
    for key, value in pairs:
        if key in unique:
            raise ValueError(f"the key {ascii(key)[:80]} appears twice in one object")
        unique[key] = value
    return unique


def _kind(mode: int) -> str:
    """Return the name of a file type that is not a regular file: a folder, a pipe, a socket or a device."""
    kinds = {stat.S_IFDIR: "a folder", stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket"}
    return kinds.get(stat.S_IFMT(mode), "a device")
