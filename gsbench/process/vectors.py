"""Make torch and its MKL compute the same bits on every x86-64 processor with AVX2.

By default they choose approximations and orders of sums by the processor. The CPU kernels of gsbench need no such
setting (kernels/cpu/simd.h).
"""

import os
from pathlib import Path

TORCH = "ATEN_CPU_CAPABILITY"  # torch reads it at its first operation
MKL = "MKL_CBWR"  # MKL too; COMPATIBLE is its only code for which Intel promises the same bits on processors of AMD
CPUINFO = Path("/proc/cpuinfo")


def compute_the_same_bits() -> None:
    """Make torch use AVX2 if the processor has AVX-512, and MKL its compatible code, unless the environment chooses.

    Call it before torch computes. Without AVX2, torch would end the process by a signal. Every processor with AVX-512
    has AVX2.
    """
    os.environ.setdefault(MKL, "COMPATIBLE")
    if _has_avx512():
        os.environ.setdefault(TORCH, "avx2")


def _has_avx512() -> bool:
    try:
        lines = CPUINFO.read_text().splitlines()
    except OSError:
        return False
    return any(line.startswith("flags") and " avx512f" in line for line in lines)
