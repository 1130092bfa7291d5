"""Append the curve of a run to curve.jsonl in its folder while it trains, and send it to a tracker."""

import contextlib
import json
import math
from pathlib import Path
from typing import Any

from gsbench.config_roles import flat
from gsbench.errors import InputError
from gsbench.measure.atomic import write_atomically
from gsbench.measure.curve import Point
from gsbench.measure.record import Record
from gsbench.reading import parse_json, read_file
from gsbench.run.identity import Run
from gsbench.run.trackers import Guarded, Subject
from gsbench.train.loop import Trainer

FILE_NAME = "curve.jsonl"
LARGEST = 1 << 24  # bytes
Line = dict[str, Any]


class RunLog:
    """Follows a training: each measurement on val becomes a line of curve.jsonl, and goes to the run's tracker."""

    def __init__(self, this: Run, trainer: Trainer) -> None:
        """Start the log at the trainer's step.

        A line of a later step is removed from curve.jsonl: a killed run wrote it after its last checkpoint, and the
        step is trained again.
        """
        self.path = this.folder / FILE_NAME
        self.trainer = trainer
        self.split = this.config.scene.eval_split
        points = trainer.curve.points
        known = _read(self.path)
        lines = [known.get(point, _line(point)) for point in points]
        self.written = len(points)
        with contextlib.suppress(OSError):  # a full disk ends the run at its checkpoint, which says so
            write_atomically(self.path, "".join(map(_text, lines)).encode(), lasting=False)
        settings, continued = dict(flat(this.plain)), trainer.step if this.config.resume else 0
        self.tracker = Guarded(
            this.config.log, Subject(this.folder, this.name, this.config.experiment, settings, continued)
        )
        for point, line in zip(points, lines, strict=True):
            if point not in known:  # measured before the run had a log, while models or lengths were compared
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
        self.tracker.add(point.iteration, _finite({
            "val/psnr": line["psnr_val"], "train/loss": line["loss"], "train/seconds": line["seconds"],
            "train/gaussians": line["gaussians"],
        }))  # fmt: skip

    def end(self, record: Record | None) -> None:
        """Send the results of the record and end the tracking; None if a signal has stopped the run."""
        if record and record.metrics and record.cost:
            costs = {name: getattr(record.cost, name) for name in ("train_s", "fps", "num_gaussians", "bytes")}
            numbers = {f"{self.split}/{name}": value for name, value in record.metrics.items()}
            self.tracker.add(self.trainer.step, _finite({**numbers, **{f"cost/{k}": v for k, v in costs.items()}}))
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


def _read(path: Path) -> dict[Point, Line]:
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
