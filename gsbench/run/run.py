"""Run one training and its measurement, and write a record even if an error ends the run."""

import gc
import sys
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from omegaconf import DictConfig

from gsbench.errors import InputError, one_line, printable
from gsbench.gates import messages
from gsbench.measure import record as records
from gsbench.measure.atomic import remove_leftovers
from gsbench.measure.curve import FALL, Curve
from gsbench.measure.exact_views import sentence
from gsbench.measure.record import Record
from gsbench.process.memory import is_out_of_memory
from gsbench.run import claim, progress, trackers
from gsbench.run.attempt import Attempt
from gsbench.run.checks import check_folder
from gsbench.run.finished import STALE, finished, where
from gsbench.run.identity import Run, identify
from gsbench.run.progress import Progress
from gsbench.run.stop import Stopped
from gsbench.train.divergence import DivergedError, explain

TRACEBACK = "traceback.txt"
SPARE = 1 << 25  # bytes reserved, so that a run which ends without memory can still write its record


class UnrecordedError(InputError):
    """A run ended, and its record cannot be written."""


def run(composed: DictConfig, choices: Mapping[str, str] | None = None, overrides: Sequence[str] = ()) -> Record | None:
    """Train and measure the model of a composed config on one scene, or keep the record of an earlier run.

    Args:
        composed: the config of one scene, as Hydra composed it.
        choices: the choice of each config group, for the run's name; see `identify`.
        overrides: the overrides of the command line, for the record.

    Returns:
        The record, which is also on disk, even if the run failed. None if another process does this run.

    Raises:
        InputError: a name is not a valid folder name, the run's folder cannot be written, or `log` is not known or
            not installed.
        UnrecordedError: the record cannot be written.
        Stopped: a signal asked the process to end; the checkpoint is saved.
    """
    this = identify(composed, choices, overrides)
    check_folder(this.folder)
    trackers.check(this.config.log)
    process, attempt, record = Progress(this.overrides), Attempt(this), None
    try:
        if not _is_claimed(this, process):
            return None
        (this.folder / progress.STOPPED).unlink(missing_ok=True)
        remove_leftovers(this.folder)
        record = _done(attempt)
    except Stopped:
        claim.release(this.folder, process, is_stopped=True)
        raise
    finally:
        claim.release(this.folder, process)
        if attempt.log is not None:
            attempt.log.end(record)
    return record


def _is_claimed(this: Run, process: Progress) -> bool:
    """Claim a run for this process; if another process does the run, print a message and return False.

    Raises:
        InputError: the claim cannot be written.
    """
    try:
        other = claim.take(this.folder, process)
    except OSError as error:
        raise InputError(f"{this.folder}: the run cannot be claimed: {one_line(error)}") from None
    if other is not None:
        whose = f"process {other.pid} on {printable(other.host)}"
        print(f"{this.name}: left to {whose}, which is at step {other.step} of it", file=sys.stderr)
    return other is None


def _done(attempt: Attempt) -> Record:
    """Train and measure a run that this process has claimed, or keep the record of an earlier run."""
    this, spare = attempt.this, [bytearray(SPARE)]
    try:
        model, scene = attempt.prepare()
        kept = finished(this, scene)
        record = kept or attempt.measure(attempt.fit(model, scene))
    except Exception as error:
        spare.clear()
        kept, record = None, _ended_badly(attempt, error)
    if kept is not None:
        print(f"{this.name}: finished before, kept: {summary(kept)}; measured {where(this, kept)}; "
              f"{this.folder / records.FILE_NAME}")  # fmt: skip
        return kept
    try:
        write(record, this.folder)
    except OSError as error:  # the sweep continues with its other runs; the checkpoint of this run is unchanged
        raise UnrecordedError(f"{summary(record)}; its record cannot be written: {error.strerror}") from None
    for line in messages.lines(record.on_demand) if record.on_demand else []:
        print(f"{this.name}: {line}")
    ended = summary(record) if record.status == "ok" else record.status  # the caller prints the reason
    print(f"{this.name}: {ended}; {this.folder / records.FILE_NAME}")
    try:
        attempt.draw()
    except Exception as error:  # the record is written, so an error in the pictures must not end the sweep
        print(f"{this.name}: no pictures: {one_line(error)}", file=sys.stderr)
    return record


def _ended_badly(attempt: Attempt, error: Exception) -> Record:
    """Return the record of a run that an error has ended.

    Raises:
        InputError: the model is unknown, so that the run has no place in a table.
    """
    is_diverged = isinstance(error, DivergedError)
    if is_out_of_memory(error):
        error.__traceback__ = None  # the frames of the traceback keep the large objects alive
        gc.collect()
    reason = one_line(error) if is_diverged else reason_of(error, attempt.this.folder)
    if is_diverged and attempt.model is not None and len(attempt.model):
        try:
            reason = f"{reason}; {explain(attempt.model)}"
        except Exception as unexplained:  # an error in the explanation must not hide that the run diverged
            reason = f"{reason}; it cannot be explained: {one_line(unexplained)}"
    return attempt.describe("diverged" if is_diverged else "failed", reason)


def reason_of(error: Exception, folder: Path) -> str:
    """Return in one line why a run failed; the stack trace of an unexpected error is written to `folder`."""
    text = one_line(error)
    if is_out_of_memory(error):
        return f"out of memory: {text}"
    if isinstance(error, OSError):
        return f"{error.filename or folder}: {error.strerror or text}"
    if isinstance(error, InputError):
        return text
    path = folder / TRACEBACK
    path.write_text("".join(traceback.format_exception(error)))
    return f"an error that gsbench did not foresee, {type(error).__name__}: {text}; please report it, with {path}"


def write(record: Record, folder: Path) -> None:
    """Write the record of a run; if the run failed, keep the record of an earlier success as record.stale.json."""
    path, stale = folder / records.FILE_NAME, folder / STALE
    if record.status == "ok":
        records.write(record, path)
        stale.unlink(missing_ok=True)
        return
    try:
        if records.read(path).status == "ok":
            path.replace(stale)
    except InputError:
        pass  # no record, or a damaged one
    if stale.exists():
        record = replace(record, reason=f"{record.reason} (what an earlier run measured is kept in {STALE})")
    records.write(record, path)


def summary(record: Record) -> str:
    """Return a record in one line: PSNR, size and speed, or the reason for a failure.

    It also names views that are rendered exactly, and says whether PSNR on val fell.
    """
    if record.metrics is None or record.cost is None:
        return f"{record.status}: {record.reason}"
    psnr, choice = record.metrics["psnr"], record.length_choice
    kept = f"{choice.kept} iterations kept, " if choice else ""
    exact = f". {printable(sentence(record.exact))}" if record.exact else ""
    return (
        f"PSNR {'-' if psnr is None else format(psnr, '.2f')} dB, {record.cost.num_gaussians} Gaussians, {kept}"
        f"trained in {record.cost.train_s:.0f} s, {record.cost.fps:.0f} FPS{exact}{too_long(record)}"
    )


def too_long(record: Record) -> str:
    """Return a sentence if PSNR on val was more than FALL dB higher before the end of the training, otherwise ""."""
    curve = Curve(record.curve)
    if record.stop is not None or record.length_choice is not None or curve.best is None or curve.fall <= FALL:
        return ""
    return (f". PSNR on val was {curve.fall:.2f} dB higher at iteration {curve.best.iteration}: a shorter training may "
            f"be better (docs/runs.md#how-a-run-ends)")  # fmt: skip
