"""Find the files of a data set inside the scene's folder only, and compute their fingerprint."""

import hashlib
from collections.abc import Mapping
from pathlib import Path

from gsbench.errors import InputError


def find_inside(
    root: Path,  # the scene's folder, resolved
    name: str,  # a path relative to `root`, as the data set writes it
    where: str,  # the file and field that hold `name`, for the message
) -> Path:
    """Return the resolved path of `name`; refuse one that leaves `root` by "..", as an absolute path or by a link."""
    if not name.isprintable():  # a NUL byte, a lone surrogate, a line break that would break the message
        raise InputError(f"{where}: expected a path inside {root}, got {name!r}, which is not printable: rename it")
    try:
        path = (root / name).resolve()
    except (OSError, RuntimeError) as error:
        raise InputError(f"{where}: expected a path inside {root}, got {name!r}, which is a loop of links") from error
    if not path.is_relative_to(root):
        raise InputError(
            f"{where}: expected a path inside {root}, got {name!r}, which leaves it: move the file into the folder"
        )
    return path


def digest(data: bytes) -> str:
    """Return the sha256 of `data` in hexadecimal."""
    return hashlib.sha256(data).hexdigest()


def fingerprint(
    digests: Mapping[str, str],  # file name relative to the scene's folder -> its sha256
) -> str:
    """Return one sha256 for a set of files: that of the lines `sha256sum` prints for them, sorted by name.

    Names are relative, so the same data has the same fingerprint in any folder. To check it inside the folder of a
    scene: ``LC_ALL=C; sha256sum $(printf '%s\\n' transforms_*.json */*.png | sort) | sha256sum``.
    """
    lines = "".join(f"{digests[name]}  {name}\n" for name in sorted(digests))
    return digest(lines.encode("utf-8", "surrogateescape"))
