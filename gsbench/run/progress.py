"""Report the progress of a run to other processes in a file progress.json, and in stopped.json where it was stopped.

The module does not import torch.
"""

import dataclasses
import json
import os
import socket
import time
from dataclasses import dataclass, field
from pathlib import Path

from gsbench.measure.atomic import write_atomically
from gsbench.measure.curve import Point
from gsbench.measure.schema import parse
from gsbench.reading import parse_json, read_file

FILE_NAME = "progress.json"
STOPPED = "stopped.json"  # the progress of a run that a signal stopped; its process is gone
EVERY = 5.0  # seconds between two writes
LARGEST = 1 << 20  # bytes
SILENT = 600.0  # seconds without a report after which a run on an unreachable host counts as lost


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
    write_atomically(folder / FILE_NAME, encode(progress), lasting=False)


def encode(progress: Progress) -> bytes:
    """Return a progress as JSON."""
    return json.dumps(dataclasses.asdict(progress), indent=1, allow_nan=False).encode()


class Reporter:
    """Writes progress.json during the training of a run, at most once per interval (`EVERY` seconds)."""

    def __init__(self, folder: Path, overrides: list[str], steps: int, done: int = 0, seconds: float = 0.0) -> None:
        """Report that the run in `folder` has started.

        Args:
            folder: the folder of the run.
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
        """Return whether the interval since the last report (`EVERY` seconds) is over.

        The caller asks first, because computing a report may wait for the GPU.
        """
        return time.monotonic() - self._written >= EVERY

    def __call__(self, step: int, seconds: float, last: Point | None) -> None:
        """Report the finished steps and the seconds of the present training, and the last point of its curve."""
        psnr = last.psnr_val if last else None
        self.progress = dataclasses.replace(
            self.progress, step=self.done + step, seconds=self.seconds + seconds, psnr_val=psnr, updated=time.time()
        )
        self._written = time.monotonic()
        try:
            write(self.folder, self.progress)
        except OSError:  # a full disk must not end the run here, but at its checkpoint or record
            return


def write_stopped(folder: Path, progress: Progress) -> None:
    """Write stopped.json in the folder of a run that a signal has stopped, atomically."""
    stopped = dataclasses.replace(progress, updated=time.time())
    write_atomically(folder / STOPPED, encode(stopped), lasting=False)


def read(path: Path) -> Progress:
    """Read a progress.json or stopped.json.

    Raises:
        InputError: the file is invalid.
    """
    return decode(read_file(path, str(path), LARGEST), str(path))


def decode(content: bytes, where: str) -> Progress:
    """Return the progress in the content of a progress.json; `where` is its path, for the message.

    Raises:
        InputError: the content is invalid.
    """
    return parse(Progress, parse_json(content, where), where)


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
        after_name = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
    return None if after_name[0] == "Z" else int(after_name[19])  # field 22 of proc(5); a zombie has ended


def slurm_job() -> str | None:
    """Return the id of this process's Slurm job as squeue prints it (`12` or `12_3`), or None outside of Slurm."""
    array, task = os.environ.get("SLURM_ARRAY_JOB_ID"), os.environ.get("SLURM_ARRAY_TASK_ID")
    return f"{array}_{task}" if array and task else os.environ.get("SLURM_JOB_ID")
