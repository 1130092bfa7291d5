"""Read the records and the progress files that runs left in a folder, without composing a Hydra config."""

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gsbench.errors import InputError, one_line
from gsbench.measure.record import FILE_NAME as RECORD
from gsbench.measure.record import MAX_FILE, PUBLISHED
from gsbench.reading import read_file
from gsbench.run import progress
from gsbench.run.progress import Progress
from gsbench.sweep.plan import Identity, identity


@dataclass(frozen=True)
class Outcome:
    """The outcome of a run, read from its record."""

    path: Path
    status: str  # as in the record; `failed` if the record is damaged
    reason: str | None
    psnr: float | None
    written: float  # unix seconds


@dataclass
class Traces:
    """The runs that left a record, a progress file, or the progress file of a run that a signal has stopped."""

    outcomes: dict[Identity, Outcome] = field(default_factory=dict)
    by_path: dict[Path, Outcome] = field(default_factory=dict)
    progress: dict[Identity, tuple[Path, Progress]] = field(default_factory=dict)
    stopped: dict[Identity, tuple[Path, Progress]] = field(default_factory=dict)


def read(folders: list[Path]) -> Traces:
    """Read all run records and progress files in some folders; of each kind, the newest file of a run counts."""
    found = Traces()
    for path in _files(folders):
        if path.name == RECORD:
            overrides, outcome = _outcome(path)
            of = identity(overrides) or (f"the run in {path.parent}",)  # an old record does not name its overrides
            found.by_path[path] = outcome
            if of not in found.outcomes or found.outcomes[of].written < outcome.written:
                found.outcomes[of] = outcome
        else:
            try:
                one = progress.read(path)
            except InputError:
                continue  # the run has just removed it, or it is damaged; then the run counts as lost
            of, kind = identity(one.overrides), found.stopped if path.name == progress.STOPPED else found.progress
            if of not in kind or kind[of][1].updated < one.updated:
                kind[of] = path, one
    return found


def _files(folders: list[Path]) -> Iterator[Path]:
    """Yield the paths of run records and progress files, except in hidden folders and in published results."""
    for folder in folders:
        for at, below, names in os.walk(folder):
            below[:] = sorted(name for name in below if not name.startswith(".") and name != PUBLISHED)
            for name in (RECORD, progress.FILE_NAME, progress.STOPPED):
                path = Path(at, name)
                if name in names and path.is_file():  # reading a pipe would block
                    yield path


def _outcome(path: Path) -> tuple[list[str], Outcome]:
    """Read the overrides and the outcome of a run from its record.

    This is much faster than reading and validating the whole record.
    """
    written = path.stat().st_mtime
    try:
        plain: Any = json.loads(read_file(path, str(path), MAX_FILE))
        status, reason, metrics = plain["status"], plain["reason"], plain["metrics"] or {}
        overrides = [str(one) for one in plain.get("overrides", [])]
        return overrides, Outcome(path, str(status), reason and str(reason), metrics.get("psnr"), written)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        return [], Outcome(path, "failed", f"{path} is damaged ({one_line(error)}): delete it", None, written)
