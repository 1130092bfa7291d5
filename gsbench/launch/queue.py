"""Ask Slurm for the states of the jobs in its queue, and for the outcomes of jobs that have left the queue."""

import shutil
import subprocess
from collections.abc import Iterable
from dataclasses import dataclass

from gsbench.errors import one_line

SECONDS = 30  # time limit for an answer of Slurm


@dataclass(frozen=True)
class Queue:
    """The states of the jobs in Slurm's queue, with the job's name `<array>_<task>` as key.

    `silent` is the reason why Slurm did not answer, or None.
    """

    states: dict[str, str]  # the state and, for a pending job, the reason
    silent: str | None = None


def queue(jobs: Iterable[str]) -> Queue:
    """Return the states of `jobs` from one call of Slurm's squeue; without jobs, squeue is not called."""
    arrays = sorted({job.partition("_")[0] for job in jobs})
    if not arrays:
        return Queue({})
    answer = ask("squeue", "--noheader", "--array", "--jobs", ",".join(arrays), "--format=%F %K %T %r")
    if isinstance(answer, str):
        return Queue({}, answer)
    if answer.returncode and "Invalid job id" not in answer.stderr:  # none of the jobs is known any more
        return Queue({}, (answer.stderr.splitlines() or ["squeue failed without a message"])[-1])
    states = {}
    for line in answer.stdout.splitlines():
        job, task, state, reason = line.split(maxsplit=3)
        states[job if task == "N/A" else f"{job}_{task}"] = f"{state} {reason}" if state == "PENDING" else state
    return Queue(states)


def endings(jobs: Iterable[str]) -> dict[str, str]:
    """Return how jobs ended, such as `OUT_OF_MEMORY` or `FAILED, exit 9:0`, from one call of Slurm's sacct.

    The result is empty if Slurm keeps no accounts of jobs or does not answer.
    """
    wanted = set(jobs)
    arrays = ",".join(sorted({job.partition("_")[0] for job in wanted}))
    if not arrays:
        return {}
    answer = ask("sacct", "--noheader", "--parsable2", "--jobs", arrays, "--format=JobID,State,ExitCode")
    if isinstance(answer, str) or answer.returncode:
        return {}
    ends: dict[str, str] = {}
    for line in answer.stdout.splitlines():
        name, state, code = line.split("|")
        job, _, step = name.partition(".")
        if job in wanted and (not step or state == "OUT_OF_MEMORY"):  # only a job's step reports lack of memory
            ends[job] = state if state == "OUT_OF_MEMORY" or code == "0:0" else f"{state}, exit {code}"
    return ends


def ask(*command: str, seconds: float = SECONDS) -> subprocess.CompletedProcess[str] | str:
    """Run a Slurm command, and return its result or a text that says why there is none."""
    if shutil.which(command[0]) is None:
        return f"{command[0]} is not on this machine"
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=seconds, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        return one_line(error)
