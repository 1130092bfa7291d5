"""Claim a run for this process before anything heavy is loaded, so that of equal commands one trains. Needs no torch.

The claim is the run's progress.json, made by a hard link, which of several processes on several hosts succeeds for one.
A claim whose process is gone is taken over; while one process does that, a lock of the system keeps the others of a
file system with locks out. The system drops the lock of a process that is killed, so nothing is left to clear away.
"""

import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from gsbench.errors import InputError
from gsbench.measure.atomic import create_atomically
from gsbench.run import progress
from gsbench.run.progress import Progress

LOCK = ".claim"
PATIENCE = 5.0  # seconds: who holds the lock for longer is suspended, and the link alone decides
ATTEMPTS = 100
NOTHING, DAMAGED = "nothing", "damaged"  # what may lie where a claim was looked for


def take(folder: Path, mine: Progress) -> Progress | None:
    """Claim the run in `folder`, which exists; return None, or the progress of the living process that has it.

    Raises:
        InputError: other processes claim and leave the run without end.
        OSError: the claim cannot be written.
    """
    path = folder / progress.FILE_NAME
    with _alone(folder):
        for _ in range(ATTEMPTS):
            other = _read(path)
            if isinstance(other, Progress) and not _may_be_taken(other, mine):
                return other
            if other is not NOTHING:
                path.unlink(missing_ok=True)  # a dead process left it, or it is damaged and says nothing
            if create_atomically(path, progress.encode(mine)):
                return None
    raise InputError(f"{path}: expected to claim the run, other processes do again and again: try later")


def release(folder: Path, mine: Progress) -> None:
    """Say that nobody is at the run in `folder` any more, unless another process has it now."""
    path = folder / progress.FILE_NAME
    try:
        with _alone(folder):
            other = _read(path)
            if isinstance(other, Progress) and _is_one(other, mine):
                path.unlink(missing_ok=True)
    except OSError:  # the folder is gone or cannot be written any more; the claim goes with its process
        return


def _read(path: Path) -> Progress | str:
    """Read a claim; NOTHING where there is none, DAMAGED where it cannot be read again and again.

    Without locks one may be made just after it was looked for, which is no damage.
    """
    for _ in range(3):
        try:
            return progress.read(path)
        except InputError:
            if not os.path.lexists(path):
                return NOTHING
    return DAMAGED


def _is_one(other: Progress, mine: Progress) -> bool:
    return (other.host, other.pid, other.born) == (mine.host, mine.pid, mine.born)


def _may_be_taken(other: Progress, mine: Progress) -> bool:
    """Tell whether the process of a claim is this one, is gone, or was put back into Slurm's queue when its node fell.

    A job that runs two equal commands on one node has two living processes, of which one is not the other's.
    """
    requeued = other.job is not None and other.job == mine.job and other.host != mine.host
    return _is_one(other, mine) or requeued or not progress.is_alive(other)


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Keep other processes out of a claim while this one is read and replaced, where the file system has locks."""
    path = folder / LOCK
    until = time.monotonic() + PATIENCE
    file: IO[bytes] | None = None
    try:
        while file is None and time.monotonic() < until:
            try:
                file = _locked(path)
            except BlockingIOError:
                time.sleep(0.01)
            except OSError:  # a file system without locks
                break
        yield
    finally:
        if file is not None:
            path.unlink(missing_ok=True)
            file.close()


def _locked(path: Path) -> IO[bytes] | None:
    """Open and lock `path`; None where its last holder has removed it meanwhile, so that others lock another file.

    Raises:
        BlockingIOError: another process holds it.
    """
    file = path.open("ab")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if os.fstat(file.fileno()).st_ino == path.stat().st_ino:
            return file
    except FileNotFoundError:
        pass
    except OSError:
        file.close()
        raise
    file.close()
    return None
