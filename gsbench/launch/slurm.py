"""Submit the runs of a sweep to Slurm as a job array (`+launch=slurm`), wait for its end, and ask for states of jobs.

The script of the array does its run by `python -m gsbench.launch job`, in a container image if `launch.container` names
one. Slurm signals a run before its time limit (USR2): the run saves a checkpoint and ends with the exit status STOPPED,
and the script, which is outside of the image, puts its job back into the queue.

A status asks Slurm too, so that this module imports neither Hydra nor torch.
"""

import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from gsbench.config import PATHS
from gsbench.errors import InputError, one_line, printable
from gsbench.launch import plan
from gsbench.launch.plan import Plan

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from gsbench.launch.command import RunConfig

SUBMITTING = 300  # time limit of sbatch, seconds; after it, jobs may run that no plan knows
POLL = 10.0  # seconds between two looks at Slurm's queue
STOPPED = 128 + signal.SIGUSR2  # exit status
SCRIPT = """\
#!/bin/bash
# Written by gsbench: each job of the array does the run of its number.
trap : USR2 TERM  # Slurm's signals are for the run, which saves a checkpoint
# Since Slurm 22.05 srun does not take the CPUs of its job over, and a step would be bound to one of them.
export SRUN_CPUS_PER_TASK=$SLURM_CPUS_PER_TASK OMP_NUM_THREADS=$SLURM_CPUS_PER_TASK
{setup}
srun --unbuffered {command} -P -u -m gsbench.launch job {folder} "$SLURM_ARRAY_TASK_ID"
status=$?
requeues={folder}/"$SLURM_ARRAY_TASK_ID.requeues"
touch "$requeues"
if [ $status -eq {stopped} ] && [ "$(wc -l < "$requeues")" -lt {requeues} ]; then
  date >> "$requeues"
  exec scontrol requeue "$SLURM_JOB_ID"
fi
exit $status
"""


def launch(configs: Sequence["RunConfig"], planned: Plan, folder: Path) -> None:
    """Submit the runs of the plan in `folder` as a job array, and wait until its last job has left the queue.

    Raises:
        InputError: this is no machine of a cluster, Slurm refuses the jobs, or the container image is missing.
    """
    if shutil.which("sbatch") is None:
        raise InputError(
            "+launch=slurm: expected a machine of a Slurm cluster, sbatch is not on PATH: use its login "
            "node, or +launch=parallel",
            docs="runs.md#slurm-from-a-login-node-to-the-table",
        )
    settings, script = configs[0].config.launch, folder / "job.sh"
    command = shlex.quote(sys.executable) if settings.container is None else in_container(configs, folder)
    script.write_text(
        SCRIPT.format(
            setup=settings.setup,
            command=command,
            folder=shlex.quote(str(folder)),
            stopped=STOPPED,
            requeues=settings.requeues,
        )
    )
    options = {
        "job-name": configs[0].config.experiment,
        "partition": settings.partition,
        "time": settings.minutes,
        "cpus-per-task": settings.cpus,
        "gpus-per-node": settings.gpus,
        "mem": settings.memory,
        "signal": f"USR2@{settings.signal_seconds}",
        "array": f"0-{len(configs) - 1}" + (f"%{settings.at_once}" if settings.at_once > 0 else ""),
        "output": plan.log_of(folder, "%a"),
        "open-mode": "append",
        "requeue": True,  # when its node fails
        **settings.sbatch,
    }
    flags = [
        f"--{name}" if value is True else f"--{name}={value}"
        for name, value in options.items()
        if value is not None and value is not False
    ]
    answer = ask("sbatch", "--parsable", *flags, str(script), seconds=SUBMITTING)
    if isinstance(answer, str) or answer.returncode:
        reason = answer if isinstance(answer, str) else answer.stderr
        raise InputError(f"Slurm refused the jobs: {printable(' '.join(reason.split()))}")
    job = (answer.stdout.split() or [""])[-1].partition(";")[0]  # lines of the cluster's own may come first
    if not job.isdigit():
        raise InputError(
            f"sbatch --parsable: expected the number of a job, got {printable(answer.stdout)!r:.80}: squeue lists jobs"
        )
    plan.write(replace(planned, job=job), folder)
    while (waiting := queue([job])).states or waiting.silent:
        time.sleep(POLL)


def in_container(configs: Sequence["RunConfig"], folder: Path) -> str:
    """Return the words of a shell that start Python in the container image, with the folders of the runs bound.

    The modules of the image come first (`python -P`): a checkout in the current folder has no kernels for the image.

    Raises:
        InputError: the image does not exist, or a folder cannot be bound.
    """
    settings = configs[0].config.launch
    image = Path(settings.container).absolute()
    if not image.exists():
        raise InputError(
            f"launch.container: expected an image, a file or folder that all nodes see, got '{image}', "
            "which does not exist: build one",
            docs="install.md#in-a-container",
        )
    config_dir = plan.read(folder / plan.FILE_NAME).config_dir
    paths = {os.getcwd(), *filter(None, (config_dir, os.environ.get("TORCH_HOME")))}
    paths |= {path for config in configs for path in _paths(config.config)}
    binds = sorted({os.path.abspath(path) for path in paths if os.path.exists(path)})
    for path in binds:
        if "," in path or ":" in path:
            raise InputError(
                f"launch.container: expected folders without ',' and ':', which part the folders that are "
                f"bound, got '{path}': rename it"
            )
    gpu = " --nv" if settings.gpus else ""
    bound = shlex.join(["--bind", ",".join(binds), "--pwd", os.getcwd(), str(image), "python3"])
    return f"{settings.container_command}{gpu} {bound}"


def _paths(config: "DictConfig") -> Iterator[str]:
    """Yield the files and folders that a config names, without those in a package (pkg://), which the image has."""
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    for key in PATHS:
        try:
            value = OmegaConf.select(config, key)
        except OmegaConfBaseException:  # it names a variable that only the node has, such as TMPDIR
            continue
        if value is not None and not value.startswith("pkg://"):
            yield value


ANSWERING = 30  # time limit of every other answer of Slurm, seconds


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
    # "Invalid job id": none of the jobs is known any more, so none is in the queue. Other errors are no answer.
    if answer.returncode and "Invalid job id" not in answer.stderr:
        return Queue({}, (answer.stderr.splitlines() or ["squeue failed without a message"])[-1])
    states = {}
    lines = [line for line in answer.stdout.splitlines() if line[:1].isdigit()]  # of jobs; not "CLUSTER: east"
    for job, task, state, *reasons in (line.split(maxsplit=3) for line in lines):
        reason = "".join(reasons)
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


def ask(*command: str, seconds: float = ANSWERING) -> subprocess.CompletedProcess[str] | str:
    """Run a Slurm command, and return its result or a text that says why there is none."""
    if shutil.which(command[0]) is None:
        return f"{command[0]} is not on this machine"
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=seconds, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        return one_line(error)
