"""Wait for the last run of a launched sweep, and list the runs that did not end well.

Hydra's launcher for Slurm stops waiting when the first job dies, while others still run.
"""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from gsbench.errors import InputError
from gsbench.run.stop import Stopped
from gsbench.sweep import parallel, plan
from gsbench.sweep.plan import identity
from gsbench.sweep.status import BROKEN, GOING, RunStatus, read, status

LIBRARY = "submitit"  # used by Hydra's launcher for Slurm
POLL = 10.0  # seconds between two looks at Slurm's queue


def see_through(launch: Callable[[], Any], started: Sequence[Path]) -> tuple[list[RunStatus], bool]:
    """Launch a sweep and wait until its last run has ended.

    Args:
        launch: the function that starts the runs and waits for them; an error of the launcher's library does not stop
            the wait for the other jobs.
        started: the folders of the plans that `launch` wrote, read after it returns; empty if there was no sweep.

    Returns:
        The runs that did not end well, and whether the sweep was refused: not one of its runs began. The plan of a
        refused sweep is deleted.

    Raises:
        InputError: not one job could be submitted.
        Stopped: a signal asked this process, or that of a run, to end.
    """
    try:
        error = _error_of(launch)
        parallel.wait()
    except Stopped as stopped:
        parallel.end(stopped.number)
        raise
    if error is not None:
        if type(error).__module__.partition(".")[0] != LIBRARY:
            _forget_refused(started, is_ended=False)
            raise error
        if all(_is_of_slurm(folder) and not plan.jobs(folder) for folder in started):
            _forget_refused(started, is_ended=False)
            raise InputError(f"the launcher failed: {' '.join(str(error).split())}") from None
    kept = _forget_refused(started, is_ended=True)
    broken = [run for folder in kept for run in _ended(folder) if run.state in (*BROKEN, "planned")]
    return broken, len(kept) < len(started)


def _error_of(launch: Callable[[], Any]) -> Exception | None:
    """Launch a sweep, and return the error that this raised, as runs in other processes may still go on."""
    try:
        launch()
    except Exception as error:
        return error
    return None


def _forget_refused(started: Sequence[Path], *, is_ended: bool) -> list[Path]:
    """Delete the plans of which not one run began, and return the folders of the others.

    Args:
        started: the folders of plans.
        is_ended: whether each run has ended; otherwise the launch failed, and runs without an outcome did not begin.
    """
    kept = []
    for folder in started:
        ended = plan.read_ended(folder)
        began = any(not one.is_refused for one in ended.values()) or plan.jobs(folder)
        if began or (is_ended and len(ended) < len(plan.read(folder / plan.FILE_NAME).runs)):
            kept.append(folder)
        else:
            plan.forget(folder)
    return kept


def _ended(folder: Path) -> list[RunStatus]:
    """Return the status of a plan's runs, after waiting until all its jobs in Slurm have ended."""
    while True:
        whole = plan.read(folder / plan.FILE_NAME)
        requested = {identity(run) for run in whole.runs}
        runs = [run for run in status(read(folder.parents[1])) if identity(run.overrides) in requested]
        if not _is_of_slurm(folder) or not any(run.state in GOING for run in runs):
            return runs
        time.sleep(POLL)


def _is_of_slurm(folder: Path) -> bool:
    return plan.read(folder / plan.FILE_NAME).launcher.startswith("submitit")
