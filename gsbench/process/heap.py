"""Keep freed memory in the process, because getting it back from the system in each training step is slow."""

import ctypes
import os
import sys

KEPT = 1 << 30  # bytes: the largest block that malloc keeps, and the most free memory at the end of the heap
# Options of glibc's malloc (mallopt(3)), by the environment variable that overrides the option.
OPTIONS = {
    "MALLOC_TRIM_THRESHOLD_": (-1, KEPT),  # M_TRIM_THRESHOLD
    "MALLOC_MMAP_THRESHOLD_": (-3, KEPT),  # M_MMAP_THRESHOLD
    "MALLOC_ARENA_MAX": (-8, 1),  # M_ARENA_MAX
}


def keep_freed_memory() -> None:
    """Make glibc's malloc keep large freed blocks, for all threads; call this before other threads start.

    A training step frees several hundred megabytes of gradients and allocates them again, which took a quarter of the
    time of a training step of 4DGS with 150,000 Gaussians. All threads share one heap (arena), because glibc's heaps of
    further threads return large blocks to the system. Without glibc this function does nothing.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None  # musl has none
    if mallopt is None:
        return
    for variable, (option, value) in OPTIONS.items():
        if variable not in os.environ:
            mallopt(option, value)
