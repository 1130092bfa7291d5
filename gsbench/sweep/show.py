"""Show the status of an experiment as lines of text: the number of runs in each state, and each run not yet done."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from gsbench.errors import printable
from gsbench.sweep.status import STATES, RunStatus


def lines(experiment: Path, runs: Sequence[RunStatus], silent: str | None = None) -> list[str]:
    """Return the lines that show the runs of an experiment; `silent` says why Slurm did not answer."""
    counts = Counter(run.state for run in runs)
    summary = ", ".join(f"{counts[state]} {state}" for state in STATES if counts[state])
    shown = [f"{experiment}: {len(runs)} runs: {summary}" if runs else f"{experiment}: no run was asked for"]
    if silent:
        shown.append(f"Slurm did not answer ({silent}): a run that reported in the last 10 minutes counts as running")
    common = set.intersection(*(set(run.overrides) for run in runs)) if len(runs) > 1 else set()
    named = [(run, " ".join(one for one in run.overrides if one not in common)) for run in runs]
    width = max((len(name) for run, name in named if run.state != "done"), default=0)
    for state in STATES[1:]:
        shown += [f"  {state:8} {name:{width}}  {_details(run)}" for run, name in named if run.state == state]
    return list(map(printable, shown))


def _details(run: RunStatus) -> str:
    parts = []
    if run.state in ("running", "queued"):
        if run.step is not None:
            parts.append(f"step {run.step}/{run.steps}" if run.steps else "loads")
        if run.psnr is not None:
            parts.append(f"val {run.psnr:.2f} dB")
        if run.seconds_left is not None:
            parts.append(f"{_duration(run.seconds_left)} left")
        if run.job is not None:
            parts.append(f"job {run.job}")
    if run.reason:
        parts.append(run.reason)
    return ", ".join(parts)


def _duration(seconds: float) -> str:
    minutes = seconds / 60
    return f"{seconds:.0f} s" if minutes < 2 else f"{minutes:.0f} min" if minutes < 120 else f"{minutes / 60:.1f} h"
