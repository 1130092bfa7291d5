"""Report the progress of a run in progress.json, by which its process also claims the run, and in stopped.json.

Only one of several identical commands trains. progress.json is created by a hard link, which succeeds in only one of
several processes, on one or more hosts. If the process of a claim has ended, another process may take the claim: the
one that has created a file with a name of that claim, by a hard link too. So no file lock is needed, and clients of NFS
that see another's files late, or by a stale handle, do not take one run. The module does not import torch.
"""

import dataclasses
import errno
import hashlib
import os
import socket
import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from gsbench.errors import InputError
from gsbench.measure.atomic import create_atomically, write_atomically
from gsbench.measure.curve import Point
from gsbench.reading import as_json, parse, parse_json, read_json

FILE_NAME = "progress.json"
STOPPED = "stopped.json"  # the progress of a run that a signal stopped; its process is gone
EVERY = 5.0  # seconds between two writes
LARGEST = 1 << 20  # bytes
SILENT = 600.0  # seconds without a report after which a run on an unreachable host counts as lost
HEIR = ".claim"  # with a hash: the file of the process that removes a dead claim
ATTEMPTS, PAUSE = 100, 0.02  # attempts to claim, and seconds between two
READS = 3  # attempts to read a claim; without hard links it may be half written, on NFS its handle may be stale


@dataclass(frozen=True)
class Progress:
    """The progress of a run (step, seconds, PSNR), and the process that runs it."""

    overrides: list[str]  # the run's overrides, as in its record
    host: str = field(default_factory=socket.gethostname)
    pid: int = field(default_factory=os.getpid)
    born: int | None = field(default_factory=lambda: born(os.getpid()))
    job: str | None = field(default_factory=lambda: slurm_job())
    started: float = field(default_factory=time.time)  # Unix seconds
    updated: float = field(default_factory=time.time)  # Unix seconds
    step: int = 0
    steps: int = 0  # 0 while the run is claimed but does not train yet
    seconds: float = 0.0  # seconds of training so far
    psnr_val: float | None = None  # the latest one, dB


def write(folder: Path, progress: Progress) -> None:
    """Write progress.json in the folder of a run, atomically."""
    write_atomically(folder / FILE_NAME, as_json(progress).encode(), lasting=False)


class Reporter:
    """Writes progress.json during the training of a run, at most once per interval (`EVERY` seconds)."""

    def __init__(self, folder: Path, overrides: list[str], steps: int, done: int = 0, seconds: float = 0.0) -> None:
        """Report that the run in `folder` has started.

        Args:
            overrides: the run's overrides, as in its record.
            steps: the number of steps of the run; model=auto may train several candidates.
            done: the steps of candidates that were trained before.
            seconds: the seconds of these steps.
        """
        self.folder = folder
        self.done, self.seconds = done, seconds
        self.progress = Progress(overrides, step=done, steps=steps, seconds=seconds)
        write(folder, self.progress)
        self._written = time.monotonic()

    def is_due(self) -> bool:
        """Return whether the last report is EVERY seconds old; to compute one without need may wait for the GPU."""
        return time.monotonic() - self._written >= EVERY

    def __call__(self, step: int, seconds: float, last: Point | None) -> None:
        """Report the finished steps and the seconds of the present training, and the last point of its curve."""
        psnr = last.psnr_val if last else None
        self.progress = dataclasses.replace(
            self.progress, step=self.done + step, seconds=self.seconds + seconds, psnr_val=psnr, updated=time.time()
        )
        self._written = time.monotonic()
        with suppress(OSError):  # a full disk must not end the run here, but at its checkpoint or record
            write(self.folder, self.progress)


def read(path: Path) -> Progress:
    """Read a progress.json or stopped.json; an InputError says why it is invalid."""
    return read_json(Progress, path, LARGEST)


def is_alive(progress: Progress) -> bool:
    """Return whether the process of a run is still alive; on another host, whether its last report is recent."""
    if progress.host == socket.gethostname():
        return progress.born is not None and born(progress.pid) == progress.born
    return time.time() - progress.updated < SILENT


def born(pid: int) -> int | None:
    """Return the start time of a process on this machine in clock ticks since boot, or None if it does not exist.

    The start time distinguishes the process from a later one with the same id.
    """
    try:
        after_name = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()  # the name may have blanks
    except OSError:
        return None
    return None if after_name[0] == "Z" else int(after_name[19])  # field 22 of proc(5); a zombie has ended


def slurm_job() -> str | None:
    """Return the id of this process's Slurm job as squeue prints it (`12` or `12_3`), or None outside of Slurm."""
    array, task = os.environ.get("SLURM_ARRAY_JOB_ID"), os.environ.get("SLURM_ARRAY_TASK_ID")
    return f"{array}_{task}" if array and task else os.environ.get("SLURM_JOB_ID")


def take_claim(folder: Path, claim: Progress) -> Progress | None:
    """Claim the run in the existing `folder`, so that only one process trains it.

    Returns:
        The progress of the live process that has claimed it before; None if this process has it now.

    Raises:
        InputError: other processes claim and release the run repeatedly.
        OSError: the claim cannot be read or written.
    """
    path = folder / FILE_NAME
    for _ in range(ATTEMPTS):
        content, other = _read(path)
        if other is not None and not _may_be_taken(other, claim):
            return other
        if content is not None:
            _remove(path, content, claim)  # its process has ended, or the file is damaged
        if create_atomically(path, as_json(claim).encode()):
            return None
        time.sleep(PAUSE)
    raise InputError(f"{path}: expected to claim the run, other processes claim it again and again: try later")


def _remove(path: Path, content: bytes, claim: Progress) -> None:
    """Remove the claim with this content, unless another process does so or has done so.

    Only the process whose progress is in the file `heir` removes the claim, and only if the claim is still the one that
    was read. An heir that was killed leaves this file. It is a claim too, and is removed in the same way.
    """
    heir = path.with_name(f"{HEIR}.{hashlib.sha256(content).hexdigest()[:16]}")
    if not create_atomically(heir, as_json(claim).encode()):
        left, other = _read(heir)
        if left is not None and (other is None or _may_be_taken(other, claim)):
            _remove(heir, left, claim)
        return
    try:
        if _content(path) == content:
            path.unlink(missing_ok=True)
    finally:
        heir.unlink(missing_ok=True)


def release_claim(folder: Path, claim: Progress, *, is_stopped: bool = False) -> None:
    """Remove this process's claim on the run in `folder`, so that another may take it; one of another process is kept.

    If a signal has stopped the run, its progress becomes stopped.json.
    """
    path = folder / FILE_NAME
    with suppress(OSError):  # the folder cannot be written any more; the claim expires with this process
        _, other = _read(path)
        if other is not None and _is_same_process(other, claim):
            if is_stopped:
                stopped = dataclasses.replace(other, updated=time.time())
                write_atomically(folder / STOPPED, as_json(stopped).encode(), lasting=False)
            path.unlink(missing_ok=True)


def _read(path: Path) -> tuple[bytes | None, Progress | None]:
    """Read a claim: its content, None if there is none, and its progress, None if the claim is damaged or missing.

    Raises:
        OSError: it cannot be read, which does not make it a damaged one.
    """
    content = None
    for attempt in range(1, READS + 1):
        try:
            content = _content(path)
            return content, None if content is None else parse(Progress, parse_json(content, str(path)), str(path))
        except InputError:
            time.sleep(PAUSE)
        except OSError as error:
            if error.errno != errno.ESTALE or attempt == READS:
                raise
            time.sleep(PAUSE)
    return content, None


def _content(path: Path) -> bytes | None:
    """Return the bytes of a claim, or None if there is none."""
    try:
        with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK), "rb") as file:  # a pipe would be waited for
            return file.read(LARGEST)
    except FileNotFoundError:
        return None


def _is_same_process(other: Progress, claim: Progress) -> bool:
    return (other.host, other.pid, other.born) == (claim.host, claim.pid, claim.born)


def _may_be_taken(other: Progress, claim: Progress) -> bool:
    """Return whether this process may take an existing claim.

    The process may take the claim if the claim is its own, if the process of the claim has ended, or if Slurm has
    requeued the job after a node failed. Two live processes of one Slurm job on one node respect each other's claims.
    """
    requeued = other.job is not None and other.job == claim.job and other.host != claim.host
    return _is_same_process(other, claim) or requeued or not is_alive(other)
