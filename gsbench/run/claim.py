"""Claim a run for this process before anything heavy is loaded, so that only one of equal commands trains.

The claim is the run's progress.json. It is created by a hard link, which succeeds for only one of several processes,
also across hosts. A claim whose process is gone is taken over. During that a system lock keeps other processes out,
where the file system has locks; the system drops the lock of a killed process. The module needs no torch.
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
PATIENCE = 5.0  # seconds to wait for the lock; a process that holds it longer is suspended, and the link decides
ATTEMPTS = 100
NOTHING, DAMAGED = "nothing", "damaged"  # results of reading a claim that is no progress file


def take(folder: Path, mine: Progress) -> Progress | None:
    """Claim the run in the existing `folder`; return None, or the progress of the live process that has the claim.

    Raises:
        InputError: other processes claim and release the run again and again.
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
    raise InputError(f"{path}: expected to claim the run, other processes claim it again and again: try later")


def release(folder: Path, mine: Progress) -> None:
    """Remove the claim of this process on the run in `folder`; a claim of another process stays."""
    path = folder / progress.FILE_NAME
    try:
        with _alone(folder):
            other = _read(path)
            if isinstance(other, Progress) and _is_one(other, mine):
                path.unlink(missing_ok=True)
    except OSError:  # the folder is gone or cannot be written any more; the claim goes with its process
        return


def _read(path: Path) -> Progress | str:
    """Read a claim; return NOTHING if there is none, DAMAGED if three attempts to read it fail.

    Without locks another process may create the claim during the first attempt, which is no damage.
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
    """Tell whether the process of a claim is this one, is gone, or was requeued by Slurm after its node failed.

    A Slurm job that runs two equal commands on one node has two live processes; each respects the other's claim.
    """
    requeued = other.job is not None and other.job == mine.job and other.host != mine.host
    return _is_one(other, mine) or requeued or not progress.is_alive(other)


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Lock a claim against other processes while the block reads and replaces it, where the file system has locks."""
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
    """Open and lock `path`; return None if its last holder has removed it meanwhile, as others lock another file.

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
