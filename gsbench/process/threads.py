"""Make idle OpenMP threads sleep instead of spin (busy-wait).

Spinning threads of torch take cores from gsbench's kernels and from other programs. Both torch's wheels and the kernels
use the OpenMP runtime libgomp, which reads OMP_WAIT_POLICY only once, when it is loaded.
"""

import ctypes
import os
import sys
import threading

RUNTIME = "libgomp.so.1"


def sleep_when_idle() -> None:
    """Make idle OpenMP threads sleep, unless the environment sets OMP_WAIT_POLICY or GOMP_SPINCOUNT.

    The function works before and after torch is imported. If libgomp is already loaded, its idle threads spin for
    300,000 rounds, but only for 100 rounds while there are more OpenMP threads than processors (libgomp manual,
    GOMP_SPINCOUNT). Therefore this function then starts threads that do nothing, until there are more threads than
    processors. It does not affect a copy of libgomp that a library ships under another name.
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
    """Start more OpenMP threads than there are processors; this thread never ends, because they would end with it."""
    nothing = ctypes.CDLL(None).sched_yield  # each thread calls this once; it has no arguments
    runtime.GOMP_parallel(nothing, None, runtime.omp_get_num_procs() + 1, 0)
    made.set()
    threading.Event().wait()
