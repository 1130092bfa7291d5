"""Two ways to the same thing, timed side by side on one device: what a call costs, and the rows a comparison gives."""

import statistics
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

Call = Callable[[], Any]
Row = dict[str, Any]


class Cost(NamedTuple):
    """Milliseconds of a call, and the MiB it holds at most beside what was there before (0 on the CPU)."""

    ms: float  # median of single calls, before and after each of which the device is waited for
    p10: float
    p90: float
    back_to_back: float  # mean of calls that follow each other without waiting; where a call waits itself, that counts
    mib: float

    @classmethod
    def of(cls, times: list[float], in_all: float, peak: int) -> "Cost":
        """Return the cost of calls by the `times` of single ones, and the time of as many back to back."""
        deciles = statistics.quantiles(times, n=10, method="inclusive")
        return cls(statistics.median(times), deciles[0], deciles[-1], in_all / len(times), peak / 2**20)


@dataclass
class Place:
    """Where is measured, and against what. Not torch's default device: that would cost a microsecond an operation."""

    device: str
    gsplat: bool = False

    @property
    def on_gpu(self) -> bool:
        return self.device == "cuda"

    def put(self, tensors: tuple[Tensor, ...]) -> list[Tensor]:
        return [x.to(self.device) for x in tensors]

    def cost(self, call: Call, repeats: int = 30) -> Cost:
        """Time a call after a few to warm up, on a GPU by events."""

        def in_a_row(count: int) -> None:
            for _ in range(count):
                call()

        in_a_row(5 if self.on_gpu else 1)
        if not self.on_gpu:
            return Cost.of([self.timed(call) for _ in range(3)], self.timed(lambda: in_a_row(3)), 0)
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
        held, times = torch.cuda.memory_allocated(), [self.timed(call) for _ in range(repeats)]
        peak = torch.cuda.max_memory_allocated()
        return Cost.of(times, self.timed(lambda: in_a_row(repeats)), peak - held)

    def timed(self, call: Call) -> float:
        """Return the milliseconds of a call, and of all work that it gives a GPU."""
        if not self.on_gpu:
            began = time.perf_counter()
            call()
            return 1e3 * (time.perf_counter() - began)
        start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        torch.cuda.synchronize()
        start.record()
        call()
        end.record()
        torch.cuda.synchronize()
        return start.elapsed_time(end)


@dataclass
class Case:
    """What is compared: two ways to the same picture, each with what it has gradients by."""

    section: str
    name: str
    ours: Call
    other: Call
    leaves: list[Tensor]
    other_leaves: list[Tensor]
    least_bytes: float | None = None  # that forward cannot do without
    least_alphas: float | None = None  # of at least 1/255

    def rows(self, place: Place) -> Iterator[Row]:
        """Forward without a graph, backward on a graph that is kept, and both."""
        passes = {"forward": 1, "backward": 2, "both": 3}  # a backward moves and blends everything about twice
        costs = self.costs(place, self.ours, self.leaves)
        other_costs = self.costs(place, self.other, self.other_leaves) if place.gsplat else [None] * len(passes)
        with torch.no_grad():
            difference = (self.ours() - self.other()).abs().mean().item() if place.gsplat else None
        for (way, times), ours, other in zip(passes.items(), costs, other_costs, strict=True):
            yield compared(self.section, self.name, way, ours, other) | {
                "ours_gb_s": self.least_bytes and times * self.least_bytes / ours.ms / 1e6,
                "ours_galpha_s": self.least_alphas and times * self.least_alphas / ours.ms / 1e6,
                "difference": difference,
            }

    @staticmethod
    def costs(place: Place, call: Call, leaves: list[Tensor]) -> list[Cost]:
        image = call()
        upstream = torch.ones_like(image)

        def both() -> None:
            torch.autograd.grad(call(), leaves, upstream, allow_unused=True)

        backward = place.cost(
            lambda: torch.autograd.grad(image, leaves, upstream, retain_graph=True, allow_unused=True)
        )
        return [place.cost(torch.no_grad()(call)), backward, place.cost(both)]


def attempted(section: str, case: str, measure: Callable[[], Iterable[Row]]) -> Iterator[Row]:
    """The rows of a case, or one that says how it failed: the others are still measured."""
    try:
        yield from measure()
    except Exception as error:
        yield {"section": section, "case": case, "failed": in_a_line(error)}


def in_a_line(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"


def compared(section: str, case: str, way: str, ours: Cost, other: Cost | None) -> Row:
    row: Row = {"section": section, "case": case, "pass": way}
    for who, cost in (("ours", ours), ("theirs", other)):
        if cost is not None:
            row |= {f"{who}_{name}": value for name, value in cost._asdict().items()}
    if other is None:
        return row
    return row | {"ratio": other.ms / ours.ms, "ratio_back_to_back": other.back_to_back / ours.back_to_back}
