"""Claim a run for this process, so that only one of several identical commands trains.

The claim is the file progress.json in the run's folder. It is created by a hard link, which succeeds in only one of
several processes, on one or more hosts. If the process of a claim has ended, another process may take the claim: the
one that has created a file with a name of that claim, by a hard link too. So no file lock is needed, and clients of NFS
that see another's files late, or by a stale handle, do not take one run. Where the file system has file locks but no
hard links, such as FAT, a lock protects these steps. The module does not import torch.
"""

import errno
import fcntl
import hashlib
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
ATTEMPTS, PAUSE = 100, 0.02  # attempts to claim, and seconds between two
READS = 3  # attempts to read a claim; without hard links it may be half written, on NFS its handle may be stale


def take(folder: Path, claim: Progress) -> Progress | None:
    """Claim the run in the existing `folder`; if another live process has claimed it, return that process's progress.

    Return None if the claim succeeds.

    Raises:
        InputError: other processes claim and release the run repeatedly.
        OSError: the claim cannot be read or written.
    """
    path = folder / progress.FILE_NAME
    with _alone(folder):
        for _ in range(ATTEMPTS):
            content, other = _read(path)
            if other is not None and not _may_be_taken(other, claim):
                return other
            if content is not None:
                _remove(path, content, claim)  # its process has ended, or the file is damaged
            if create_atomically(path, progress.encode(claim)):
                return None
            time.sleep(PAUSE)
    raise InputError(f"{path}: expected to claim the run, other processes claim it again and again: try later")


def _remove(path: Path, content: bytes, claim: Progress) -> None:
    """Remove the claim with this content, unless another process does so or has done so.

    Only the process whose progress is in the file `heir` removes the claim, and only if the claim is still the one that
    was read. An heir that was killed leaves this file. It is a claim too, and is removed in the same way.
    """
    heir = path.with_name(f"{LOCK}.{hashlib.sha256(content).hexdigest()[:16]}")
    if not create_atomically(heir, progress.encode(claim)):
        left, other = _read(heir)
        if left is not None and (other is None or _may_be_taken(other, claim)):
            _remove(heir, left, claim)
        return
    try:
        if _content(path) == content:
            path.unlink(missing_ok=True)
    finally:
        heir.unlink(missing_ok=True)


def release(folder: Path, claim: Progress, *, is_stopped: bool = False) -> None:
    """Remove this process's claim on the run in `folder`; the claim of another process is kept.

    If a signal has stopped the run, its progress becomes stopped.json.
    """
    path = folder / progress.FILE_NAME
    try:
        with _alone(folder):
            _, other = _read(path)
            if other is not None and _is_one(other, claim):
                if is_stopped:
                    progress.write_stopped(folder, other)
                path.unlink(missing_ok=True)
    except OSError:  # the folder cannot be written any more; the claim expires with this process
        return


def _read(path: Path) -> tuple[bytes | None, Progress | None]:
    """Read a claim: its content, None if there is none, and its progress, None if the claim is damaged or missing."""
    for _ in range(READS):
        content = _content(path)
        if content is None:
            break
        try:
            return content, progress.decode(content, str(path))
        except InputError:
            time.sleep(PAUSE)
    return content, None


def _content(path: Path) -> bytes | None:
    """Return the bytes of a claim, or None if there is none.

    Raises:
        OSError: it cannot be read, which does not make it a damaged one.
    """
    for last in (*[False] * (READS - 1), True):
        try:
            with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK), "rb") as file:  # a pipe would be waited for
                return file.read(progress.LARGEST)
        except FileNotFoundError:
            return None
        except OSError as error:
            if error.errno != errno.ESTALE or last:
                raise
            time.sleep(PAUSE)
    raise AssertionError("the last attempt returns or raises")


def _is_one(other: Progress, claim: Progress) -> bool:
    return (other.host, other.pid, other.born) == (claim.host, claim.pid, claim.born)


def _may_be_taken(other: Progress, claim: Progress) -> bool:
    """Return whether this process may take an existing claim.

    The process may take the claim if the claim is its own, if the process of the claim has ended, or if Slurm has
    requeued the job after a node failed. Two live processes of one Slurm job on one node respect each other's claims.
    """
    requeued = other.job is not None and other.job == claim.job and other.host != claim.host
    return _is_one(other, claim) or requeued or not progress.is_alive(other)


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
