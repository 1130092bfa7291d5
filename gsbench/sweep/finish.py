"""Wait for the last job of a launched sweep, and list the runs that failed.

Hydra's launchers for Slurm and for several processes stop waiting when the first job or process dies, while others
still run.
"""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from gsbench.errors import InputError
from gsbench.sweep import plan
from gsbench.sweep.plan import identity
from gsbench.sweep.status import BROKEN, GOING, RunStatus, read, status

LIBRARIES = ("submitit", "joblib")  # used by Hydra's launchers
POLL = 10.0  # seconds between two looks at Slurm's queue


def see_through(launch: Callable[[], Any], started: Sequence[Path]) -> list[RunStatus]:
    """Launch a sweep, wait until its last job has ended, and return the runs that failed or never started.

    Args:
        launch: the function that starts the runs and waits for them; an error of the launcher's library does not stop
            the wait for the other jobs.
        started: the folders of the plans that `launch` wrote, read after it returns; empty if there was no sweep.

    Raises:
        InputError: not one job could be submitted.
    """
    try:
        launch()
    except Exception as error:
        if type(error).__module__.partition(".")[0] not in LIBRARIES:
            raise
        if all(_is_of_slurm(folder) and not plan.jobs(folder) for folder in started):
            raise InputError(f"the launcher failed: {' '.join(str(error).split())}") from None
    return [run for folder in started for run in _ended(folder) if run.state in (*BROKEN, "planned")]


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
