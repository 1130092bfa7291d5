"""Append the curve of a run to curve.jsonl while it trains, and send it to a tracker (config key `log`).

The packages of TensorBoard, Weights & Biases and MLflow are optional, and imported only by the run that names one. An
error of theirs ends no run.
"""

import contextlib
import importlib.util
import json
import math
import os
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from gsbench.config_roles import flat
from gsbench.errors import InputError, did_you_mean, how_to_install, one_line
from gsbench.measure.atomic import write_atomically
from gsbench.measure.curve import Point
from gsbench.measure.record import Record
from gsbench.reading import parse_json, read_file
from gsbench.run.identity import RunSpec
from gsbench.train.loop import Trainer

FILE_NAME = "curve.jsonl"
LARGEST = 1 << 24  # bytes of curve.jsonl
ID_FILE = "tracker.txt"  # in the run's folder: the id that the tracker gave the run, so that a resumed run continues it
MOST_PARAMETERS = 100  # of MLflow, in one request
LONGEST_PARAMETER = 500  # letters, of MLflow
SECONDS = "10"  # that MLflow waits for a server
WANDB_SECONDS = 30.0  # that Weights & Biases waits for a server

Numbers = Mapping[str, float]
Line = dict[str, Any]  # of curve.jsonl


@dataclass(frozen=True)
class Subject:
    """What a tracker is told about a run before its first number."""

    folder: Path
    name: str
    experiment: str
    settings: Mapping[str, Any]  # by dotted key
    step: int  # finished steps; above 0 if the run continues from a checkpoint


class Tracker(Protocol):
    """A service that shows the numbers of runs."""

    def add(self, step: int, numbers: Numbers) -> None:
        """Send numbers that were measured after `step` steps."""

    def end(self, status: str) -> None:
        """Send what is left; `status` is that of the record, or "stopped"."""


class TensorBoard:
    """Writes event files into the folder `tensorboard` of the run; needs no server."""

    def __init__(self, subject: Subject) -> None:
        from torch.utils.tensorboard import SummaryWriter

        # Events of an earlier attempt after this step are hidden, as the run measures them again.
        self.writer: Any = SummaryWriter(str(subject.folder / "tensorboard"), purge_step=subject.step + 1)
        lines = [f"    {key}: {value}" for key, value in subject.settings.items()]
        self.writer.add_text("settings", "\n".join(lines), subject.step)

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

    def __init__(self, subject: Subject) -> None:
        import wandb

        old_id = _read_id(subject)
        self.run: Any = wandb.init(
            project="gsbench",
            group=subject.experiment,
            name=subject.name,
            dir=str(subject.folder),
            id=old_id,
            resume="allow" if old_id else None,
            config=dict(subject.settings),
            settings=wandb.Settings(init_timeout=WANDB_SECONDS, console="off"),
        )
        _write_id(subject, self.run.id)

    def add(self, step: int, numbers: Numbers) -> None:
        """Log numbers at a step."""
        self.run.log(dict(numbers), step=step)

    def end(self, status: str) -> None:
        """Finish the run, as failed unless its status is ok."""
        self.run.finish(exit_code=int(status != "ok"))


class MLflow:
    """Logs to the server that MLFLOW_TRACKING_URI names, or else into this folder."""

    def __init__(self, subject: Subject) -> None:
        for key, value in (("TIMEOUT", SECONDS), ("MAX_RETRIES", "1")):
            os.environ.setdefault(f"MLFLOW_HTTP_REQUEST_{key}", value)
        import mlflow

        self.client: Any = mlflow.MlflowClient()
        self.id = _read_id(subject)
        if self.id is None:
            earlier = self.client.get_experiment_by_name(subject.experiment)
            experiment = earlier.experiment_id if earlier else self.client.create_experiment(subject.experiment)
            self.id = str(self.client.create_run(experiment, run_name=subject.name).info.run_id)
            values = [(key, str(value)[:LONGEST_PARAMETER]) for key, value in subject.settings.items()]
            for i in range(0, len(values), MOST_PARAMETERS):
                chosen = [mlflow.entities.Param(*pair) for pair in values[i : i + MOST_PARAMETERS]]
                self.client.log_batch(self.id, params=chosen)
            _write_id(subject, self.id)
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


TRACKERS: dict[str, Callable[[Subject], Tracker]] = {
    "tensorboard": TensorBoard,
    "wandb": WeightsAndBiases,
    "mlflow": MLflow,
}  # by the name of their package


def check_tracker(name: str | None) -> None:
    """Raise InputError if `name` is not a tracker, or if its package is not installed; None stands for no tracker."""
    if name is None:
        return
    if name not in TRACKERS:
        raise InputError(f"log '{name}' is not known. {did_you_mean(name, TRACKERS)}")
    if importlib.util.find_spec(name) is None:
        raise InputError(
            f"log={name}: the package {name} is not installed: {how_to_install(name)}",
            docs="runs.md#the-folder-of-a-run",
        )


class Guarded:
    """Calls a tracker until its first error, which is printed once; the run goes on without the tracker."""

    def __init__(self, name: str | None, subject: Subject) -> None:
        """Start the tracker `name`; None stands for no tracker."""
        self.name = name
        self.tracker: Tracker | None = None
        if name is not None:
            self._guard(lambda: self._start(name, subject))

    def _start(self, name: str, subject: Subject) -> None:
        self.tracker = TRACKERS[name](subject)

    def add(self, step: int, numbers: Numbers) -> None:
        """Send numbers that were measured after `step` steps."""
        if tracker := self.tracker:
            self._guard(lambda: tracker.add(step, numbers))

    def end(self, status: str) -> None:
        """End the tracking."""
        if tracker := self.tracker:
            self._guard(lambda: tracker.end(status))
        self.tracker = None

    def _guard(self, call: Callable[[], None]) -> None:
        """Call a function; if it raises an error, print this and use the tracker no more."""
        try:
            call()
        except Exception as error:
            self.tracker = None
            print(
                f"gsbench: warning: log={self.name}: {type(error).__name__}: {one_line(error)}: the run goes on "
                f"without it",
                file=sys.stderr,
            )


def _read_id(subject: Subject) -> str | None:
    """Return the id of a run that continues; None if it starts anew or no id was stored."""
    try:
        text = (subject.folder / ID_FILE).read_text()[:100] if subject.step else ""
    except (OSError, UnicodeDecodeError):
        return None
    return text if re.fullmatch(r"[A-Za-z0-9_-]{1,64}", text) else None


def _write_id(subject: Subject, number: str) -> None:
    write_atomically(subject.folder / ID_FILE, number.encode(), lasting=False)


class RunLog:
    """Follows a training: each measurement on val becomes a line of curve.jsonl, and goes to the run's tracker."""

    def __init__(self, spec: RunSpec, trainer: Trainer) -> None:
        """Start the log at the trainer's step.

        A line of a later step is removed from curve.jsonl: a killed run wrote it after its last checkpoint, and the
        step is trained again.
        """
        self.path = spec.folder / FILE_NAME
        self.trainer = trainer
        self.split = spec.config.scene.eval_split
        points = trainer.curve.points
        earlier_lines = _read_curve(self.path)
        lines = [earlier_lines.get(point, _line(point)) for point in points]
        self.written = len(points)
        with contextlib.suppress(OSError):  # a full disk ends the run at its checkpoint, which says so
            write_atomically(self.path, "".join(map(_text, lines)).encode(), lasting=False)
        continued = trainer.step if spec.config.resume else 0
        subject = Subject(spec.folder, spec.name, spec.config.experiment, dict(flat(spec.plain)), continued)
        self.tracker = Guarded(spec.config.log, subject)
        for point, line in zip(points, lines, strict=True):
            if point not in earlier_lines:  # measured before the run had a log, while models or lengths were compared
                self._send(point, line)

    def follow(self) -> None:
        """Write what was measured since the last call; called after every step."""
        for point in self.trainer.curve.points[self.written :]:
            line = _line(point, self.trainer.finite_check.loss, len(self.trainer.model))
            with contextlib.suppress(OSError), self.path.open("a") as file:
                file.write(_text(line))
            self._send(point, line)
            self.written += 1

    def _send(self, point: Point, line: Line) -> None:
        """Send a line of curve.jsonl to the tracker."""
        self.tracker.add(
            point.iteration,
            _finite(
                {
                    "val/psnr": line["psnr_val"],
                    "train/loss": line["loss"],
                    "train/seconds": line["seconds"],
                    "train/gaussians": line["gaussians"],
                }
            ),
        )

    def end(self, record: Record | None) -> None:
        """Send the results of the record and end the tracking; None if a signal has stopped the run."""
        if record and record.metrics and record.cost:
            names = ("train_s", "fps", "num_gaussians", "bytes")
            numbers = {f"{self.split}/{name}": value for name, value in record.metrics.items()}
            numbers |= {f"cost/{name}": getattr(record.cost, name) for name in names}
            self.tracker.add(self.trainer.step, _finite(numbers))
        self.tracker.end(record.status if record else "stopped")


def _line(point: Point, loss: float | None = None, gaussians: int | None = None) -> Line:
    """Return a line of curve.jsonl; what is not known or not finite is None."""
    return {
        **point._asdict(),
        "loss": loss if loss is not None and math.isfinite(loss) else None,
        "gaussians": gaussians,
    }


def _text(line: Line) -> str:
    return json.dumps(line) + "\n"


def _read_curve(path: Path) -> dict[Point, Line]:
    """Read the lines of a curve.jsonl by their points; lines that are no JSON of a point are left out."""
    lines_by_point = {}
    try:
        lines = read_file(path, str(path), LARGEST).splitlines()
    except InputError:  # there is none yet
        return {}
    for text in lines:
        with contextlib.suppress(InputError, KeyError, TypeError):
            read = parse_json(text, str(path))
            point = Point(read["iteration"], read["seconds"], read["psnr_val"])
            lines_by_point[point] = _line(point, _number(read["loss"]), _number(read["gaussians"]))
    return lines_by_point


def _number(value: Any) -> Any:
    return value if type(value) in (int, float) else None


def _finite(numbers: dict[str, float | None]) -> dict[str, float]:
    return {name: float(value) for name, value in numbers.items() if value is not None and math.isfinite(value)}
