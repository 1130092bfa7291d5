"""See a launched sweep to its end: a job or a process that died stops no other, and what broke is known at the end.

Hydra's launchers for Slurm and for several processes end with the first job or process that died, while others go on.
"""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from gsbench.errors import InputError
from gsbench.sweep import plan
from gsbench.sweep.plan import identity
from gsbench.sweep.status import BROKEN, GOING, Run, read, status

LIBRARIES = ("submitit", "joblib")  # what Hydra's launchers are made of
POLL = 10.0  # seconds between two looks at Slurm's queue


def see_through(launch: Callable[[], Any], started: Sequence[Path]) -> list[Run]:
    """Launch a sweep, wait for its last job, and return those of its runs that broke.

    Args:
        launch: starts the runs and waits for them; may stop waiting by an error of its library.
        started: when it is done, the folders of the plans that it wrote; none where nothing was swept.

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


def _ended(folder: Path) -> list[Run]:
    """Wait until no run of a plan has a job that goes on, and return the status of its runs."""
    while True:
        whole = plan.read(folder / plan.FILE_NAME)
        asked = {identity(run) for run in whole.runs}
        runs = [run for run in status(read(folder.parents[1])) if identity(run.overrides) in asked]
        if not _is_of_slurm(folder) or not any(run.state in GOING for run in runs):
            return runs
        time.sleep(POLL)


def _is_of_slurm(folder: Path) -> bool:
    return plan.read(folder / plan.FILE_NAME).launcher.startswith("submitit")
