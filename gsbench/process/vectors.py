"""Make torch compute with vectors of AVX2 on a processor with AVX-512, so that results do not depend on the processor.

torch has other approximations and other orders of sums for AVX-512. The CPU kernels of gsbench need no such setting:
they compute the same bits with both (kernels/cpu/simd.h).
"""

import os
from pathlib import Path

VARIABLE = "ATEN_CPU_CAPABILITY"  # torch reads it at its first operation
CPUINFO = Path("/proc/cpuinfo")


def use_vectors_of_avx2() -> None:
    """Make torch use AVX2 if the processor has AVX-512, unless the environment chooses; call before torch computes.

    Without AVX2, torch would end the process by a signal. Every processor with AVX-512 has AVX2.
    """
    if VARIABLE not in os.environ and _has_avx512():
        os.environ[VARIABLE] = "avx2"


def _has_avx512() -> bool:
    try:
        lines = CPUINFO.read_text().splitlines()
    except OSError:
        return False
    return any(line.startswith("flags") and " avx512f" in line for line in lines)
