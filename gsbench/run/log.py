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
from typing import Any, Protocol, TypeVar

from gsbench.config_roles import flat
from gsbench.errors import InputError, check_known, how_to_install, one_line
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

# By the name of a number in a tracker, the key in a line of curve.jsonl.
SENT = {"val/psnr": "psnr_val", "train/loss": "loss", "train/seconds": "seconds", "train/gaussians": "gaussians"}

Numbers = Mapping[str, float]
Line = dict[str, Any]  # of curve.jsonl
T = TypeVar("T")


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
        for key, value in (("TIMEOUT", SECONDS), ("MAX_RETRIES", "1")):  # which MLflow may read when it is imported
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
    check_known("log", name, TRACKERS)
    if importlib.util.find_spec(name) is None:
        raise InputError(
            f"log={name}: the package {name} is not installed: {how_to_install(name)}",
            docs="runs.md#the-folder-of-a-run",
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
        self.path, self.trainer, self.config = spec.folder / FILE_NAME, trainer, spec.config
        points = trainer.curve.points
        earlier_lines = _read_curve(self.path)
        lines = [earlier_lines.get(point, _line(point)) for point in points]
        self.written = len(points)
        with contextlib.suppress(OSError):  # a full disk ends the run at its checkpoint, which says so
            text = "".join(f"{json.dumps(line)}\n" for line in lines)
            write_atomically(self.path, text.encode(), lasting=False)
        continued = trainer.step if spec.config.resume else 0
        subject = Subject(spec.folder, spec.name, spec.config.experiment, dict(flat(spec.plain)), continued)
        self.tracker: Tracker | None = None  # None also after its first error
        if (name := spec.config.log) is not None:
            self.tracker = self._guarded(lambda: TRACKERS[name](subject))
        for point, line in zip(points, lines, strict=True):
            if point not in earlier_lines:  # measured before the run had a log, while models or lengths were compared
                self._send_line(line)

    def follow(self) -> None:
        """Write what was measured since the last call; called after every step."""
        for point in self.trainer.curve.points[self.written :]:
            line = _line(point, self.trainer.finite_check.loss, len(self.trainer.model))
            with contextlib.suppress(OSError), self.path.open("a") as file:
                file.write(f"{json.dumps(line)}\n")
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
        self._send(line["iteration"], {name: line[key] for name, key in SENT.items()})

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


def _line(point: Point, loss: float | None = None, gaussians: int | None = None) -> Line:
    """Return a line of curve.jsonl; what is not known or not finite is None."""
    return {
        **point._asdict(),
        "loss": loss if loss is not None and math.isfinite(loss) else None,
        "gaussians": gaussians,
    }


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
