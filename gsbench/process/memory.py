"""Check that an allocation fits into memory, because Linux may kill a process that uses too much.

The module does not import torch.
"""

import errno
import re
import sys
from pathlib import Path

from gsbench.errors import TooLargeError
from gsbench.process import control_group

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
        raise TooLargeError(f"{what} need {size / 2**30:.1f} GiB of memory, {free / 2**30:.1f} GiB are available: "
                            f"{instead}")  # fmt: skip


def too_little_address_space() -> str | None:
    """Return an error message if the address space (`ulimit -v`) is too small to load torch, otherwise None."""
    if sys.platform == "win32":  # it has no such limit
        return None
    import resource

    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit == resource.RLIM_INFINITY or limit >= LEAST_ADDRESS_SPACE:
        return None
    return (f"this process is limited to {limit >> 20} MiB of address space (ulimit -v), and torch needs "
            f"{LEAST_ADDRESS_SPACE >> 20} MiB to start: raise the limit")  # fmt: skip


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether an exception means that memory ran out; most libraries do not raise MemoryError."""
    if isinstance(error, OSError):
        return error.errno == errno.ENOMEM
    told = isinstance(error, RuntimeError | ImportError | SystemError) and WITHOUT_MEMORY.search(str(error)) is not None
    return told or isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError"  # torch's, of a GPU


def available() -> int | None:
    """Return the bytes that the system, the control group and `ulimit -v` leave to this process, None if unknown."""
    limits = [x for x in (_system(), control_group.available(), _address_space()) if x is not None]
    return min(limits, default=None)


def _system() -> int | None:
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:")), None)


def _address_space() -> int | None:
    """Return what the limit of the address space (`ulimit -v`) leaves; None if there is none."""
    if sys.platform == "win32":  # it has no such limit
        return None
    import resource

    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit == resource.RLIM_INFINITY:
        return None
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[0])
    except OSError:
        return None
    return max(0, limit - pages * resource.getpagesize())
