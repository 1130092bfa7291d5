"""What one thread of this machine can do at most, measured in the same run as everything else."""

from typing import NamedTuple

import torch

from benchmarks.timing import measure
from gsbench.kernels import native

LANES = 16
UNITS = {"flops": "GFLOP/s", "bytes": "GB/s", "alphas": "G alphas/s"}


class Limits(NamedTuple):
    """Billions a second."""

    flops: float  # multiply-adds in registers, two operations each
    bytes: float  # triad, to and from memory
    alphas: float  # the bare inner loop of blending, in registers


def limits() -> Limits:
    """Measure them all, one thread."""
    kernels, rounds = native(), 1_000_000
    a, b, c = (torch.rand(1 << 24) for _ in range(3))
    flops = measure(lambda: kernels.roofline_flops(rounds)).p10
    triad = measure(lambda: kernels.roofline_triad(a.data_ptr(), b.data_ptr(), c.data_ptr(), len(a))).p10
    alphas = measure(lambda: kernels.roofline_alphas(rounds)).p10
    return Limits(20 * LANES * rounds / flops / 1e6, 12 * len(a) / triad / 1e6, LANES * rounds / alphas / 1e6)
