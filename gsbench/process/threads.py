"""Let idle OpenMP threads sleep instead of spin, whichever library has loaded their runtime.

Spinning threads of torch take cores from the kernels, and both take cores from other programs. libgomp is the runtime
of torch's wheels and of the kernels. It reads OMP_WAIT_POLICY once, when it is loaded; no call changes it later.
"""

import ctypes
import os
import sys
import threading

RUNTIME = "libgomp.so.1"


def sleep_when_idle() -> None:
    """Make idle threads sleep, before or after torch is imported, unless the environment sets a policy.

    A runtime that is already loaded spins for 300,000 rounds before it sleeps, but for only 100 while there are more
    OpenMP threads than processors (manual of libgomp, GOMP_SPINCOUNT). So such a runtime gets that many threads, which
    do nothing. A copy of the runtime that another library brings under another name is not reached.
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
    """Start one OpenMP thread more than there are processors, and keep this thread alive, because they end with it."""
    nothing = ctypes.CDLL(None).sched_yield  # each of them runs it once; it takes no argument
    runtime.GOMP_parallel(nothing, None, runtime.omp_get_num_procs() + 1, 0)
    made.set()
    threading.Event().wait()
