"""Check that an allocation fits into memory, because Linux may kill a process that uses too much.

The module does not import torch.
"""

import errno
import os
import re
import resource
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from gsbench.errors import TooLargeError

# Messages of the library loader, torch, C++, system threads and OpenCV if memory runs out.
WITHOUT_MEMORY = re.compile(r"memory|bad_alloc|bad alloc|failed to map segment|can't start new thread", re.IGNORECASE)
SMALL = 1 << 26  # bytes; smaller requests are not checked
# Bytes of address space (`ulimit -v`) that Python, torch and OpenBLAS need to start. With less, torch or the C library
# ends the process by a signal, at a place that depends on where libraries are loaded.
LEAST_ADDRESS_SPACE = 1280 << 20


def require(size: int, what: str, instead: str) -> None:
    """Raise TooLargeError if `size` bytes are more than the memory that is available to this process.

    Args:
        size: bytes.
        what: the objects that need the memory, in the plural.
        instead: advice on what to do instead, for the error message.
    """
    if size < SMALL:
        return
    free = available()
    if free is not None and size > free:
        raise TooLargeError(
            f"{what} need {size / 2**30:.1f} GiB of memory, {free / 2**30:.1f} GiB are available: {instead}"
        )


def too_little_address_space() -> str | None:
    """Return an error message if the address space (`ulimit -v`) is too small to load torch, otherwise None."""
    limit = _address_space_limit()
    if limit is None or limit >= LEAST_ADDRESS_SPACE:
        return None
    return (
        f"this process is limited to {limit >> 20} MiB of address space (ulimit -v), and torch needs "
        f"{LEAST_ADDRESS_SPACE >> 20} MiB to start: raise the limit"
    )


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether an exception means that memory ran out; most libraries do not raise MemoryError."""
    if isinstance(error, OSError):
        return error.errno == errno.ENOMEM
    if isinstance(error, RuntimeError | ImportError | SystemError) and WITHOUT_MEMORY.search(str(error)):
        return True
    return isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError"  # torch's, of a GPU


def available() -> int | None:
    """Return the bytes that the system, the control group and `ulimit -v` leave to this process, None if unknown."""
    limits = [x for x in (_system(), left_by_control_groups(), _address_space()) if x is not None]
    return min(limits, default=None)


def _system() -> int | None:
    lines = lines_of(Path("/proc/meminfo"))
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:")), None)


def _address_space_limit() -> int | None:
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    return None if limit == resource.RLIM_INFINITY else limit


def _address_space() -> int | None:
    """Return what the limit of the address space (`ulimit -v`) leaves; None if there is none."""
    limit, used = _address_space_limit(), lines_of(Path("/proc/self/statm"))
    if limit is None or not used:
        return None
    return max(0, limit - int(used[0].split()[0]) * os.sysconf("SC_PAGE_SIZE"))  # its first number: all pages


class Files(NamedTuple):
    """Name the folder and the files in which a version of Linux's control groups has the limits of memory."""

    top: str
    limit: str
    used: str
    cache: str  # the line in memory.stat: cached files, which the system can drop at any time and which `used` counts


VERSION_1 = Files("sys/fs/cgroup/memory", "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
VERSION_2 = Files("sys/fs/cgroup", "memory.max", "memory.current", "inactive_file")


def left_by_control_groups(root: Path = Path("/")) -> int | None:
    """Return the bytes that the control groups of this process leave to it; None if no limit can be read.

    The limit of a container or of a batch job can be set on any group between the top and that of the process. In a
    container, the path of the process' group may be that of the host: of such a path, only the top is there.

    Args:
        root: the folder that has proc/ and sys/.
    """
    left = []
    for line in lines_of(root / "proc/self/cgroup"):
        number, controllers, path = (*line.split(":", 2), "", "")[:3]  # also of a damaged line
        files = VERSION_2 if number == "0" and not controllers else VERSION_1
        if files is VERSION_2 or "memory" in controllers.split(","):
            group = PurePosixPath(path.lstrip("/"))
            left += [_left(root / files.top / folder, files) for folder in (group, *group.parents)]
    return min((x for x in left if x is not None), default=None)


def _left(folder: Path, files: Files) -> int | None:
    """Return the bytes that one control group leaves; None if it has no limit."""
    try:
        left = int((folder / files.limit).read_text()) - int((folder / files.used).read_text())
        cached = [int(n) for key, n in (x.split() for x in lines_of(folder / "memory.stat")) if key == files.cache]
    except (OSError, ValueError):  # no such group, no limit ("max"), or something else than numbers
        return None
    return max(0, left + sum(cached))


def lines_of(path: Path) -> list[str]:
    """Return the lines of a file of the system, such as /proc/meminfo; none if it cannot be read."""
    try:
        return path.read_text().splitlines()
    except (OSError, ValueError):  # ValueError: not text
        return []
