"""How long things take: the definition of FPS, seconds per stage of training, peak memory.

torch is imported only where a GPU is asked for, so that the record, and a table of records, need none.
"""

import statistics
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from gsbench.errors import InputError

LEAST_RENDERS = 30


@dataclass(frozen=True)
class RenderTimes:
    """Milliseconds of one render at a camera and a time: 10th percentile, median, 90th percentile."""

    p10: float
    p50: float
    p90: float

    @property
    def fps(self) -> float:
        """Frames per second: 1000 / median milliseconds."""
        return 1000.0 / self.p50


def nothing_to_wait_for() -> None:
    """Synchronise on the CPU, where work is done when the call returns."""


def synchroniser(device: str) -> Callable[[], None]:
    """What waits for `device` ("cpu", "cuda", "cuda:1") to finish the work it was given."""
    if not device.startswith("cuda"):
        return nothing_to_wait_for
    import torch

    return lambda: torch.cuda.synchronize(device)


def time_renders(
    render: Callable[[int], object],
    count: int = LEAST_RENDERS,
    warmup: int = 5,
    synchronise: Callable[[], None] = nothing_to_wait_for,
) -> RenderTimes:
    """Time `render(i)`, i = 0..count-1, after `warmup` untimed calls.

    FPS in gsbench is 1000 / the median of these milliseconds. `render(i)` is the whole way from the model to an image
    on the device, slicing and refinement (AGR) included and nothing cached between calls; the device is waited for
    before and after every one. Raises InputError for fewer than 30 renders, whose percentiles would mean little.
    """
    if count < LEAST_RENDERS:
        raise InputError(f"time_renders: expected count >= {LEAST_RENDERS}, got {count}")
    for i in range(warmup):
        render(i % count)
    milliseconds = []
    for i in range(count):
        synchronise()
        start = time.perf_counter()
        render(i)
        synchronise()
        milliseconds.append(1000.0 * (time.perf_counter() - start))
    deciles = statistics.quantiles(milliseconds, n=10, method="inclusive")
    return RenderTimes(p10=deciles[0], p50=deciles[4], p90=deciles[8])


class Stages:
    """Seconds by stage of training: ``with stages("slice"): ...`` adds to that stage's sum.

    On a GPU the device is waited for at both ends, so that work is charged to the stage that caused it.
    """

    def __init__(self, device: str = "cpu") -> None:
        self.seconds: dict[str, float] = {}
        self._synchronise = synchroniser(device)
        self._current: str | None = None

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Time what runs inside; raises InputError inside another stage, whose seconds would count twice."""
        if self._current is not None:
            raise InputError(f"stages: '{name}' was opened inside '{self._current}'; close that one first")
        self._current = name
        self._synchronise()
        start = time.perf_counter()
        try:
            yield
        finally:
            self._synchronise()
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start
            self._current = None

    def state_dict(self) -> dict[str, float]:
        """The sums so far, for the checkpoint."""
        return dict(self.seconds)

    def load_state_dict(self, state: dict[str, float]) -> None:
        """Continue from the sums of a checkpoint."""
        self.seconds = dict(state)


def reset_peak_memory(device: str = "cpu") -> None:
    """Start a new peak, so that a run does not report that of an earlier one in the same process (multirun)."""
    if device.startswith("cuda"):
        import torch

        torch.cuda.reset_peak_memory_stats(device)
    elif (clear := Path("/proc/self/clear_refs")).exists():
        clear.write_text("5")  # proc(5): resets VmHWM, which ru_maxrss reports


def peak_memory(device: str = "cpu") -> int:
    """Peak bytes: on a GPU what torch allocated there, else the process' resident memory, libraries included."""
    if device.startswith("cuda"):
        import torch

        return int(torch.cuda.max_memory_allocated(device))
    import resource  # not on Windows, where reading records should still work

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024  # getrusage(2): kilobytes on Linux
