"""Measure the process-CPU and wall time of a call: its median and spread."""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple


@dataclass(frozen=True)
class Row:
    """One measurement."""

    section: str
    name: str
    call: Callable[[], Any]
    target_ms: float | None = None
    floor: tuple[str, float] | None = None  # (which limit, units of it the call cannot do without)
    threads: int = 1
    pixels: int | None = None  # the table shows the time of one


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
