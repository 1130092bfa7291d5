"""Measuring: process-CPU and wall time of a call, its median and spread."""

import statistics
import time
from collections.abc import Callable
from typing import Any, NamedTuple


class Cost(NamedTuple):
    """Milliseconds over the repetitions."""

    median: float  # process-CPU time
    p10: float
    p90: float
    wall: float  # median


def measure(call: Callable[[], Any], seconds: float = 1.0, most: int = 100) -> Cost:
    """Repeat a call for about `seconds`, at least 7 times after 2 to warm up."""
    cpu: list[float] = []
    wall: list[float] = []
    began = time.perf_counter()
    while len(cpu) < 9 or (time.perf_counter() - began < seconds and len(cpu) < most):
        start, start_wall = time.process_time(), time.perf_counter()
        call()
        cpu.append(1e3 * (time.process_time() - start))
        wall.append(1e3 * (time.perf_counter() - start_wall))
    deciles = statistics.quantiles(cpu[2:], n=10)
    return Cost(statistics.median(cpu[2:]), deciles[0], deciles[-1], statistics.median(wall[2:]))
