"""Determine the state of every run of an experiment, from its plans, the files of its runs and Slurm's queue."""

import os
import re
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

from gsbench.errors import InputError
from gsbench.launch import plan
from gsbench.launch.plan import Ended, Identity, Plan, identity
from gsbench.launch.slurm import Queue, endings, queue
from gsbench.measure.record import CHECKPOINT, PUBLISHED
from gsbench.measure.record import FILE_NAME as RECORD
from gsbench.report import plausible
from gsbench.run import progress
from gsbench.run.progress import SILENT, Progress, is_alive

STATES = ("done", "running", "queued", "planned", "stopped", "not started", "failed", "lost")
GOING = ("running", "queued", "planned")
BROKEN = ("stopped", "not started", "failed", "lost")  # `retry` launches these again
DAMAGED = "the run in"  # stands, before its folder, for the overrides of a run with a damaged record
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
    train_s: float | None = None  # seconds of training of a run that is done


@dataclass(frozen=True)
class PlannedRun:
    """A run of a sweep, from the newest plan that lists it."""

    overrides: list[str]  # all of them, also those of the launch
    plan: Plan
    folder: Path  # of the plan
    number: int  # the run's place in the plan
    ended: Ended | None

    @property
    def job(self) -> str | None:
        """The run's job as Slurm's queue names it."""
        return self.plan.job and f"{self.plan.job}_{self.number}"


@dataclass(frozen=True)
class RecordStatus:
    """The outcome of a run, read from its record."""

    path: Path
    status: str  # as in the record; `failed` if the record is damaged
    reason: str | None
    psnr: float | None
    written: float  # Unix seconds
    train_s: float | None = None


@dataclass
class Experiment:
    """The plans of an experiment's sweeps, the files of its runs and Slurm's queue, all read at one time.

    Of the records and of the progress files of a run, the newest counts.
    """

    folder: Path
    planned: dict[Identity, PlannedRun] = field(default_factory=dict)
    records: dict[Identity, RecordStatus] = field(default_factory=dict)
    records_by_path: dict[Path, RecordStatus] = field(default_factory=dict)
    progress: dict[Identity, tuple[Path, Progress]] = field(default_factory=dict)
    stopped: dict[Identity, tuple[Path, Progress]] = field(default_factory=dict)  # a signal stopped the run
    queue: Queue = field(default_factory=lambda: Queue({}))
    damaged: list[str] = field(default_factory=list)  # why plans cannot be read


def read(folder: Path) -> Experiment:
    """Read the plans and the run files of an experiment, and ask Slurm once for the jobs that they name."""
    experiment = Experiment(folder)
    for path in plan.find(folder):
        try:
            planned = plan.read(path)
        except InputError as error:
            experiment.damaged.append(str(error))
            continue
        ended = plan.read_ended(path.parent)
        for run_number, overrides in enumerate(planned.runs):
            run = PlannedRun(overrides, planned, path.parent, run_number, ended.get(run_number))
            experiment.planned[identity(overrides)] = run
    # An experiment may have parts in other folders: +exp=tuning +trial=fast writes to results/tuning.fast.
    for results_folder in (folder, *sorted(folder.parent.glob(f"{folder.name}.*"))):
        _read_runs(results_folder, experiment)
    finished = {run for run, record in experiment.records.items() if record.status == "ok"}
    jobs = {run.job for key, run in experiment.planned.items() if run.job and key not in finished}
    experiment.queue = queue(jobs | {at.job for _, at in experiment.progress.values() if at.job})
    return experiment


def status(experiment: Experiment) -> list[RunStatus]:
    """Return the state of every run of a sweep, and of every other run that left a file."""
    runs = dict.fromkeys((*experiment.planned, *experiment.records, *experiment.progress, *experiment.stopped))
    judged = {run: _judge(experiment, run) for run in runs}
    # A planned run may have a record with other overrides, under which it was found too: it is counted once.
    counted = {state.record for run, state in judged.items() if run in experiment.planned and state.record}
    judged = {run: state for run, state in judged.items() if run in experiment.planned or state.record not in counted}
    ends = endings(state.job for state in judged.values() if state.state == "lost" and state.job)
    return [_explained(experiment, run, state, ends) for run, state in judged.items()]


def _judge(experiment: Experiment, run: Identity) -> RunStatus:
    """Determine the state of a run from its progress file (`report`), record, job and plan, which may contradict.

    The first of these that exists decides: its live process, its record, its job in Slurm's queue, and a command that
    can still start the run. Otherwise the run was stopped, has failed, is lost or has not started.
    """
    planned = experiment.planned.get(run)
    path, report = experiment.progress.get(run, (None, None))
    _, stopped = experiment.stopped.get(run, (None, None))
    record = experiment.records.get(run) or _kept(experiment, planned)
    if record and report and report.updated <= record.written:
        report = None  # the progress file is older than the record
    went_on = report and stopped and stopped.updated <= report.updated
    if stopped and (went_on or (record and stopped.started <= record.written)):
        stopped = None  # or it was stopped when its record was written already
    state = RunStatus(list(run), "not started")
    if report and (alive := _state_if_alive(report, experiment.queue)):
        left = report.seconds / report.step * (report.steps - report.step) if report.step else None
        waits = alive.partition(" ")[2] if alive.startswith("PENDING") else None
        going = _with_progress(state, report, "running" if waits is None else "queued", waits)
        return replace(going, seconds_left=left)
    if record and record.status == "ok" and not report and not stopped:
        return replace(state, state="done", psnr=record.psnr, record=str(record.path), train_s=record.train_s)
    if planned and planned.job in experiment.queue.states:
        in_queue = experiment.queue.states[planned.job]
        waits = in_queue.partition(" ")[2] if in_queue.startswith("PENDING") else None
        return replace(state, state="running" if waits is None else "queued", reason=waits or "starts", job=planned.job)
    last = max([record.written if record else 0.0, *(file.updated for file in (report, stopped) if file)])
    is_new = planned is not None and planned.ended is None and planned.plan.started > last
    if planned and is_new and _can_start(planned, experiment.queue):
        return replace(state, state="planned", job=planned.job)
    if stopped:
        return _with_progress(state, stopped, "stopped", f"stopped {_step(stopped)}: the same command continues")
    if record and not report:
        reason = record.reason if record.status == "failed" else f"{record.status}: {record.reason}"
        return replace(state, state="failed", reason=reason, record=str(record.path))
    if report:
        since = plan.duration(time.time() - report.updated)
        reason = f"process {report.pid} on {report.host} is gone, last seen {since} ago {_step(report)}"
        if path and path.with_name(CHECKPOINT).exists():
            reason += ": the same command continues from its last checkpoint"
        return _with_progress(state, report, "lost", reason)
    if planned and planned.ended and (planned.ended.reason or planned.ended.record):
        reason = planned.ended.reason or f"its record {planned.ended.record} is gone"
        return replace(state, state="failed", reason=reason, job=planned.job)
    return replace(state, state="lost", reason="never started", job=planned.job) if planned and planned.job else state


def _with_progress(state: RunStatus, report: Progress, name: str, reason: str | None) -> RunStatus:
    return replace(
        state, state=name, reason=reason, job=report.job, step=report.step, steps=report.steps, psnr=report.psnr_val
    )


def _step(report: Progress) -> str:
    return f"at step {report.step} of {report.steps}" if report.steps else "before its first step"


def _kept(experiment: Experiment, planned: PlannedRun | None) -> RecordStatus | None:
    """Return the record of a planned run that was made with other overrides; the sweep stored its path."""
    if planned is None or planned.ended is None or planned.ended.record is None:
        return None
    return experiment.records_by_path.get(experiment.folder.parent / planned.ended.record)


def _state_if_alive(report: Progress, queue: Queue) -> str | None:
    """Return the state of a run that has a progress file: `RUNNING`, `PENDING` with a reason, or None if it ended.

    If Slurm does not answer, the age of the progress file decides.
    """
    if report.job is None:
        return "RUNNING" if is_alive(report) else None
    if queue.silent:
        return "RUNNING" if time.time() - report.updated < SILENT else None
    return queue.states.get(report.job)


def _can_start(run: PlannedRun, queue: Queue) -> bool:
    """Return whether the command that planned a run can still start it."""
    if run.job is not None:  # only Slurm can still start it
        return queue.silent is not None
    return is_alive(Progress([], run.plan.host, run.plan.pid, run.plan.born, updated=run.plan.started))


def _explained(experiment: Experiment, run: Identity, state: RunStatus, ends: dict[str, str]) -> RunStatus:
    """Add to a broken run without a record how its Slurm job ended, and the line of its log that says why."""
    if state.state not in BROKEN or state.job is None or state.record is not None:
        return state
    phrases = [state.reason or ""]
    if state.state == "lost":
        phrases.append(f"job {state.job} ended: {ends.get(state.job, 'Slurm no longer knows how')}")
    planned = experiment.planned.get(run)
    if planned and planned.job == state.job:
        log = plan.log_of(planned.folder, planned.number)
        phrases.append(f"its log ends: {cause_in(log)}; {log}")
    return replace(state, reason="; ".join(phrases))


def cause_in(log: Path) -> str:
    """Return the line of a log that best explains a failure: the last that names a cause, such as lack of memory.

    Else it is the last line that reports an error, or the last line. If the log reports only an exit code, it is the
    first other line, which the shell wrote.
    """
    if not log.is_file():  # reading a pipe would block
        return "(no log)"
    try:
        with log.open("rb") as file:
            file.seek(max(0, log.stat().st_size - 8192))
            lines = [line.strip() for line in file.read().decode(errors="replace").splitlines() if line.strip()]
    except OSError:
        return "(no log)"
    telling = [line for line in lines if not EFFECT.search(line)]
    errors = [match[0] for line in telling if (match := ERROR.search(line))]
    causes = [line for line in errors if CAUSE.search(line)]
    if not errors and len(telling) < len(lines):
        lines = (telling or lines)[:1]
    return (causes or errors or lines or ["(empty)"])[-1][:200]


def _read_runs(folder: Path, experiment: Experiment) -> None:
    """Read the records and the progress files of the runs in a folder, without composing a config."""
    for path in _files(folder):
        if path.name == RECORD:
            overrides, record = record_status(path)
            run = identity(overrides) or (f"{DAMAGED} {path.parent}",)
            experiment.records_by_path[path] = record
            if run not in experiment.records or experiment.records[run].written < record.written:
                experiment.records[run] = record
            continue
        try:
            report = progress.read(path)
        except InputError:
            continue  # the run has just removed it, or it is damaged; then the run counts as lost
        kind = experiment.stopped if path.name == progress.STOPPED else experiment.progress
        run = identity(report.overrides)
        if run not in kind or kind[run][1].updated < report.updated:
            kind[run] = path, report


def _files(folder: Path) -> Iterator[Path]:
    """Yield the paths of run records and progress files, except in hidden folders and in published results."""
    for parent, below, names in os.walk(folder):
        below[:] = sorted(name for name in below if not name.startswith(".") and name != PUBLISHED)
        for name in (RECORD, progress.FILE_NAME, progress.STOPPED):
            path = Path(parent, name)
            if name in names and path.is_file():  # reading a pipe would block
                yield path


def record_status(path: Path) -> tuple[list[str], RecordStatus]:
    """Read the overrides and the outcome of a run from its record, which is `failed` if it is damaged or was edited."""
    written = path.stat().st_mtime
    try:
        record = plausible.read(path)
    except InputError as error:
        return [], RecordStatus(path, "failed", f"delete its record, which is damaged: {error}", None, written)
    psnr, train_s = (record.metrics or {}).get("psnr"), record.cost.train_s if record.cost else None
    return record.overrides, RecordStatus(path, record.status, record.reason, psnr, written, train_s)
