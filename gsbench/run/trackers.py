"""Send the measurements of a run to TensorBoard, Weights & Biases or MLflow (config key `log`).

These packages are optional, and imported only by the run that names one. An error of theirs ends no run.
"""

import importlib.util
import os
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from gsbench.errors import InputError, did_you_mean, how_to_install, one_line
from gsbench.measure.atomic import write_atomically

ID_FILE = "tracker.txt"  # in the run's folder: the id that the tracker gave the run, so that a resumed run continues it
MOST_PARAMETERS = 100  # of MLflow, in one request
LONGEST_PARAMETER = 500  # letters, of MLflow
SECONDS = "10"  # that MLflow waits for a server
WANDB_SECONDS = 30.0  # that Weights & Biases waits for a server

Numbers = Mapping[str, float]


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

        known = _read_id(subject)
        self.run: Any = wandb.init(
            project="gsbench", group=subject.experiment, name=subject.name, id=known, resume="allow" if known else None,
            dir=str(subject.folder), config=dict(subject.settings),
            settings=wandb.Settings(init_timeout=WANDB_SECONDS, console="off"),
        )  # fmt: skip
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
            known = self.client.get_experiment_by_name(subject.experiment)
            experiment = known.experiment_id if known else self.client.create_experiment(subject.experiment)
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


def check(name: str | None) -> None:
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
        try:
            call()
        except Exception as error:
            self.tracker = None
            print(f"gsbench: warning: log={self.name}: {type(error).__name__}: {one_line(error)}: the run goes on "
                  f"without it", file=sys.stderr)  # fmt: skip


def _read_id(subject: Subject) -> str | None:
    """Return the id of a run that continues; None if it starts anew or no id was stored."""
    try:
        text = (subject.folder / ID_FILE).read_text()[:100] if subject.step else ""
    except (OSError, UnicodeDecodeError):
        return None
    return text if re.fullmatch(r"[A-Za-z0-9_-]{1,64}", text) else None


def _write_id(subject: Subject, number: str) -> None:
    write_atomically(subject.folder / ID_FILE, number.encode(), lasting=False)
