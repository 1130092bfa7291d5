"""Estimate how long the runs of an experiment that are not done will train, from its runs that are done.

A run is compared with runs that are done and differ in the seed only, or else in seed and scene. A running run without
these is estimated by its own rate so far, which is too short if later steps have more Gaussians. For other runs nothing
is estimated. Loading, measuring and pictures are not counted, as a record does not hold their seconds.
"""

import heapq
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

from gsbench.errors import InputError, printable
from gsbench.measure import record as records
from gsbench.sweep.status import RunStatus

SEED, SCENE = ("seed=",), ("seed=", "scene=", "scene.name=")  # overrides that may differ
MOST_NAMED = 3
Finished = dict[tuple[str, ...], list[float]]  # seconds of training, by the overrides without those that may differ


@dataclass(frozen=True)
class RunEstimate:
    """The seconds of training that a run still needs: the mean, the least and the most that comparable runs took."""

    overrides: list[str]
    seconds: float | None  # None if no comparable run is done and the run itself does not train
    least: float | None
    most: float | None
    compared: int  # number of comparable runs
    differ: str | None  # in what they may differ: "seed", "seed and scene"; None if there are none


@dataclass(frozen=True)
class Estimate:
    """The estimates of all runs that are not done."""

    machine: str | None  # on which the compared runs were made; None if no run is done
    done: int
    runs: list[RunEstimate]

    def hours(self, at_once: int = 1, of: str = "seconds") -> float:
        """Return the hours until all runs with an estimate are done, if `at_once` train at a time, the longest first.

        Args:
            at_once: the number of runs at a time, each as fast as the finished ones.
            of: `seconds`, `least` or `most`.
        """
        known = [value for run in self.runs if (value := getattr(run, of)) is not None]
        return span(known, at_once) / 3600


def estimate(runs: Sequence[RunStatus]) -> Estimate:
    """Estimate the training time of the runs that are not done, from those that are.

    Only finished runs of one machine count: that of most of them.
    """
    read = [(run.overrides, *found) for run in runs if run.state == "done" and (found := _of_record(run))]
    machine = Counter(machine for _, machine, _ in read).most_common(1)[0][0] if read else None
    finished: dict[tuple[str, ...], Finished] = {SEED: {}, SCENE: {}}
    for overrides, on, took in read:
        for differing, seconds in finished.items():
            if on == machine:
                seconds.setdefault(_without(overrides, differing), []).append(took)
    left = [_left(run, finished) for run in runs if run.state != "done"]
    return Estimate(machine, sum(run.state == "done" for run in runs), left)


def _of_record(run: RunStatus) -> tuple[str, float] | None:
    """Return the machine and the seconds of training of a finished run; None if its record cannot be read."""
    try:
        record = records.read(Path(run.record or ""))
    except InputError:
        return None
    return (record.provenance.machine, record.cost.train_s) if record.cost else None


def _left(run: RunStatus, finished: dict[tuple[str, ...], Finished]) -> RunEstimate:
    """Estimate what is left of a run, from comparable runs or from its own rate; a lost run continues at its step."""
    share = 1 - run.step / run.steps if run.step and run.steps else 1.0
    for differing, name in ((SEED, "seed"), (SCENE, "seed and scene")):
        took = finished[differing].get(_without(run.overrides, differing))
        if took:
            rest = [share * one for one in took]
            return RunEstimate(run.overrides, fmean(rest), min(rest), max(rest), len(rest), name)
    own = run.seconds_left
    return RunEstimate(run.overrides, own, own, own, 0, None)


def _without(overrides: Sequence[str], differing: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(one for one in overrides if not one.startswith(differing))


def span(times: Sequence[float], at_once: int) -> float:
    """Return when all runs are done, if `at_once` of them run at a time and the longest begin first."""
    ends = [0.0] * min(at_once, max(1, len(times)))
    for one in sorted(times, reverse=True):
        heapq.heapreplace(ends, ends[0] + one)
    return max(ends)


def lines(found: Estimate, at_once: int) -> list[str]:
    """Return an estimate as lines of text."""
    total = len(found.runs) + found.done
    said = [f"{len(found.runs)} of {total} runs are not done"]
    unknown = [run for run in found.runs if run.seconds is None]
    by = Counter(run.differ or "their own rate" for run in found.runs if run.seconds is not None)
    if by:
        which = ", ".join(f"{count} by {_source(name)}" for name, count in by.items())
        said.append(f"estimated: {which}; on {found.machine}")
        least, most = (found.hours(at_once, of) for of in ("least", "most"))
        said.append(f"{found.hours(at_once):.2g} hours of training, {at_once} at a time ({least:.2g} to {most:.2g} "
                    f"if each takes as long as the fastest or the slowest run it is compared with); loading and "
                    f"measuring are not counted")  # fmt: skip
    if unknown:
        more = f", and {len(unknown) - MOST_NAMED} more" if len(unknown) > MOST_NAMED else ""
        named = ", ".join(" ".join(run.overrides) for run in unknown[:MOST_NAMED])
        said.append(f"not estimated, as no run with the same settings is done: {len(unknown)} ({named}{more})")
    return list(map(printable, said))


def _source(name: str) -> str:
    return name if name == "their own rate" else f"runs that differ in {name}"
