"""Ask whether a request fits into memory before it is made: the system kills a process that takes too much in silence.

Needs no torch.
"""

import errno
import re
from pathlib import Path

from gsbench.errors import TooLargeError

# What the loader of libraries, torch, C++, the system's threads and OpenCV say where there is no memory.
WITHOUT_MEMORY = re.compile(r"memory|bad_alloc|bad alloc|failed to map segment|can't start new thread", re.IGNORECASE)
SMALL = 1 << 26  # bytes not worth asking the system about


def require(size: int, what: str, instead: str) -> None:
    """Raise TooLargeError if `size` bytes are more than this process can still get.

    Args:
        size: bytes.
        what: needs them, in the plural.
        instead: what to do, for the message.
    """
    if size < SMALL:
        return
    free = available()
    if free is not None and size > free:
        raise TooLargeError(f"{what} need {size / 2**30:.1f} GiB of memory, {free / 2**30:.1f} GiB are available: "
                            f"{instead}")  # fmt: skip


def is_out_of_memory(error: BaseException) -> bool:
    """Tell whether an error says that there is no memory: few of the libraries below raise a MemoryError."""
    if isinstance(error, OSError):
        return error.errno == errno.ENOMEM
    told = isinstance(error, RuntimeError | ImportError | SystemError) and WITHOUT_MEMORY.search(str(error)) is not None
    return told or isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError"  # torch's, of a GPU


def available() -> int | None:
    """Bytes this process can still get, by the system and by its control group; None where neither says."""
    limits = [x for x in (_system(), _control_group()) if x is not None]
    return min(limits, default=None)


def _system() -> int | None:
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:")), None)


def _control_group() -> int | None:
    folder = Path("/sys/fs/cgroup")
    try:
        left = int((folder / "memory.max").read_text()) - int((folder / "memory.current").read_text())
        lines = (folder / "memory.stat").read_text().splitlines()
    except (OSError, ValueError):  # no control group, or no limit ("max")
        return None
    # `current` counts files that were read and can be dropped again at any time.
    return left + next((int(line.split()[1]) for line in lines if line.startswith("inactive_file ")), 0)
