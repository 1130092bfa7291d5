"""Let idle OpenMP threads sleep instead of spinning, whichever library has loaded their runtime.

Spinning threads of torch take the cores from those of the kernels, and both take them from other programs. libgomp, the
runtime of torch's wheels and of the kernels, is told by OMP_WAIT_POLICY, which it reads once, as it is loaded; no call
changes it later.
"""

import ctypes
import os
import sys
import threading

RUNTIME = "libgomp.so.1"


def sleep_when_idle() -> None:
    """Ask for sleeping threads, unless the environment asks for something; before torch is imported or after.

    A runtime that is already loaded waits for 300,000 rounds before it sleeps, but for only 100 while there are more
    OpenMP threads than processors (manual of libgomp, GOMP_SPINCOUNT). There it is given that many, which do nothing.
    Another library's own copy of the runtime, under another name, is not reached.
    """
    if "OMP_WAIT_POLICY" in os.environ or "GOMP_SPINCOUNT" in os.environ:
        return
    os.environ["OMP_WAIT_POLICY"] = "passive"
    if sys.platform != "linux":
        return
    try:
        runtime = ctypes.CDLL(RUNTIME, mode=os.RTLD_NOLOAD)
    except OSError:  # it is not loaded yet, and will read the variable
        return
    made = threading.Event()
    threading.Thread(target=_crowd, args=(runtime, made), name="gsbench-crowd", daemon=True).start()
    made.wait()


def _crowd(runtime: ctypes.CDLL, made: threading.Event) -> None:
    """Make one OpenMP thread more than there are processors, and keep them all: they belong to this thread."""
    nothing = ctypes.CDLL(None).sched_yield  # each of them runs it once; it takes no argument
    runtime.GOMP_parallel(nothing, None, runtime.omp_get_num_procs() + 1, 0)
    made.set()
    threading.Event().wait()
