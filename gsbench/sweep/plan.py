"""Write the list of a sweep's runs to `results/<experiment>/.sweep/<time>/plan.json`, and find such plans.

A run is identified by those of its Hydra overrides that affect its results (`identity`). Its record and its progress
file contain the same overrides. Therefore runs can be matched with files without composing a Hydra config, which takes
0.1 s.
"""

import contextlib
import json
import re
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from gsbench.config_roles import repeating
from gsbench.measure.atomic import write_atomically
from gsbench.measure.schema import parse
from gsbench.reading import MAX_JSON, parse_json, read_file

FOLDER, FILE_NAME, ENDED, JOBS = ".sweep", "plan.json", "ended", ".submitit"
MOST_RUNS = 100_000
Identity = tuple[str, ...]


@dataclass(frozen=True)
class Plan:
    """The runs that one command requested, and the process that launches them."""

    launcher: str  # of Hydra: basic or submitit_slurm
    runs: list[list[str]]  # the overrides of each run, in the order of the tasks of a job array
    hydra: list[str]  # overrides of Hydra's own config
    cwd: str  # the folder of the command; relative paths in overrides start there
    host: str
    pid: int  # of the process that launches the runs
    born: int | None  # when that process started: gsbench.run.progress.born
    started: float  # unix seconds


@dataclass(frozen=True)
class Ended:
    """The outcome of one run of a sweep, written by the process that executed the run."""

    record: str | None  # path of its record, relative to the folder of all results; None if it has no record
    reason: str | None  # why it has no record
    is_refused: bool = False  # whether it was refused before it began, so that nothing was run
    seconds: float | None = None  # from its start to its end; None if an earlier record was kept, or it is not known


def identity(overrides: Sequence[str]) -> Identity:
    """Return those overrides of a run that affect its results; they identify the run."""
    return tuple(repeating(overrides))


def write(plan: Plan, folder: Path) -> Path:
    """Write the plan of a sweep to plan.json in the given folder, and return the path of the file."""
    path = folder / FILE_NAME
    write_atomically(path, (json.dumps(asdict(plan), indent=1) + "\n").encode())
    return path


def read(path: Path) -> Plan:
    """Read the plan of a sweep from its file.

    Raises:
        InputError: the file is not valid; the message names the file and the field.
    """
    return parse(Plan, parse_json(read_file(path, str(path), MAX_JSON), str(path)), str(path), MOST_RUNS)


def find(experiment: Path) -> list[Path]:
    """Return the paths of all sweep plans of an experiment, oldest first."""
    return sorted((experiment / FOLDER).glob(f"*/{FILE_NAME}"))


def forget(folder: Path) -> None:
    """Delete the plan in `folder`, and the folder, because not one of its runs began."""
    shutil.rmtree(folder, ignore_errors=True)
    with contextlib.suppress(OSError):  # other plans are there
        folder.parent.rmdir()


def write_ended(folder: Path, number: int, ended: Ended) -> None:
    """Write the outcome of run `number` of the sweep whose plan is in `folder`."""
    write_atomically(folder / ENDED / f"{number}.json", json.dumps(asdict(ended)).encode())


def read_ended(folder: Path) -> dict[int, Ended]:
    """Read the outcomes of the runs of the sweep whose plan is in `folder`, by run number; skip damaged files."""
    found = {}
    for path in (folder / ENDED).glob("*.json"):
        try:
            found[int(path.stem)] = parse(Ended, json.loads(read_file(path, str(path), MAX_JSON)), str(path))
        except ValueError:  # InputError too
            continue
    return found


def jobs(folder: Path) -> dict[int, str]:
    """Return the Slurm jobs of the sweep whose plan is in `folder`, by run number.

    A job has the name of a folder that submitit makes. A job array has a folder `<array>`, and a folder
    `<array>_<task>` for each task. A single run has one folder `<job>`.
    """
    names = [path.name for path in (folder / JOBS).glob("[0-9]*")]
    tasks = {int(name.partition("_")[2]): name for name in names if re.fullmatch(r"\d+_\d+", name)}
    single = [name for name in names if name.isdecimal()]
    return tasks or ({0: single[0]} if single else {})
