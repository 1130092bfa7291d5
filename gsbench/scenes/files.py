"""Find the files of a data set, which must be inside the scene's folder, and compute a hash of all of them."""

import hashlib
from collections.abc import Mapping
from pathlib import Path

from gsbench.errors import InputError


def find_inside(
    root: Path,  # the scene's folder, resolved
    name: str,  # a path relative to `root`, as the data set writes it
    where: str,  # the file and field that hold `name`, for the message
) -> Path:
    """Return the resolved path of a file; raise InputError if it is outside of the scene's folder `root`.

    A path can leave the folder through "..", through a link, or as an absolute path.
    """
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
    """Return the SHA-256 of `data` in hexadecimal digits."""
    return hashlib.sha256(data).hexdigest()


def fingerprint(
    digests: Mapping[str, str],  # file name relative to the scene's folder -> its sha256
) -> str:
    """Return one SHA-256 for a set of files: the hash of the output of `sha256sum` for the files, sorted by name.

    Names are relative to the scene's folder, so moving the folder keeps the hash. To compute the hash of a Blender
    scene, run in its folder: ``LC_ALL=C; sha256sum $(printf '%s\\n' transforms_*.json */*.png | sort) | sha256sum``.
    """
    lines = "".join(f"{digests[name]}  {name}\n" for name in sorted(digests))
    return digest(lines.encode("utf-8", "surrogateescape"))
