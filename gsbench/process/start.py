"""Settle how a process keeps freed memory, waits in idle threads, and computes the same bits on every processor.

gsbench calls these functions before torch or the kernels are loaded.
"""

import ctypes
import os
import threading
from pathlib import Path

from gsbench.process.memory import lines_of

HUGE = 1 << 29  # bytes of the heap that ask for huge pages
HUGE_PAGE = 1 << 21  # bytes of one
MADV_HUGEPAGE = 14  # madvise(2)
KEPT = 1 << 30  # bytes: the largest block that malloc keeps, and the most free memory at the end of the heap
# Options of glibc's malloc (mallopt(3)), by the environment variable that overrides the option.
OPTIONS = {
    "MALLOC_TRIM_THRESHOLD_": (-1, KEPT),  # M_TRIM_THRESHOLD
    "MALLOC_MMAP_THRESHOLD_": (-3, KEPT),  # M_MMAP_THRESHOLD
    "MALLOC_ARENA_MAX": (-8, 1),  # M_ARENA_MAX
}
RUNTIME = "libgomp.so.1"
TORCH = "ATEN_CPU_CAPABILITY"  # torch reads it at its first operation
MKL = "MKL_CBWR"  # MKL too; COMPATIBLE is its only code for which Intel promises the same bits on processors of AMD
CPUINFO = Path("/proc/cpuinfo")


def keep_freed_memory() -> None:
    """Make glibc's malloc keep large freed blocks, for all threads; call this before other threads start.

    A training step frees several hundred megabytes of gradients and allocates them again, which took a quarter of the
    time of a training step of 4DGS with 150,000 Gaussians. All threads share one heap (arena), because glibc's heaps of
    further threads return large blocks to the system. Without glibc this function does nothing.
    """
    libc = ctypes.CDLL(None)
    if not hasattr(libc, "mallopt"):  # as musl's
        return
    for variable, (option, value) in OPTIONS.items():
        if variable not in os.environ:
            libc.mallopt(option, value)
    _allow_huge_pages(libc)


def _allow_huge_pages(libc: ctypes.CDLL) -> None:
    """Allow the system to put the next HUGE bytes of the heap into huge pages.

    A processor keeps the addresses of few pages only (its TLB), and looks up those of others: with huge pages, a
    training step of 7DGS takes 4 to 13 % less time. Systems differ in whether memory must ask for them (Linux,
    transparent_hugepage/enabled). The block that marks the memory is freed at once, without having been touched.
    """
    libc.malloc.restype, libc.malloc.argtypes = ctypes.c_void_p, [ctypes.c_size_t]
    if block := libc.malloc(HUGE):
        first = -(-block // HUGE_PAGE) * HUGE_PAGE  # madvise wants the start of a page
        libc.madvise(ctypes.c_void_p(first), ctypes.c_size_t(HUGE - HUGE_PAGE), MADV_HUGEPAGE)
        libc.free(ctypes.c_void_p(block))


def sleep_when_idle() -> None:
    """Make idle OpenMP threads sleep, unless the environment sets OMP_WAIT_POLICY or GOMP_SPINCOUNT.

    Spinning (busy-waiting) threads of torch take cores from gsbench's kernels and from other programs. Both torch's
    wheels and the kernels use the OpenMP runtime libgomp, which reads OMP_WAIT_POLICY only once, when it is loaded. The
    function works before and after torch is imported. If libgomp is already loaded, its idle threads spin for
    300,000 rounds, but only for 100 rounds while there are more OpenMP threads than processors (libgomp manual,
    GOMP_SPINCOUNT). Therefore this function then starts threads that do nothing, until there are more threads than
    processors. It does not affect a copy of libgomp that a library ships under another name.
    """
    if "OMP_WAIT_POLICY" in os.environ or "GOMP_SPINCOUNT" in os.environ:
        return
    os.environ["OMP_WAIT_POLICY"] = "passive"
    try:
        runtime = ctypes.CDLL(RUNTIME, mode=os.RTLD_NOLOAD)
    except OSError:  # it is not loaded yet, and will read the variable
        return
    started = threading.Event()
    threading.Thread(target=_crowd, args=(runtime, started), name="gsbench-crowd", daemon=True).start()
    started.wait()


def _crowd(runtime: ctypes.CDLL, started: threading.Event) -> None:
    """Start more OpenMP threads than there are processors; this thread never ends, because they would end with it."""
    nothing = ctypes.CDLL(None).sched_yield  # each thread calls this once; it has no arguments
    runtime.GOMP_parallel(nothing, None, runtime.omp_get_num_procs() + 1, 0)  # function, its data, threads, flags
    started.set()
    threading.Event().wait()


def compute_the_same_bits() -> None:
    """Make torch use AVX2 if the processor has AVX-512, and MKL its compatible code, unless the environment chooses.

    By default torch and its MKL choose approximations and orders of sums by the processor. The CPU kernels of gsbench
    need no such setting (kernels/cpu/simd.h). Call it before torch computes. Without AVX2, torch would end the process
    by a signal. Every processor with AVX-512 has AVX2.
    """
    os.environ.setdefault(MKL, "COMPATIBLE")
    if _has_avx512():
        os.environ.setdefault(TORCH, "avx2")


def _has_avx512() -> bool:
    return any(line.startswith("flags") and " avx512f" in line for line in lines_of(CPUINFO))
