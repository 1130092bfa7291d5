"""Estimate how long Table 1 of the paper takes: time steps on this machine, and add up 57 trainings."""

import argparse
import heapq
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby

import torch

from benchmarks.scene import SIGMA, VISIBLE, trained
from benchmarks.stages import MODELS
from benchmarks.timing import Cost, measure
from benchmarks.training import training_step
from gsbench.measure.machine import processor_name
from gsbench.measure.provenance import git_commit
from gsbench.report.paper import AVERAGE, PROTOCOLS, paper_row

COUNTS = 30_000, 150_000  # Gaussians for which a step is timed
FIRST = 100_000  # Gaussians at the start, as `data.initial_points`
DENSIFIES = 0.5  # share of a run, as `train.densify.stop`
CORES, THREADS = 64, 2  # of a larger machine; a run has two threads
MS_AN_HOUR = 3.6e6
ASSUMPTIONS = (
    f"Assumptions: CPU time of a step is linear in Gaussians, timed at {COUNTS[0]:,} and {COUNTS[1]:,}; their number "
    f"goes linearly from {FIRST:,} to the paper's until densification ends (half of a run), then stays; a view shows "
    f"{VISIBLE:.0%} of them, of a 3-sigma radius of 5 pixels; AGR and degree 3 act from the first step; only steps "
    f"count, not loading or measuring; {CORES} cores are as fast as this machine's, also when all are busy."
)


@dataclass(frozen=True)
class Run:
    """One training of Table 1."""

    dataset: str
    model: str
    size: tuple[int, int]  # width and height of the images
    views: int  # of a batch
    gaussians: int  # at the end


@dataclass(frozen=True)
class StepCost:
    """Milliseconds of CPU that a step takes, and how much faster it is on two threads."""

    base: float
    each: float  # Gaussian
    speedup: float

    def hours(self, gaussians: int, iterations: int) -> float:
        """Return the hours of CPU of a run that ends with so many Gaussians."""
        mean = DENSIFIES * (FIRST + gaussians) / 2 + (1 - DENSIFIES) * gaussians
        return iterations * (self.base + self.each * mean) / MS_AN_HOUR


def table1_runs() -> Iterator[Run]:
    """List the runs of Table 1, by data set and model; where the paper has no number, its average is used."""
    for dataset, protocol in PROTOCOLS.items():
        for name in MODELS:
            for scene in protocol.scenes:
                width, height = map(int, protocol.sizes.get(scene, protocol.sizes["*"]).split("x"))
                row = paper_row(dataset, scene, name) or paper_row(dataset, AVERAGE, name)
                assert row is not None
                yield Run(dataset, name, (width, height), protocol.batch_size, row.num_gaussians)


def time_step(run: Run, gaussians: int, threads: int) -> Cost:
    """Time a step of a run on the benchmark's scene, with so many Gaussians and threads."""
    name, agr = MODELS[run.model]
    width, height = run.size
    step = training_step(trained(name, gaussians, agr=agr, sigma=SIGMA * 400 / width), width, height, run.views)
    torch.set_num_threads(threads)
    cost = measure(step)
    torch.set_num_threads(1)
    return cost


def step_cost(run: Run, time: Callable[[Run, int, int], Cost] = time_step) -> StepCost:
    """Fit the cost of a step from `time(run, gaussians, threads)`."""
    few, many, shared = time(run, COUNTS[0], 1), time(run, COUNTS[1], 1), time(run, COUNTS[1], THREADS)
    each = (many.median - few.median) / (COUNTS[1] - COUNTS[0])
    return StepCost(few.median - each * COUNTS[0], each, many.wall / shared.wall)


def estimate(runs: Sequence[Run], iterations: int, time: Callable[[Run, int, int], Cost] = time_step) -> Iterator[str]:
    """Yield the lines of the table as steps are timed, and the totals."""
    yield f"| data set | model | runs | speed-up by {THREADS} threads | hours of CPU |"
    yield "| --- | --- | ---: | ---: | ---: |"
    costs: dict[tuple[object, ...], StepCost] = {}
    work: list[float] = []  # hours of CPU of each run ..
    walls: list[float] = []  # .. and its hours on two threads
    for (dataset, name), group in groupby(runs, lambda run: (run.dataset, run.model)):
        begin = len(work)
        for run in group:
            key = run.model, run.size, run.views
            if key not in costs:
                costs[key] = step_cost(run, time)
            work.append(costs[key].hours(run.gaussians, iterations))
            walls.append(work[-1] / costs[key].speedup)
        hours = sum(work[begin:])
        speedup = hours / sum(walls[begin:])
        yield f"| {dataset} | {name} | {len(work) - begin} | {speedup:.2f} | {hours:.1f} |"
    at_once = CORES // THREADS
    yield ""
    yield (f"{len(work)} runs of {iterations:,} steps: {sum(work):.1f} hours of CPU; {sum(walls):.1f} hours on 2 cores "
           f"(one run at a time, on two threads); {span(walls, at_once):.1f} hours on {CORES} cores ({at_once} runs at "
           "once on two threads each, the longest first).")  # fmt: skip


def span(seconds: Sequence[float], at_once: int) -> float:
    """Return when all trainings are done, if `at_once` of them run at a time and the longest begin first."""
    ends = [0.0] * min(at_once, max(1, len(seconds)))
    for duration in sorted(seconds, reverse=True):
        heapq.heapreplace(ends, ends[0] + duration)
    return max(ends)


def main() -> None:
    """Print the estimate in Markdown."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.estimate", description=__doc__)
    parser.add_argument("--iterations", type=int, default=30_000, help="steps of a run, 30,000 in the paper")
    options = parser.parse_args()
    if options.iterations < 1:
        parser.error(f"--iterations: expected at least 1, got {options.iterations}")
    torch.set_num_threads(1)
    print(f"{processor_name()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} at the start, commit "
          f"{git_commit()}.\n\n{ASSUMPTIONS}\n", flush=True)  # fmt: skip
    for line in estimate(list(table1_runs()), options.iterations):
        print(line, flush=True)


if __name__ == "__main__":
    main()
