"""Decide what became of every run of an experiment, by its plans, the traces of its runs and Slurm's queue."""

import re
import socket
import time
from dataclasses import dataclass, field
from pathlib import Path

from gsbench.run.progress import SILENT, Progress, born, is_alive
from gsbench.sweep import plan, slurm, traces
from gsbench.sweep.plan import JOBS, Ended, Identity, Plan, identity
from gsbench.sweep.slurm import Queue
from gsbench.sweep.traces import Outcome, Traces

STATES = ("done", "running", "queued", "planned", "failed", "lost")
GOING = ("running", "queued", "planned")
BROKEN = ("failed", "lost")
# Of a log's lines, those that name a cause, and those that speak of an error: a bar of progress may stand before it.
CAUSE = re.compile(r"exceeded.* memory|oom.kill|out of memory|no space left", re.IGNORECASE)
ERROR = re.compile(r"([\w.-]+: )*\w*error\b.*", re.IGNORECASE)
EFFECT = re.compile(r"\bexited with exit code|\bexit code \d+$", re.IGNORECASE)  # srun's, which names no cause


@dataclass(frozen=True)
class Run:
    """One run and what is known of it."""

    overrides: list[str]  # as in its record
    state: str  # one of STATES
    reason: str | None = None  # why it failed or is lost, or what it waits for
    job: str | None = None  # of Slurm
    step: int | None = None
    steps: int | None = None
    seconds_left: float | None = None
    psnr: float | None = None  # dB: on the evaluated split of a run that is done, else on val
    record: str | None = None


@dataclass
class Asked:
    """A run as the newest plan that names it asked for it."""

    overrides: list[str]  # all of them, as Hydra launches it
    plan: Plan
    folder: Path  # of the plan
    job: str | None
    ended: Ended | None


@dataclass
class Experiment:
    """The folder of an experiment as it was read."""

    folder: Path
    asked: dict[Identity, Asked] = field(default_factory=dict)
    traces: Traces = field(default_factory=Traces)
    queue: Queue = field(default_factory=lambda: Queue({}))


def read(folder: Path) -> Experiment:
    """Read the plans and traces of an experiment, and ask Slurm once for the jobs that they name."""
    # An experiment may name parts of itself, as +exp=tuning +trial=fast does: results/tuning.fast
    parts = [folder, *sorted(folder.parent.glob(f"{folder.name}.*"))]
    found = Experiment(folder)
    for path in plan.find(folder):
        whole, at = plan.read(path), path.parent
        ended, jobs_of = plan.read_ended(at), plan.jobs(at)
        for number, overrides in enumerate(whole.runs):
            found.asked[identity(overrides)] = Asked(overrides, whole, at, jobs_of.get(number), ended.get(number))
    found.traces = traces.read(parts)
    done = {one for one, outcome in found.traces.outcomes.items() if outcome.status == "ok"}
    jobs = {asked.job for one, asked in found.asked.items() if asked.job and one not in done}
    found.queue = slurm.queue(jobs | {one.job for _, one in found.traces.progress.values() if one.job})
    return found


def status(experiment: Experiment) -> list[Run]:
    """Judge every run that was asked for, and those that left a trace without a plan."""
    known = {**dict.fromkeys(experiment.asked), **dict.fromkeys(experiment.traces.outcomes),
             **dict.fromkeys(experiment.traces.progress)}  # fmt: skip
    judged = {one: _judge(experiment, one) for one in known}
    kept = {run.record for one, run in judged.items() if one in experiment.asked and run.record is not None}
    # A run that was asked for in other words than those in its record is not a second run.
    judged = {one: run for one, run in judged.items() if one in experiment.asked or run.record not in kept}
    lost = {run.job for run in judged.values() if run.state == "lost" and run.job}
    endings = slurm.endings(lost)
    return [_explained(experiment, one, run, endings) for one, run in judged.items()]


def _judge(experiment: Experiment, one: Identity) -> Run:
    """Judge a run by what is newest: a live process, then its record, then the queue, then the plan."""
    asked = experiment.asked.get(one)
    _, progress = experiment.traces.progress.get(one, (None, None))
    outcome = experiment.traces.outcomes.get(one) or _kept(experiment, asked)
    if outcome and progress and progress.updated <= outcome.written:
        progress = None  # left over from before the record
    if progress:
        alive = _alive(progress, experiment.queue)
        if alive:
            return _running(one, progress, alive)
    if outcome and outcome.status == "ok" and not progress:
        return Run(list(one), "done", psnr=outcome.psnr, record=str(outcome.path))
    if asked and asked.job in experiment.queue.states:
        state = experiment.queue.states[asked.job]
        waits = state.partition(" ")[2] if state.startswith("PENDING") else None
        return Run(list(one), "running" if waits is None else "queued", waits or "starts", asked.job)
    last = max(outcome.written if outcome else 0, progress.updated if progress else 0)
    if asked and asked.ended is None and asked.plan.started > last and _launching(asked, experiment.queue):
        return Run(list(one), "planned", job=asked.job)
    if outcome and not progress:
        reason = outcome.reason if outcome.status == "failed" else f"{outcome.status}: {outcome.reason}"
        return Run(list(one), "failed", reason, record=str(outcome.path))
    if progress:
        at = f"at step {progress.step} of {progress.steps}" if progress.steps else "before its first step"
        gone = f"process {progress.pid} on {progress.host} is gone, last seen {_ago(progress.updated)} {at}"
        return Run(list(one), "lost", gone, progress.job, progress.step, progress.steps, psnr=progress.psnr_val)
    if asked and asked.ended:
        return Run(list(one), "failed", asked.ended.reason or f"its record {asked.ended.record} is gone", asked.job)
    return Run(list(one), "lost", "never started", asked.job if asked else None)


def _kept(experiment: Experiment, asked: Asked | None) -> Outcome | None:
    """Find the record of a run that was kept as it was, with the overrides of the command that made it."""
    if asked is None or asked.ended is None or asked.ended.record is None:
        return None
    return experiment.traces.by_path.get(experiment.folder.parent / asked.ended.record)


def _alive(progress: Progress, queue: Queue) -> str | None:
    """Tell how a run with a progress file goes on: `RUNNING`, `PENDING` and what for; None where it does not."""
    if progress.job is None:
        return "RUNNING" if is_alive(progress) else None
    if queue.silent:
        return "RUNNING" if time.time() - progress.updated < SILENT else None
    return queue.states.get(progress.job)


def _running(one: Identity, progress: Progress, alive: str) -> Run:
    left = progress.seconds / progress.step * (progress.steps - progress.step) if progress.step else None
    waits = alive.partition(" ")[2] if alive.startswith("PENDING") else None
    return Run(
        list(one), "running" if waits is None else "queued", waits, progress.job, progress.step, progress.steps, left,
        progress.psnr_val,
    )  # fmt: skip


def _launching(asked: Asked, queue: Queue) -> bool:
    """Tell whether the command that asked for a run can still start it."""
    if asked.job is not None:  # it is Slurm's now
        return queue.silent is not None
    if asked.plan.host == socket.gethostname():
        return asked.plan.born is not None and born(asked.plan.pid) == asked.plan.born
    return time.time() - asked.plan.started < SILENT


def _explained(experiment: Experiment, one: Identity, run: Run, endings: dict[str, str]) -> Run:
    """Add to a lost run of Slurm how its job ended and the last line of its log."""
    if run.state != "lost" or run.job is None:
        return run
    parts = [run.reason or "", f"job {run.job} ended: {endings.get(run.job, 'Slurm no longer knows how')}"]
    asked = experiment.asked.get(one)
    if asked and asked.job == run.job:
        log = asked.folder / JOBS / run.job / f"{run.job}_0_log.err"
        parts.append(f"its log ends: {_told(log)}; {log}")
    return Run(**{**vars(run), "reason": "; ".join(parts)})


def _told(log: Path) -> str:
    """Return the last line of a log that names a cause, else that speaks of an error, else its last line.

    Of a log that only says by which code something ended, the first line: what a shell said before it.
    """
    if not log.is_file():  # a pipe would keep its reader waiting
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
