"""Measure FPS, seconds of each training stage, CPU-seconds, the load of the machine and peak memory.

torch is imported only for a GPU, so that records can be read without torch.
"""

import ctypes
import math
import os
import statistics
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsbench.errors import InputError

WARM_UP = 5  # frames
OTHER = "other"  # the stage of all work that is in no other stage, such as checks of values and Python


@dataclass(frozen=True)
class RenderTimes:
    """The 10th percentile, median and 90th percentile of the milliseconds of a rendered frame."""

    p10: float
    p50: float
    p90: float

    @property
    def fps(self) -> float:
        """Return frames per second: FPS = 1000 / p50, with the median p50 of milliseconds per frame.

        A frame is computed from a camera and a time, including slicing (conditioning on time and direction) and AGR,
        the neural refinement. The device is synchronised before and after each frame, and warm-up frames do not count.
        The evaluated views are rendered in turn.
        """
        return 1000.0 / self.p50


def synchroniser(device: str) -> Callable[[], None]:
    """Return a function that waits until `device` ("cpu", "cuda", "cuda:1") has finished its work."""
    if not device.startswith("cuda"):
        return lambda: None  # a call returns only after its work is done
    import torch

    return lambda: torch.cuda.synchronize(device)


def time_in_turns(
    renders: Sequence[Callable[[int], object]],
    count: int,
    synchronise: Callable[[], None] = lambda: None,
) -> list[RenderTimes]:
    """Time `count` calls of each render(i), i = 0, 1, ..., after WARM_UP calls that do not count.

    Several functions take turns, so that other load on the machine affects all alike. A call renders an image from the
    model, including slicing (conditioning on time and direction) and AGR (the neural refinement), and caches nothing
    for the next call. The device is synchronised before and after each call.
    """
    times: list[list[float]] = [[] for _ in renders]  # milliseconds
    for i in range(-WARM_UP, count):
        for milliseconds, render in zip(times, renders, strict=True):
            synchronise()
            start = time.perf_counter()
            render(i % count)
            synchronise()
            milliseconds.append(1000.0 * (time.perf_counter() - start))
    deciles = [statistics.quantiles(milliseconds[WARM_UP:], n=10, method="inclusive") for milliseconds in times]
    return [RenderTimes(p10=nine[0], p50=nine[4], p90=nine[8]) for nine in deciles]


class StageClock:
    """Sums the seconds of each stage of training; `with stages("loss"): ...` adds to the stage "loss".

    In a block `with stages.running(): ...` the work between stages counts too, as the stage OTHER, so that all stages
    add up to the wall-clock seconds of these blocks.

    On a GPU, CUDA events mark the start and end of a stage, so that the CPU waits for the GPU only when the sums are
    read. GPU work counts for the stage that launched it.
    """

    def __init__(self, device: str = "cpu") -> None:
        self._seconds: dict[str, float] = {}
        self._clock = _DeviceClock(device) if device.startswith("cuda") else _HostClock()
        self._ended: deque[tuple[str, Any, Any]] = deque()  # name, start and end of stages that are not yet in the sums
        self._current: str | None = None
        self._last: Any = None  # when the last stage ended; None outside of `running`

    @contextmanager
    def running(self) -> Iterator[None]:
        """Time a block of work as a whole: what is in none of its stages counts as the stage OTHER."""
        self.start()
        try:
            yield
        finally:
            self.lap(OTHER)
            self._last = None

    def start(self) -> None:
        """Start the first of consecutive stages, which end by `lap`."""
        self._last = self._clock.mark()

    def lap(self, name: str) -> None:
        """End a stage that began where the one before ended, and name it."""
        self._end(name, self._last)

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Time a block of work as part of the stage `name`.

        Raises:
            InputError: the block is inside another stage, so that its seconds would count twice.
        """
        if self._current is not None:
            raise InputError(f"stages: '{name}' was opened inside '{self._current}'; close that one first")
        self._current = name
        start = self._begin()
        try:
            yield
        finally:
            self._end(name, start)
            self._current = None

    @contextmanager
    def side_by_side(self, workers: int) -> Iterator[list["StageClock"]]:
        """Time a block in which several threads of the CPU work at the same time, each with a clock of its own.

        The seconds of the block are divided among the stages in proportion to the seconds that the threads took.
        """
        clocks = [StageClock() for _ in range(workers)]
        start = self._begin()
        yield clocks
        end = self._clock.mark()
        self.share([clock.seconds for clock in clocks], self._clock.seconds(start, end))
        if self._last is not None:  # in `running`: the next seconds of OTHER begin here
            self._last = end

    def share(self, workers: list[dict[str, float]], wall: float) -> None:
        """Add `wall` seconds of parallel workers, divided among stages in proportion to the seconds in `workers`."""
        total = sum(sum(seconds.values()) for seconds in workers)
        if not total:
            self.add(OTHER, wall)
            return
        for seconds in workers:
            for name, taken in seconds.items():
                self.add(name, wall * taken / total)

    def add(self, name: str, seconds: float) -> None:
        """Add seconds that were measured elsewhere to a stage."""
        self._seconds[name] = self._seconds.get(name, 0.0) + seconds

    @property
    def seconds(self) -> dict[str, float]:
        """Return the seconds of each stage, ordered by when it first ended; on a GPU this waits for the device."""
        while self._ended:
            self._add_one()
        return self._seconds

    def _begin(self) -> Any:
        """Mark the start of a stage, at which the work since the last stage ends."""
        start = self._clock.mark()
        if self._last is not None:
            self._ended.append((OTHER, self._last, start))
            self._last = start
        return start

    def _end(self, name: str, start: Any) -> None:
        """Mark the end of a stage, and add up the stages that the device has finished."""
        end = self._clock.mark()
        self._ended.append((name, start, end))
        if self._last is not None:
            self._last = end
        while self._ended and self._clock.has_passed(self._ended[0][2]):
            self._add_one()

    def _add_one(self) -> None:
        name, start, end = self._ended.popleft()
        self.add(name, self._clock.seconds(start, end))

    def state_dict(self) -> dict[str, float]:
        """Return the seconds of each stage, for a checkpoint."""
        return dict(self.seconds)

    def load_state_dict(self, state: dict[str, float]) -> None:
        """Replace the seconds of each stage by those of a checkpoint."""
        self._ended.clear()
        self._seconds = {name: float(seconds) for name, seconds in state.items()}


class Effort:
    """Sums the CPU-seconds of this process in the blocks `with effort: ...`, and averages the load of the machine.

    Both values show whether the machine did other work: the load counts the running and waiting processes of the whole
    machine, and CPU-seconds do not grow while this process waits for a processor. An unknown value is None.
    """

    def __init__(self) -> None:
        """Start with no CPU-seconds and no load."""
        self._seconds = self._cpu_s = self._load_s = 0.0  # the last: the sum of load x seconds
        self._began = 0.0, 0.0  # wall clock and CPU clock, s

    def __enter__(self) -> None:
        self._began = time.perf_counter(), time.process_time()

    def __exit__(self, *_: object) -> None:
        seconds, cpu_s = time.perf_counter() - self._began[0], time.process_time() - self._began[1]
        self._seconds += seconds
        self._cpu_s += cpu_s
        self._load_s += load() * seconds

    def add(self, other: "Effort") -> None:
        """Add the CPU-seconds and the load of another `Effort` to this one."""
        self._seconds += other._seconds
        self._cpu_s += other._cpu_s
        self._load_s += other._load_s

    @property
    def cpu_s(self) -> float | None:
        """Return the CPU-seconds of all threads of this process during the timed blocks."""
        return self._cpu_s if math.isfinite(self._cpu_s) else None

    @property
    def load(self) -> float | None:
        """Return the mean load of the machine over the timed blocks."""
        mean = self._load_s / self._seconds if self._seconds else math.nan
        return mean if math.isfinite(mean) else None

    def state_dict(self) -> dict[str, float]:
        """Return the CPU-seconds and the load measured so far, for a checkpoint."""
        return {"seconds": self._seconds, "cpu_s": self._cpu_s, "load_s": self._load_s}

    def load_state_dict(self, state: dict[str, float]) -> None:
        """Replace CPU-seconds and load by those of a checkpoint."""
        self._seconds, self._cpu_s, self._load_s = (float(state[name]) for name in ("seconds", "cpu_s", "load_s"))


def load() -> float:
    """Return the load average of the machine over the last minute, or NaN if the system does not report one.

    The load average counts the processes that run or wait for a processor.
    """
    try:
        return os.getloadavg()[0]
    except (AttributeError, OSError):  # Windows; a container without /proc
        return math.nan


class _HostClock:
    """A clock that marks moments, and measures the seconds between two marks."""

    def mark(self) -> float:
        return time.perf_counter()

    def has_passed(self, mark: float) -> bool:
        return True

    def seconds(self, start: float, end: float) -> float:
        return end - start


class _DeviceClock:
    """A clock whose marks are CUDA events; each is the moment at which the GPU has finished all earlier work."""

    def __init__(self, device: str) -> None:
        self.device = device

    def mark(self) -> Any:
        import torch

        event = torch.cuda.Event(enable_timing=True)
        event.record(torch.cuda.current_stream(self.device))
        return event

    def has_passed(self, mark: Any) -> bool:
        return bool(mark.query())

    def seconds(self, start: Any, end: Any) -> float:
        end.synchronize()
        return float(start.elapsed_time(end)) / 1000


def reset_peak_memory(device: str = "cpu") -> None:
    """Reset the peak memory, so that a run does not report the peak of an earlier run in the same process."""
    if device.startswith("cuda"):
        import torch

        torch.cuda.reset_peak_memory_stats(device)
    elif (clear := Path("/proc/self/clear_refs")).exists():
        with suppress(AttributeError):  # a libc that is not glibc
            ctypes.CDLL(None).malloc_trim(0)  # freed memory that malloc keeps does not belong to the next run
        clear.write_text("5")  # proc(5): resets VmHWM, which ru_maxrss reports


def peak_memory(device: str = "cpu") -> int:
    """Return the peak memory in bytes: on a GPU the memory allocated by torch, else the process' resident memory."""
    if device.startswith("cuda"):
        import torch

        return int(torch.cuda.max_memory_allocated(device))
    import resource  # not available on Windows, where records can still be read

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024  # getrusage(2): kilobytes on Linux
