"""Claim a run for this process, so that only one of several identical commands trains.

The claim is the file progress.json in the run's folder. It is created by a hard link, which succeeds in only one of
several processes, on one or more hosts. If the process of a claim has ended, another process may take the claim. A file
lock protects this step if the file system supports locks. The module does not import torch.
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
PATIENCE = 5.0  # seconds to wait for the lock; a process that holds it longer is suspended, so go on without
ATTEMPTS = 100
NOTHING, DAMAGED = "nothing", "damaged"  # results of reading a claim that is no progress file


def take(folder: Path, mine: Progress) -> Progress | None:
    """Claim the run in the existing `folder`; if another live process has claimed it, return that process's progress.

    Return None if the claim succeeds.

    Raises:
        InputError: other processes claim and release the run repeatedly.
        OSError: the claim cannot be written.
    """
    path = folder / progress.FILE_NAME
    with _alone(folder):
        for _ in range(ATTEMPTS):
            other = _read(path)
            if isinstance(other, Progress) and not _may_be_taken(other, mine):
                return other
            if other is not NOTHING:
                path.unlink(missing_ok=True)  # its process has ended, or the file is damaged
            if create_atomically(path, progress.encode(mine)):
                return None
    raise InputError(f"{path}: expected to claim the run, other processes claim it again and again: try later")


def release(folder: Path, mine: Progress) -> None:
    """Remove this process's claim on the run in `folder`; the claim of another process is kept."""
    path = folder / progress.FILE_NAME
    try:
        with _alone(folder):
            other = _read(path)
            if isinstance(other, Progress) and _is_one(other, mine):
                path.unlink(missing_ok=True)
    except OSError:  # the folder cannot be written any more; the claim expires with this process
        return


def _read(path: Path) -> Progress | str:
    """Read a claim; return NOTHING if there is none, or DAMAGED if three attempts to read it fail.

    Without file locks, another process may be writing the claim while it is read. Therefore one failure does not prove
    that the claim is damaged.
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
    """Return whether this process may take an existing claim.

    The process may take the claim if the claim is its own, if the process of the claim has ended, or if Slurm has
    requeued the job after a node failed. Two live processes of one Slurm job on one node respect each other's claims.
    """
    requeued = other.job is not None and other.job == mine.job and other.host != mine.host
    return _is_one(other, mine) or requeued or not progress.is_alive(other)


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Hold a file lock while the block reads and replaces a claim; skip the lock if the file system has none."""
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
    """Open and lock `path`; return None if the file was removed in the meantime, so that the caller must try again.

    Raises:
        BlockingIOError: another process holds the lock.
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
