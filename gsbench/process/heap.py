"""Keep freed memory in the process: what is given back to the system is mapped anew, page by page, in the next step."""

import ctypes
import os
import sys

KEPT = 1 << 30  # bytes of a block, and of the free end of the heap
# What glibc's malloc is told (mallopt(3)), by the variable of the environment that would tell it otherwise.
OPTIONS = {
    "MALLOC_TRIM_THRESHOLD_": (-1, KEPT),  # M_TRIM_THRESHOLD
    "MALLOC_MMAP_THRESHOLD_": (-3, KEPT),  # M_MMAP_THRESHOLD
    "MALLOC_ARENA_MAX": (-8, 1),  # M_ARENA_MAX
}


def keep_freed_memory() -> None:
    """Keep large blocks when they are freed, on all threads; before there are any, as each keeps the heap it has.

    A step frees some hundred megabytes of gradients and asks for them again, which took a quarter of a step of 4DGS at
    150,000 Gaussians. The heap ("arena") of another thread than the first gives blocks beyond 64 MB back whatever the
    thresholds are, so all workers share the first one's (docs/cpu.md has
    what that is worth). Where there is no glibc, nothing is done.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None  # musl has none
    if mallopt is None:
        return
    for variable, (option, value) in OPTIONS.items():
        if variable not in os.environ:
            mallopt(option, value)
