"""Write files atomically, so that a killed run leaves no half-written file."""

import errno
import os
import re
import secrets
import socket
from collections.abc import Callable
from contextlib import suppress
from io import BufferedRandom
from pathlib import Path

from gsbench.errors import InputError

WITHOUT_LINKS = (errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK)  # errors if hard links are not supported
HOST = re.sub(r"[^A-Za-z0-9-]", "-", socket.gethostname())


def write_atomically(path: Path, data: bytes | Callable[[BufferedRandom], object], *, lasting: bool = True) -> None:
    """Write `data` to a temporary file in the folder of `path`, then rename the file to `path`.

    `data` may be a function that writes (and may read) the file that it gets, for content too large to be in memory. If
    the folder does not exist, it is created. Readers of `path` see either the old file or the new file. If `lasting`
    is true, the file is flushed to the disk before it is renamed, so that it survives a power cut.

    Raises:
        InputError: `path` is a device, such as /dev/full.
        OSError: the disk takes no file; the error names `path`.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise InputError(f"{path}: expected the name of a file, got that of a device, which a file would replace")
    temporary = _beside(path)
    try:
        with temporary.open("x+b") as file:
            data(file) if callable(data) else file.write(data)
            if lasting:
                file.flush()
                os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException as error:
        _remove(temporary)
        if isinstance(error, OSError):
            name_file(error, path)
        raise
    if not lasting:
        return
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)  # the folder entry must survive a power cut too
    finally:
        os.close(folder)


def create_atomically(path: Path, data: bytes) -> bool:
    """Create the file `path` with the content `data`; return False if the file already exists.

    The folder must exist. If several processes (on one or more hosts) create the same file, only one of them succeeds,
    because a hard link to an existing name fails.
    """
    temporary = _beside(path)
    try:
        temporary.write_bytes(data)
        try:
            os.link(temporary, path)
        except FileExistsError:
            # True if the other name is `path`: NFS may have made the link although its reply was lost.
            return temporary.stat().st_nlink == 2
        except OSError as error:
            if error.errno not in WITHOUT_LINKS:
                raise
            return _create_here(path, data)
        return True
    except OSError as error:
        name_file(error, path)
        raise
    finally:
        _remove(temporary)


def _remove(temporary: Path) -> None:
    """Remove a temporary file; a disk that refuses this, such as a read-only one, must not hide why writing failed."""
    with suppress(OSError):
        temporary.unlink()


def name_file(error: OSError, path: Path) -> None:
    """Name a file in an error: that of a full disk has no name, and a user does not know the temporary file."""
    if error.errno:  # not of Python's own, such as UnsupportedOperation
        error.filename = str(path)
        del error.filename2  # None would be printed


def _create_here(path: Path, data: bytes) -> bool:
    """Create a file on a file system without hard links, such as FAT; a reader may see a half-written file."""
    try:
        with path.open("xb") as file:
            file.write(data)
    except FileExistsError:
        return False
    return True


def _beside(path: Path) -> Path:
    return path.with_name(f".{path.name}.{HOST}.{os.getpid()}.{secrets.token_hex(4)}.tmp")


def remove_leftovers(folder: Path) -> None:
    """Remove the temporary files that killed processes on this host left in `folder`."""
    for path in folder.glob(".*.tmp"):
        match = re.fullmatch(rf"\..+\.{HOST}\.(\d+)\.[0-9a-f]{{8}}\.tmp", path.name)
        if match and not Path(f"/proc/{match[1]}").exists():
            path.unlink(missing_ok=True)
