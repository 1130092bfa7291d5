"""Append the curve of a run to curve.jsonl while it trains, and send it to a tracker (config key `log`).

The packages of TensorBoard, Weights & Biases and MLflow are optional, and imported only by the run that names one. An
error of theirs ends no run.
"""

import contextlib
import importlib.util
import math
import os
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar

import msgspec

from gsbench.config_roles import flat
from gsbench.errors import InputError, check_known, how_to_install, one_line
from gsbench.measure.atomic import write_atomically
from gsbench.measure.curve import Point
from gsbench.measure.record import Record
from gsbench.reading import read_file
from gsbench.run.identity import RunSpec
from gsbench.train.loop import Trainer

FILE_NAME = "curve.jsonl"
LARGEST = 1 << 24  # bytes of curve.jsonl
ID_FILE = "tracker.txt"  # in the run's folder: the id that the tracker gave the run, so that a resumed run continues it
MOST_PARAMETERS = 100  # of MLflow, in one request
LONGEST_PARAMETER = 500  # letters, of MLflow
SECONDS = "10"  # that MLflow waits for a server
WANDB_SECONDS = 30.0  # that Weights & Biases waits for a server

# By the name of a number in a tracker, the key in a line of curve.jsonl.
SENT = {"val/psnr": "psnr_val", "train/loss": "loss", "train/seconds": "seconds", "train/gaussians": "gaussians"}

Numbers = Mapping[str, float]
T = TypeVar("T")


@dataclass(frozen=True)
class Line:
    """A line of curve.jsonl: a point of the curve, and what else is known of its iteration."""

    iteration: int
    seconds: float
    psnr_val: float | None  # dB
    loss: float | None = None
    gaussians: int | None = None

    @property
    def point(self) -> Point:
        """The point of the curve."""
        return Point(self.iteration, self.seconds, self.psnr_val)


class Tracker(Protocol):
    """A service that shows the numbers of runs."""

    def add(self, step: int, numbers: Numbers) -> None:
        """Send numbers that were measured after `step` steps."""

    def end(self, status: str) -> None:
        """Send what is left; `status` is that of the record, or "stopped"."""


class TensorBoard:
    """Writes event files into the folder `tensorboard` of the run; needs no server."""

    def __init__(self, spec: RunSpec, step: int) -> None:
        from torch.utils.tensorboard import SummaryWriter

        # Events of an earlier attempt after this step are hidden, as the run measures them again.
        self.writer: Any = SummaryWriter(str(spec.folder / "tensorboard"), purge_step=step + 1)
        lines = [f"    {key}: {value}" for key, value in flat(spec.plain)]
        self.writer.add_text("settings", "\n".join(lines), step)

    def add(self, step: int, numbers: Numbers) -> None:
        """Write numbers as scalars."""
        for name, value in numbers.items():
            self.writer.add_scalar(name, value, step)
        self.writer.flush()

    def end(self, status: str) -> None:
        """Close the event file."""
        self.writer.close()


class WeightsAndBiases:
    """Logs to the project `gsbench`; WANDB_MODE=offline writes into the folder `wandb` of the run instead."""

    def __init__(self, spec: RunSpec, step: int) -> None:
        import wandb

        old_id = _read_id(spec, step)
        self.run: Any = wandb.init(
            project="gsbench",
            group=spec.config.experiment,
            name=spec.name,
            dir=str(spec.folder),
            id=old_id,
            resume="allow" if old_id else None,
            config=dict(flat(spec.plain)),
            settings=wandb.Settings(init_timeout=WANDB_SECONDS, console="off"),
        )
        _write_id(spec, self.run.id)

    def add(self, step: int, numbers: Numbers) -> None:
        """Log numbers at a step."""
        self.run.log(dict(numbers), step=step)

    def end(self, status: str) -> None:
        """Finish the run, as failed unless its status is ok."""
        self.run.finish(exit_code=int(status != "ok"))


class MLflow:
    """Logs to the server that MLFLOW_TRACKING_URI names, or else into this folder."""

    def __init__(self, spec: RunSpec, step: int) -> None:
        for key, value in (("TIMEOUT", SECONDS), ("MAX_RETRIES", "1")):  # which MLflow may read when it is imported
            os.environ.setdefault(f"MLFLOW_HTTP_REQUEST_{key}", value)
        import mlflow

        self.client: Any = mlflow.MlflowClient()
        self.id = _read_id(spec, step)
        if self.id is None:
            name = spec.config.experiment
            earlier = self.client.get_experiment_by_name(name)
            experiment = earlier.experiment_id if earlier else self.client.create_experiment(name)
            self.id = str(self.client.create_run(experiment, run_name=spec.name).info.run_id)
            values = [(key, str(value)[:LONGEST_PARAMETER]) for key, value in flat(spec.plain)]
            for i in range(0, len(values), MOST_PARAMETERS):
                chosen = [mlflow.entities.Param(*pair) for pair in values[i : i + MOST_PARAMETERS]]
                self.client.log_batch(self.id, params=chosen)
            _write_id(spec, self.id)
        else:
            self.client.update_run(self.id, status="RUNNING")

    def add(self, step: int, numbers: Numbers) -> None:
        """Log numbers at a step."""
        for name, value in numbers.items():
            self.client.log_metric(self.id, name, value, step=step)

    def end(self, status: str) -> None:
        """Set the status of the run."""
        ended = {"ok": "FINISHED", "stopped": "KILLED"}.get(status, "FAILED")
        self.client.set_terminated(self.id, ended)


# By the name of their package, made for a run that has finished some steps: more than 0 if it continues.
TRACKERS: dict[str, Callable[[RunSpec, int], Tracker]] = {
    "tensorboard": TensorBoard,
    "wandb": WeightsAndBiases,
    "mlflow": MLflow,
}


def check_tracker(name: str | None) -> None:
    """Raise InputError if `name` is not a tracker, or if its package is not installed; None stands for no tracker."""
    if name is None:
        return
    check_known("log", name, TRACKERS)
    if importlib.util.find_spec(name) is None:
        raise InputError(
            f"log={name}: the package {name} is not installed: {how_to_install(name)}",
            docs="runs.md#the-folder-of-a-run",
        )


def _read_id(spec: RunSpec, step: int) -> str | None:
    """Return the id of a run that continues; None if it starts anew or no id was stored."""
    try:
        text = (spec.folder / ID_FILE).read_text()[:100] if step else ""
    except (OSError, UnicodeDecodeError):
        return None
    return text if re.fullmatch(r"[A-Za-z0-9_-]{1,64}", text) else None


def _write_id(spec: RunSpec, number: str) -> None:
    write_atomically(spec.folder / ID_FILE, number.encode(), lasting=False)


class RunLog:
    """Follows a training: each measurement on val becomes a line of curve.jsonl, and goes to the run's tracker."""

    def __init__(self, spec: RunSpec, trainer: Trainer) -> None:
        """Start the log at the trainer's step.

        A line of a later step is removed from curve.jsonl: a killed run wrote it after its last checkpoint, and the
        step is trained again.
        """
        self.path, self.trainer, self.config = spec.folder / FILE_NAME, trainer, spec.config
        points = trainer.curve.points
        earlier_lines = _read_curve(self.path)
        lines = [earlier_lines.get(point, Line(*point)) for point in points]
        self.written = len(points)
        with contextlib.suppress(OSError):  # a full disk ends the run at its checkpoint, which says so
            write_atomically(self.path, b"".join(map(_encoded, lines)), lasting=False)
        self.tracker: Tracker | None = None  # None also after its first error
        if (name := spec.config.log) is not None:
            continued = trainer.step if spec.config.resume else 0
            self.tracker = self._guarded(lambda: TRACKERS[name](spec, continued))
        for point, line in zip(points, lines, strict=True):
            if point not in earlier_lines:  # measured before the run had a log, while models or lengths were compared
                self._send_line(line)

    def follow(self) -> None:
        """Write what was measured since the last call; called after every step."""
        for point in self.trainer.curve.points[self.written :]:
            line = Line(*point, self.trainer.finite_check.loss, len(self.trainer.model))
            with contextlib.suppress(OSError), self.path.open("ab") as file:
                file.write(_encoded(line))
            self._send_line(line)
            self.written += 1

    def end(self, record: Record | None) -> None:
        """Send the results of the record and end the tracking; None if a signal has stopped the run."""
        if record and record.metrics and record.cost:
            names = ("train_s", "fps", "num_gaussians", "bytes")
            numbers = {f"{self.config.scene.eval_split}/{name}": value for name, value in record.metrics.items()}
            numbers |= {f"cost/{name}": getattr(record.cost, name) for name in names}
            self._send(self.trainer.step, numbers)
        if tracker := self.tracker:
            self._guarded(lambda: tracker.end(record.status if record else "stopped"))
        self.tracker = None

    def _send_line(self, line: Line) -> None:
        """Send a line of curve.jsonl to the tracker."""
        self._send(line.iteration, {name: getattr(line, key) for name, key in SENT.items()})

    def _send(self, step: int, numbers: Mapping[str, float | None]) -> None:
        """Send what is known and finite of some numbers to the tracker."""
        finite = {name: float(value) for name, value in numbers.items() if value is not None and math.isfinite(value)}
        if tracker := self.tracker:
            self._guarded(lambda: tracker.add(step, finite))

    def _guarded(self, call: Callable[[], T]) -> T | None:
        """Call a function of the tracker; if it raises an error, print this once, and go on without the tracker."""
        try:
            return call()
        except Exception as error:
            self.tracker = None
            print(
                f"gsbench: warning: log={self.config.log}: {type(error).__name__}: {one_line(error)}: the run goes on "
                f"without it",
                file=sys.stderr,
            )
            return None


def _encoded(line: Line) -> bytes:
    return msgspec.json.encode(line) + b"\n"  # NaN and infinity become null


def _read_curve(path: Path) -> dict[Point, Line]:
    """Read the lines of a curve.jsonl by their points; lines that are no JSON of a point are left out."""
    lines_by_point = {}
    try:
        texts = read_file(path, str(path), LARGEST).splitlines()
    except InputError:  # there is none yet
        return {}
    for text in texts:
        with contextlib.suppress(msgspec.MsgspecError):
            line = msgspec.json.decode(text, type=Line)
            lines_by_point[line.point] = line
    return lines_by_point
