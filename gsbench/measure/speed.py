"""Measure speed and memory: FPS, seconds by stage of training, CPU-seconds, the load of the machine, peak bytes.

torch is imported only for a GPU, so records and their tables do not need it.
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
from typing import Any, Protocol

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
        """Return frames per second: FPS = 1000 / p50, the median milliseconds of a render.

        A render starts with a camera and a time and ends with the image; slicing and AGR are included. It is timed
        between two synchronisations of the device, after warm-up renders. The evaluated views take turns.
        """
        return 1000.0 / self.p50


def nothing_to_wait_for() -> None:
    """Return at once: on the CPU a call returns when its work is done."""


def synchroniser(device: str) -> Callable[[], None]:
    """Return a function that waits until `device` ("cpu", "cuda", "cuda:1") has finished its work."""
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
    """Time `count` calls of `render(i)`, i = 0, 1, ..., after `warmup` untimed calls.

    FPS in gsbench is 1000 / the median of these milliseconds. A call renders an image on the device from the model,
    with slicing and AGR, and caches nothing for the next call. The device is idle when a timing starts and when it
    ends.

    Args:
        render: the function that renders frame i.
        count: number of timed calls.
        warmup: number of untimed calls before them.
        synchronise: waits for the device.

    Raises:
        InputError: `count` is below 30, so percentiles would mean little.
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


def time_in_turns(
    renders: Sequence[Callable[[int], object]],
    count: int = LEAST_RENDERS,
    synchronise: Callable[[], None] = nothing_to_wait_for,
) -> list[RenderTimes]:
    """Time several functions frame by frame in turns, so that other load on the machine affects all equally.

    Args:
        renders: the functions to time; each renders frame i, as in `time_renders`.
        count: number of timed calls of each function.
        synchronise: waits for the device.
    """
    times: list[list[float]] = [[] for _ in renders]
    for i in range(-2, count):
        for own, render in zip(times, renders, strict=True):
            synchronise()
            start = time.perf_counter()
            render(max(i, 0))
            synchronise()
            if i >= 0:
                own.append(1000.0 * (time.perf_counter() - start))
    deciles = [statistics.quantiles(own, n=10, method="inclusive") for own in times]
    return [RenderTimes(p10=own[0], p50=own[4], p90=own[8]) for own in deciles]


class StageClock:
    """Sums the seconds of each stage of training: ``with stages("slice"): ...`` adds to the sum of that stage.

    On a GPU both ends of a stage are events in its stream. So nothing waits for the GPU before the sums are read, and
    work counts for the stage that launched it.
    """

    def __init__(self, device: str = "cpu") -> None:
        self._seconds: dict[str, float] = {}
        self._clock = _clock_of(device)
        self._ended: deque[tuple[str, Any, Any]] = deque()  # name, start and end, not yet in the sums
        self._current: str | None = None

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Time a block of work; raises InputError inside another stage, because the seconds would count twice."""
        if self._current is not None:
            raise InputError(f"stages: '{name}' was opened inside '{self._current}'; close that one first")
        self._current = name
        start = self._clock.mark()
        try:
            yield
        finally:
            self._ended.append((name, start, self._clock.mark()))
            self._current = None
            while self._ended and self._clock.has_passed(self._ended[0][2]):
                self._add_one()

    def share(self, workers: list[dict[str, float]], wall: float) -> None:
        """Add `wall` seconds of parallel workers, split over stages in proportion to the workers' own seconds."""
        total = sum(sum(seconds.values()) for seconds in workers) or 1.0
        for seconds in workers:
            for name, own in seconds.items():
                self._seconds[name] = self._seconds.get(name, 0.0) + wall * own / total

    def add(self, name: str, seconds: float) -> None:
        """Add seconds that were measured elsewhere to a stage."""
        self._seconds[name] = self._seconds.get(name, 0.0) + seconds

    @property
    def seconds(self) -> dict[str, float]:
        """Return the sums so far; reading them waits for the device."""
        while self._ended:
            self._add_one()
        return self._seconds

    def _add_one(self) -> None:
        name, start, end = self._ended.popleft()
        self._seconds[name] = self._seconds.get(name, 0.0) + self._clock.seconds(start, end)

    def state_dict(self) -> dict[str, float]:
        """Return the sums so far, for the checkpoint."""
        return dict(self.seconds)

    def load_state_dict(self, state: dict[str, float]) -> None:
        """Continue from the sums of a checkpoint."""
        self._ended.clear()
        self._seconds = {name: float(seconds) for name, seconds in state.items()}


class Laps:
    """Splits a block of work into stages; each stage begins where the previous one ended.

    The ends are marked as in `StageClock`, so nothing waits for a GPU before the seconds are read.
    """

    def __init__(self, device: str = "cpu") -> None:
        """Begin the first stage."""
        self._clock = _clock_of(device)
        self._last = self._clock.mark()
        self._ended: list[tuple[str, Any, Any]] = []  # name, start and end

    def end(self, name: str) -> None:
        """End the current stage and name it; the seconds of equal names add up."""
        end = self._clock.mark()
        self._ended.append((name, self._last, end))
        self._last = end

    def has(self, name: str) -> bool:
        """Tell whether a stage of that name has ended."""
        return any(name == ended for ended, _, _ in self._ended)

    @property
    def seconds(self) -> dict[str, float]:
        """Return the seconds by stage, in the order in which they first ended; reading them waits for the device."""
        sums: dict[str, float] = {}
        for name, start, end in self._ended:
            sums[name] = sums.get(name, 0.0) + self._clock.seconds(start, end)
        return sums


class Effort:
    """Sums the CPU-seconds of this process over blocks, ``with effort: ...``, and averages the load of the machine.

    The load average and the CPU-seconds show whether the machine did other work: the load counts all processes that ran
    or waited, and CPU-seconds do not grow while another process runs. An unknown value is None.
    """

    def __init__(self) -> None:
        """Start with no CPU-seconds and no load."""
        self._seconds = self._cpu_s = self._load_s = 0.0
        self._began = 0.0, 0.0

    def __enter__(self) -> None:
        self._began = time.perf_counter(), time.process_time()

    def __exit__(self, *_: object) -> None:
        seconds, cpu_s = time.perf_counter() - self._began[0], time.process_time() - self._began[1]
        self._seconds += seconds
        self._cpu_s += cpu_s
        self._load_s += load() * seconds

    def add(self, other: "Effort") -> None:
        """Add the seconds of another `Effort`."""
        self._seconds += other._seconds
        self._cpu_s += other._cpu_s
        self._load_s += other._load_s

    @property
    def cpu_s(self) -> float | None:
        """Return the CPU-seconds of all threads of this process."""
        return self._cpu_s if math.isfinite(self._cpu_s) else None

    @property
    def load(self) -> float | None:
        """Return the mean load of the machine over the timed seconds."""
        mean = self._load_s / self._seconds if self._seconds else math.nan
        return mean if math.isfinite(mean) else None

    def state_dict(self) -> dict[str, float]:
        """Return the sums so far, for the checkpoint."""
        return {"seconds": self._seconds, "cpu_s": self._cpu_s, "load_s": self._load_s}

    def load_state_dict(self, state: dict[str, float] | None) -> None:
        """Continue from the sums of a checkpoint; if an older checkpoint has none, both values become unknown."""
        state = state or dict.fromkeys(("seconds", "cpu_s", "load_s"), math.nan)
        self._seconds, self._cpu_s, self._load_s = (float(state[name]) for name in ("seconds", "cpu_s", "load_s"))


def load() -> float:
    """Return the load average: processes that ran or waited in the last minute; NaN if the system has none."""
    try:
        return os.getloadavg()[0]
    except (AttributeError, OSError):  # Windows; a container without /proc
        return math.nan


class _Clock(Protocol):
    """A clock that marks moments and tells the seconds between two of its marks."""

    def mark(self) -> Any: ...
    def has_passed(self, mark: Any) -> bool: ...
    def seconds(self, start: Any, end: Any) -> float: ...


class _HostClock:
    def mark(self) -> float:
        return time.perf_counter()

    def has_passed(self, mark: float) -> bool:
        return True

    def seconds(self, start: float, end: float) -> float:
        return end - start


class _DeviceClock:
    """Marks the moments at which a GPU has finished the work that was enqueued so far."""

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


def _clock_of(device: str) -> _Clock:
    return _DeviceClock(device) if device.startswith("cuda") else _HostClock()


def reset_peak_memory(device: str = "cpu") -> None:
    """Reset the peak of memory, so that a run does not report that of an earlier run in the same process (multirun)."""
    if device.startswith("cuda"):
        import torch

        torch.cuda.reset_peak_memory_stats(device)
    elif (clear := Path("/proc/self/clear_refs")).exists():
        with suppress(AttributeError):  # a libc that is not glibc
            ctypes.CDLL(None).malloc_trim(0)  # memory kept by the kernels is not of the next run
        clear.write_text("5")  # proc(5): resets VmHWM, which ru_maxrss reports


def peak_memory(device: str = "cpu") -> int:
    """Return the peak of memory in bytes: on a GPU what torch allocated, else the process' resident memory."""
    if device.startswith("cuda"):
        import torch

        return int(torch.cuda.max_memory_allocated(device))
    import resource  # not available on Windows, where records can still be read

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024  # getrusage(2): kilobytes on Linux
