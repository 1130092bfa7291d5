"""Write the list of a sweep's runs to `results/<experiment>/.sweep/<time>/plan.json`, and the outcome of each run.

A run is identified by those of its overrides that affect its results (`identity`). Its record and its progress file
contain the same overrides, so that runs are matched with files without composing a config, which takes 0.1 s.
"""

import contextlib
import os
import shutil
import socket
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from statistics import fmean

from gsbench.config_roles import repeating
from gsbench.measure.atomic import write_atomically
from gsbench.reading import as_json, read_json
from gsbench.run.progress import born

FOLDER, FILE_NAME, ENDED = ".sweep", "plan.json", "ended"
MOST_RUNS = 100_000
Identity = tuple[str, ...]


@dataclass(frozen=True)
class Plan:
    """The runs that one command requested, and the process that launches them."""

    launcher: str  # local, parallel or slurm
    runs: list[list[str]]  # the overrides of each run, in the order of the tasks of a job array
    config_dir: str | None = None  # the user's own configs
    job: str | None = None  # the job array of Slurm, of which task k does run k
    cwd: str = field(default_factory=os.getcwd)  # relative paths in overrides start here
    host: str = field(default_factory=socket.gethostname)
    pid: int = field(default_factory=os.getpid)  # of the process that launches the runs
    born: int | None = field(default_factory=lambda: born(os.getpid()))
    started: float = field(default_factory=time.time)  # Unix seconds


@dataclass(frozen=True)
class Ended:
    """The outcome of one run of a sweep, written by the process that did it."""

    record: str | None = None  # path of its record, relative to the folder of all results; None if it has none
    reason: str | None = None  # why it did not end well; None if it did
    is_refused: bool = False  # whether it was refused before it began, so that nothing was run
    seconds: float | None = None  # from its start to its end; None if an earlier record was kept


def identity(overrides: Sequence[str]) -> Identity:
    """Return those overrides of a run that affect its results; they identify the run."""
    return tuple(repeating(overrides))


def folder_of(results: str, experiment: str) -> Path:
    """Return the path of a new folder for a plan, which is absolute."""
    name = datetime.now().strftime("%Y-%m-%d_%H-%M-%S.%f")
    return Path(results).absolute() / experiment / FOLDER / name


def write(plan: Plan, folder: Path) -> None:
    """Write the plan of a sweep to plan.json in its folder."""
    write_atomically(folder / FILE_NAME, f"{as_json(plan)}\n".encode())


def read(path: Path) -> Plan:
    """Read the plan of a sweep; an InputError names the file and the field that are not valid."""
    return read_json(Plan, path, most=MOST_RUNS)


def find(experiment: Path) -> list[Path]:
    """Return the paths of all sweep plans of an experiment, oldest first."""
    return sorted((experiment / FOLDER).glob(f"*/{FILE_NAME}"))


def forget(folder: Path) -> None:
    """Delete the plan in `folder`, and the folder, because not one of its runs began."""
    shutil.rmtree(folder, ignore_errors=True)
    with contextlib.suppress(OSError):  # other plans are there
        folder.parent.rmdir()


def log_of(folder: Path, number: int | str) -> Path:
    """Return the path of the log of a Slurm job: of a run by its number, or a pattern of sbatch."""
    return folder / f"{number}.log"


def write_ended(folder: Path, number: int, ended: Ended) -> None:
    """Write the outcome of run `number` of the sweep whose plan is in `folder`."""
    write_atomically(folder / ENDED / f"{number}.json", as_json(ended).encode())


def read_ended(folder: Path) -> dict[int, Ended]:
    """Read the outcomes of the runs of the sweep whose plan is in `folder`, by run number; skip damaged files."""
    outcomes = {}
    for path in (folder / ENDED).glob("*.json"):
        with contextlib.suppress(ValueError):  # InputError too
            outcomes[int(path.stem)] = read_json(Ended, path)
    return outcomes


def time_left(folder: Path, at_once: int) -> str:
    """Return a line with the number of ended runs of a sweep, and about how long its other runs will take.

    The other runs are expected to take as long as the mean of those that this sweep has trained. The line is empty
    before the first of these, and after the last run.
    """
    total, outcomes = len(read(folder / FILE_NAME).runs), read_ended(folder)
    durations = [outcome.seconds for outcome in outcomes.values() if outcome.seconds is not None]
    left = total - len(outcomes)
    if not durations or left <= 0:
        return ""
    seconds = fmean(durations) * left / max(1, min(at_once, left))
    return f"{len(outcomes)} of {total} runs have ended; about {duration(seconds)} left"


def duration(seconds: float) -> str:
    """Return seconds as text in whole seconds or minutes, or in hours; below zero, of another clock, as 0 s."""
    seconds = max(0.0, seconds)
    minutes = seconds / 60
    return f"{seconds:.0f} s" if minutes < 2 else f"{minutes:.0f} min" if minutes < 120 else f"{minutes / 60:.1f} h"
