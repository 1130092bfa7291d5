"""Keep freed memory in the process: memory returned to the system must be mapped again, page by page, in each step."""

import ctypes
import os
import sys

KEPT = 1 << 30  # bytes of a block, and of the free end of the heap
# Options of glibc's malloc (mallopt(3)) by the environment variable that overrides each.
OPTIONS = {
    "MALLOC_TRIM_THRESHOLD_": (-1, KEPT),  # M_TRIM_THRESHOLD
    "MALLOC_MMAP_THRESHOLD_": (-3, KEPT),  # M_MMAP_THRESHOLD
    "MALLOC_ARENA_MAX": (-8, 1),  # M_ARENA_MAX
}


def keep_freed_memory() -> None:
    """Keep large blocks when they are freed, on all threads. Call it before threads start: each keeps its heap.

    A step frees some hundred megabytes of gradients and allocates them again, which took a quarter of a step of 4DGS at
    150,000 Gaussians. The heap ("arena") of any thread but the first returns blocks beyond 64 MB to the system whatever
    the thresholds are. So all workers share the arena of the first thread. Without glibc nothing
    is done.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None  # musl has none
    if mallopt is None:
        return
    for variable, (option, value) in OPTIONS.items():
        if variable not in os.environ:
            mallopt(option, value)
