"""Estimate how long the runs of an experiment that are not done will train, from its runs that are done.

A run is compared with runs that are done and differ in the seed only, or else in seed and scene. A running run without
these is estimated by its own rate so far, which is too short if later steps have more Gaussians. For other runs nothing
is estimated. Loading, measuring and pictures are not counted, as a record does not hold their seconds.
"""

import heapq
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

from gsbench.errors import InputError, printable
from gsbench.launch.status import RunStatus
from gsbench.measure import record as records

# Overrides that may differ between a run and the finished runs it is compared with, the nearest comparison first.
DIFFERENCES = {"seed": ("seed=",), "seed and scene": ("seed=", "scene=", "scene.name=")}
OWN_RATE = "their own rate"
MOST_NAMED = 3


@dataclass(frozen=True)
class RunEstimate:
    """The seconds of training that a run still needs: the mean, the least and the most that comparable runs took."""

    overrides: list[str]
    seconds: float | None  # None if no comparable run is done and the run itself does not train
    least: float | None
    most: float | None
    compared: int  # number of comparable runs
    differ: str | None  # in what they may differ, a key of DIFFERENCES; None if there are none


@dataclass(frozen=True)
class Estimate:
    """The estimates of all runs that are not done."""

    machine: str | None  # on which the compared runs were made; None if no run is done
    done: int
    runs: list[RunEstimate]

    def hours(self, at_once: int = 1, quantity: str = "seconds") -> float:
        """Return the hours until all runs with an estimate are done, if `at_once` train at a time, the longest first.

        `quantity` is `seconds`, `least` or `most`.
        """
        known = [value for run in self.runs if (value := getattr(run, quantity)) is not None]
        return span(known, at_once) / 3600


def estimate(runs: Sequence[RunStatus]) -> Estimate:
    """Estimate the training time of the runs that are not done, from those that are.

    Only finished runs of one machine count: that of most of them.
    """
    costs = [(run.overrides, *cost) for run in runs if run.state == "done" and (cost := _cost(run))]
    machine = Counter(machine for _, machine, _ in costs).most_common(1)[0][0] if costs else None
    durations: dict[tuple[str, ...], list[float]] = defaultdict(list)  # by the overrides that may not differ
    for overrides, on, seconds in costs:
        for prefixes in DIFFERENCES.values() if on == machine else ():
            durations[_without(overrides, prefixes)].append(seconds)
    left = [_left(run, durations) for run in runs if run.state != "done"]
    return Estimate(machine, sum(run.state == "done" for run in runs), left)


def _cost(run: RunStatus) -> tuple[str, float] | None:
    """Return the machine and the seconds of training of a finished run; None if its record cannot be read."""
    try:
        record = records.read(Path(run.record or ""))
    except InputError:
        return None
    return (record.provenance.machine, record.cost.train_s) if record.cost else None


def _left(run: RunStatus, durations: dict[tuple[str, ...], list[float]]) -> RunEstimate:
    """Estimate what is left of a run, from comparable runs or from its own rate; a lost run continues at its step."""
    share = 1 - run.step / run.steps if run.step and run.steps else 1.0
    for differ, prefixes in DIFFERENCES.items():
        if seconds := durations.get(_without(run.overrides, prefixes)):
            rest = [share * duration for duration in seconds]
            return RunEstimate(run.overrides, fmean(rest), min(rest), max(rest), len(rest), differ)
    left = run.seconds_left
    return RunEstimate(run.overrides, left, left, left, 0, None)


def _without(overrides: Sequence[str], prefixes: tuple[str, ...]) -> tuple[str, ...]:
    return (*prefixes, *(override for override in overrides if not override.startswith(prefixes)))


def span(times: Sequence[float], at_once: int) -> float:
    """Return when all runs are done, if `at_once` of them run at a time and the longest begin first."""
    ends = [0.0] * min(at_once, max(1, len(times)))
    for duration in sorted(times, reverse=True):
        heapq.heapreplace(ends, ends[0] + duration)
    return max(ends)


def lines(estimated: Estimate, at_once: int) -> list[str]:
    """Return an estimate as lines of text."""
    total = len(estimated.runs) + estimated.done
    text = [f"{len(estimated.runs)} of {total} runs are not done"]
    unknown = [run for run in estimated.runs if run.seconds is None]
    sources = Counter(run.differ for run in estimated.runs if run.seconds is not None)
    if sources:
        which = ", ".join(f"{count} by {f'runs that differ in {differ}' if differ else OWN_RATE}"
                          for differ, count in sources.items())  # fmt: skip
        text.append(f"estimated: {which}; on {estimated.machine}")
        least, most = (estimated.hours(at_once, quantity) for quantity in ("least", "most"))
        text.append(f"{estimated.hours(at_once):.2g} hours of training, {at_once} at a time ({least:.2g} to {most:.2g} "
                    f"if each takes as long as the fastest or the slowest run it is compared with); loading and "
                    f"measuring are not counted")  # fmt: skip
    if unknown:
        more = f", and {len(unknown) - MOST_NAMED} more" if len(unknown) > MOST_NAMED else ""
        named = ", ".join(" ".join(run.overrides) for run in unknown[:MOST_NAMED])
        text.append(f"not estimated, as no run with the same settings is done: {len(unknown)} ({named}{more})")
    return list(map(printable, text))
