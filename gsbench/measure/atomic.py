"""Write files atomically, so that every file which a killed run leaves behind can be read."""

import os
import re
import secrets
import socket
from pathlib import Path

HOST = re.sub(r"[^A-Za-z0-9-]", "-", socket.gethostname())


def write_atomically(path: Path, data: bytes, *, lasting: bool = True) -> None:
    """Write `data` to `path` through a temporary name in the same folder, which is then renamed.

    The folder is made where it is missing. A reader of `path` sees the old file or the new one, never a part. What is
    `lasting` is flushed to the disk before it is renamed, and survives a power cut.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{HOST}.{os.getpid()}.{secrets.token_hex(4)}.tmp")
    try:
        with temporary.open("xb") as file:
            file.write(data)
            if lasting:
                file.flush()
                os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    if not lasting:
        return
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)  # the new name itself must survive a power cut
    finally:
        os.close(folder)


def remove_leftovers(folder: Path) -> None:
    """Remove the temporary files that killed processes of this machine left in `folder`."""
    for path in folder.glob(".*.tmp"):
        found = re.fullmatch(rf"\..+\.{HOST}\.(\d+)\.[0-9a-f]{{8}}\.tmp", path.name)
        if found and not Path(f"/proc/{found[1]}").exists():
            path.unlink(missing_ok=True)
