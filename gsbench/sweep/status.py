"""Determine the state of every run of an experiment, from its plans, the files of its runs and Slurm's queue."""

import re
import socket
import time
from dataclasses import dataclass, field
from pathlib import Path

from gsbench.measure.record import CHECKPOINT
from gsbench.run.progress import SILENT, Progress, born, is_alive
from gsbench.sweep import plan, slurm, traces
from gsbench.sweep.plan import JOBS, Ended, Identity, Plan, identity
from gsbench.sweep.slurm import Queue
from gsbench.sweep.traces import Outcome, Traces

STATES = ("done", "running", "queued", "planned", "stopped", "not started", "failed", "lost")
GOING = ("running", "queued", "planned")
BROKEN = ("stopped", "not started", "failed", "lost")  # `retry` launches these again
# Lines of a log that name a cause, and lines that report an error; a progress bar may precede the error on its line.
CAUSE = re.compile(r"exceeded.* memory|oom.kill|out of memory|no space left", re.IGNORECASE)
ERROR = re.compile(r"([\w.-]+: )*\w*error\b.*", re.IGNORECASE)
EFFECT = re.compile(r"\bexited with exit code|\bexit code \d+$", re.IGNORECASE)  # lines of srun that name no cause


@dataclass(frozen=True)
class RunStatus:
    """The state of a run, one of STATES, with details such as the reason."""

    overrides: list[str]  # as in its record
    state: str  # one of STATES
    reason: str | None = None  # why it failed, is lost or waits
    job: str | None = None  # of Slurm
    step: int | None = None
    steps: int | None = None
    seconds_left: float | None = None
    psnr: float | None = None  # dB: on the evaluated split of a run that is done, else on val
    record: str | None = None


@dataclass
class RequestedRun:
    """A run that a command requested, with the newest plan of a sweep that lists the run."""

    overrides: list[str]  # all of them, as Hydra launches it
    plan: Plan
    folder: Path  # of the plan
    job: str | None
    ended: Ended | None


@dataclass
class Experiment:
    """The plans of an experiment's sweeps, the files of its runs and Slurm's queue, all read at one time."""

    folder: Path
    requested: dict[Identity, RequestedRun] = field(default_factory=dict)
    traces: Traces = field(default_factory=Traces)
    queue: Queue = field(default_factory=lambda: Queue({}))


def read(folder: Path) -> Experiment:
    """Read the plans and the run files of an experiment, and ask Slurm once for the jobs that they name."""
    # An experiment may have parts in other folders: +exp=tuning +trial=fast writes to results/tuning.fast.
    parts = [folder, *sorted(folder.parent.glob(f"{folder.name}.*"))]
    found = Experiment(folder)
    for path in plan.find(folder):
        whole, at = plan.read(path), path.parent
        ended, jobs_of = plan.read_ended(at), plan.jobs(at)
        for number, overrides in enumerate(whole.runs):
            found.requested[identity(overrides)] = RequestedRun(
                overrides, whole, at, jobs_of.get(number), ended.get(number)
            )
    found.traces = traces.read(parts)
    done = {one for one, outcome in found.traces.outcomes.items() if outcome.status == "ok"}
    jobs = {run.job for one, run in found.requested.items() if run.job and one not in done}
    found.queue = slurm.queue(jobs | {one.job for _, one in found.traces.progress.values() if one.job})
    return found


def status(experiment: Experiment) -> list[RunStatus]:
    """Return the state of every run that a sweep requested, and of every other run that left a file."""
    known = {**dict.fromkeys(experiment.requested), **dict.fromkeys(experiment.traces.outcomes),
             **dict.fromkeys(experiment.traces.progress), **dict.fromkeys(experiment.traces.stopped)}  # fmt: skip
    judged = {one: _judge(experiment, one) for one in known}
    kept = {run.record for one, run in judged.items() if one in experiment.requested and run.record is not None}
    # A requested run may have a record with other overrides; such a record is not counted as a second run.
    judged = {one: run for one, run in judged.items() if one in experiment.requested or run.record not in kept}
    lost = {run.job for run in judged.values() if run.state == "lost" and run.job}
    endings = slurm.endings(lost)
    return [_explained(experiment, one, run, endings) for one, run in judged.items()]


def _judge(experiment: Experiment, one: Identity) -> RunStatus:
    """Determine the state of a run.

    The first of these that exists decides: its live process, its record, its job in Slurm's queue, and a command that
    can still start the run. Otherwise the run was stopped, has failed, is lost or has not started.
    """
    requested = experiment.requested.get(one)
    path, progress = experiment.traces.progress.get(one, (None, None))
    _, stopped = experiment.traces.stopped.get(one, (None, None))
    outcome = experiment.traces.outcomes.get(one) or _kept(experiment, requested)
    if outcome and progress and progress.updated <= outcome.written:
        progress = None  # the progress file is older than the record
    went_on = progress and stopped and stopped.updated <= progress.updated
    if stopped and (went_on or (outcome and stopped.started <= outcome.written)):
        stopped = None  # or it was stopped when its record was written already
    if progress:
        alive = _alive(progress, experiment.queue)
        if alive:
            return _running(one, progress, alive)
    if outcome and outcome.status == "ok" and not progress and not stopped:
        return RunStatus(list(one), "done", psnr=outcome.psnr, record=str(outcome.path))
    if requested and requested.job in experiment.queue.states:
        state = experiment.queue.states[requested.job]
        waits = state.partition(" ")[2] if state.startswith("PENDING") else None
        return RunStatus(list(one), "running" if waits is None else "queued", waits or "starts", requested.job)
    last = max(outcome.written if outcome else 0, *(at.updated for at in (progress, stopped) if at), 0)
    is_new = requested is not None and requested.ended is None and requested.plan.started > last
    if requested and is_new and _launching(requested, experiment.queue):
        return RunStatus(list(one), "planned", job=requested.job)
    if stopped:
        at = f"at step {stopped.step} of {stopped.steps}" if stopped.steps else "before its first step"
        return RunStatus(list(one), "stopped", f"stopped {at}: the same command continues", stopped.job, stopped.step,
                         stopped.steps, psnr=stopped.psnr_val)  # fmt: skip
    if outcome and not progress:
        reason = outcome.reason if outcome.status == "failed" else f"{outcome.status}: {outcome.reason}"
        return RunStatus(list(one), "failed", reason, record=str(outcome.path))
    if progress:
        at = f"at step {progress.step} of {progress.steps}" if progress.steps else "before its first step"
        gone = f"process {progress.pid} on {progress.host} is gone, last seen {_ago(progress.updated)} {at}"
        if path and path.with_name(CHECKPOINT).exists():
            gone += ": the same command continues from its last checkpoint"
        return RunStatus(list(one), "lost", gone, progress.job, progress.step, progress.steps, psnr=progress.psnr_val)
    if requested and requested.ended:
        return RunStatus(
            list(one), "failed", requested.ended.reason or f"its record {requested.ended.record} is gone", requested.job
        )
    if requested and requested.job:
        return RunStatus(list(one), "lost", "never started", requested.job)
    return RunStatus(list(one), "not started")


def _kept(experiment: Experiment, requested: RequestedRun | None) -> Outcome | None:
    """Return the outcome of a requested run whose record was made with other overrides; None if there is none.

    The sweep stored the path of this record when the run ended.
    """
    if requested is None or requested.ended is None or requested.ended.record is None:
        return None
    return experiment.traces.by_path.get(experiment.folder.parent / requested.ended.record)


def _alive(progress: Progress, queue: Queue) -> str | None:
    """Return the state of a run that has a progress file: `RUNNING`, `PENDING` with a reason, or None if it ended."""
    if progress.job is None:
        return "RUNNING" if is_alive(progress) else None
    if queue.silent:
        return "RUNNING" if time.time() - progress.updated < SILENT else None
    return queue.states.get(progress.job)


def _running(one: Identity, progress: Progress, alive: str) -> RunStatus:
    left = progress.seconds / progress.step * (progress.steps - progress.step) if progress.step else None
    waits = alive.partition(" ")[2] if alive.startswith("PENDING") else None
    return RunStatus(
        list(one), "running" if waits is None else "queued", waits, progress.job, progress.step, progress.steps, left,
        progress.psnr_val,
    )  # fmt: skip


def _launching(requested: RequestedRun, queue: Queue) -> bool:
    """Tell whether the command that requested a run can still start it."""
    if requested.job is not None:  # only Slurm can still start it
        return queue.silent is not None
    if requested.plan.host == socket.gethostname():
        return requested.plan.born is not None and born(requested.plan.pid) == requested.plan.born
    return time.time() - requested.plan.started < SILENT


def _explained(experiment: Experiment, one: Identity, run: RunStatus, endings: dict[str, str]) -> RunStatus:
    """Add the outcome of its Slurm job, and the log line that names the cause, to a failed or lost run.

    Other runs, and runs with a record, are returned unchanged.
    """
    if run.state not in BROKEN or run.job is None or run.record is not None:
        return run
    parts = [run.reason or ""]
    if run.state == "lost":
        parts.append(f"job {run.job} ended: {endings.get(run.job, 'Slurm no longer knows how')}")
    requested = experiment.requested.get(one)
    if requested and requested.job == run.job:
        log = requested.folder / JOBS / run.job / f"{run.job}_0_log.err"
        parts.append(f"its log ends: {_told(log)}; {log}")
    return RunStatus(**{**vars(run), "reason": "; ".join(parts)})


def _told(log: Path) -> str:
    """Return the line of a log that best explains a failure.

    This is the last line that names a cause, such as lack of memory. If there is none, it is the last line that reports
    an error, or else the last line. If the log reports only an exit code, it is the first other line, which the shell
    wrote.
    """
    if not log.is_file():  # reading a pipe would block
        return "(no log)"
    try:
        with log.open("rb") as file:
            file.seek(max(0, log.stat().st_size - 8192))
            lines = [line.strip() for line in file.read().decode(errors="replace").splitlines() if line.strip()]
    except OSError:
        return "(no log)"
    told = [line for line in lines if not EFFECT.search(line)]
    errors = [match[0] for line in told if (match := ERROR.search(line))]
    causes = [line for line in errors if CAUSE.search(line)]
    if not errors and len(told) < len(lines):
        lines = [*told[:1], *lines][:1]
    return (causes or errors or lines or ["(empty)"])[-1][:200]


def _ago(then: float) -> str:
    minutes = (time.time() - then) / 60
    return f"{60 * minutes:.0f} s ago" if minutes < 2 else f"{minutes:.0f} min ago"
