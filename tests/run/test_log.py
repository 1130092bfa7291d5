"""The log of a run: curve.jsonl in its folder, and the trackers, which are faked here and may fail as they like."""

import importlib.machinery
import importlib.util
import json
import math
import re
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
from tiny_run import overrides, run_here

from gsbench.errors import InputError
from gsbench.measure.curve import Curve
from gsbench.run.log import FILE_NAME, ID_FILE, TRACKERS, Guarded, RunLog, Subject

Sent = dict[str, Any]


def lines(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / FILE_NAME).read_text().splitlines()]


def module(monkeypatch: pytest.MonkeyPatch, name: str, **content: object) -> None:
    """Put a module into sys.modules, as if its package were installed."""
    fake_module = ModuleType(name)
    fake_module.__spec__ = importlib.machinery.ModuleSpec(name, None)
    vars(fake_module).update(content)
    monkeypatch.setitem(sys.modules, name, fake_module)


def fake(monkeypatch: pytest.MonkeyPatch, name: str) -> Sent:
    """Replace the package of a tracker by one that keeps what it is sent: settings, numbers by step, ids, the end."""
    sent: Sent = {"numbers": {}, "ids": [], "settings": {}, "ended": []}

    def add(step: int, numbers: dict[str, float]) -> None:
        sent["numbers"].setdefault(step, {}).update(numbers)

    class Writer:
        def __init__(self, folder: str, purge_step: int) -> None:
            sent["ids"].append((folder, purge_step))

        def add_text(self, name: str, text: str, step: int) -> None:
            sent["settings"] |= dict(line.strip().split(": ", 1) for line in text.splitlines())

        def add_scalar(self, name: str, value: float, step: int) -> None:
            add(step, {name: value})

        def flush(self) -> None: ...

        def close(self) -> None:
            sent["ended"].append("closed")

    class WandbRun:
        def __init__(self, id: str | None = None, config: dict[str, Any] | None = None, **_: object) -> None:
            self.id = id or f"made{len(sent['ids'])}"
            sent["ids"].append(self.id)
            sent["settings"] |= config or {}

        def log(self, numbers: dict[str, float], step: int) -> None:
            add(step, numbers)

        def finish(self, exit_code: int) -> None:
            sent["ended"].append(exit_code)

    class Client:
        def get_experiment_by_name(self, name: str) -> None: ...

        def create_experiment(self, name: str) -> str:
            return name

        def create_run(self, experiment: str, run_name: str) -> SimpleNamespace:
            sent["ids"].append(f"made{len(sent['ids'])}")
            return SimpleNamespace(info=SimpleNamespace(run_id=sent["ids"][-1]))

        def update_run(self, run: str, status: str) -> None:
            sent["ids"].append(run)

        def log_batch(self, run: str, params: list[tuple[str, str]]) -> None:
            assert len(params) <= 100
            sent["settings"] |= dict(params)

        def log_metric(self, run: str, name: str, value: float, step: int) -> None:
            add(step, {name: value})

        def set_terminated(self, run: str, status: str) -> None:
            sent["ended"].append(status)

    module(monkeypatch, "tensorboard")
    module(monkeypatch, "torch.utils.tensorboard", SummaryWriter=Writer)
    module(monkeypatch, "wandb", init=WandbRun, Settings=dict)
    module(monkeypatch, "mlflow", MlflowClient=Client, entities=SimpleNamespace(Param=lambda *pair: pair))
    assert name in TRACKERS
    return sent


def trainer(*points: tuple[int, float, float], step: int | None = None) -> Any:
    """What the log reads of a trainer that has measured some points."""
    curve = Curve()
    for point in points:
        curve.add(*point)
    last = points[-1][0] if points else 0
    return SimpleNamespace(curve=curve, finite_check=SimpleNamespace(loss=0.25), model=range(7), step=step or last)


def run_in(folder: Path, log: str | None = None) -> Any:
    scene = SimpleNamespace(eval_split="test")
    return SimpleNamespace(folder=folder, name="square 7dgs seed0", plain={"train": {"iterations": 30}},
                           config=SimpleNamespace(scene=scene, log=log, experiment="mini", resume=True))  # fmt: skip


# ---- curve.jsonl


def test_a_resumed_run_repeats_no_line(tmp_path: Path) -> None:
    """Catches lines after the last checkpoint that come twice, a half-written line, and a loss that a resume loses."""
    killed = trainer((10, 1.0, 20.0))
    log = RunLog(run_in(tmp_path), killed)
    killed.curve.add(20, 2.0, 21.0)
    log.follow()
    killed.curve.add(30, 3.0, 22.0)
    log.follow()
    log.follow()
    assert [(line["iteration"], line["loss"]) for line in lines(tmp_path)] == [(10, None), (20, 0.25), (30, 0.25)]
    with (tmp_path / FILE_NAME).open("a") as file:
        file.write('[1]\n{"iteration": 10}\n{"iteration": {}, "seconds": [], "psnr_val": 1, "loss": 0}\n{"iterat')

    resumed = trainer((10, 1.0, 20.0), (20, 2.0, 21.0))
    log = RunLog(run_in(tmp_path), resumed)
    resumed.curve.add(30, 3.5, math.nan)
    log.follow()
    assert lines(tmp_path) == [
        {"iteration": 10, "seconds": 1.0, "psnr_val": 20.0, "loss": None, "gaussians": None},
        {"iteration": 20, "seconds": 2.0, "psnr_val": 21.0, "loss": 0.25, "gaussians": 7},
        {"iteration": 30, "seconds": 3.5, "psnr_val": None, "loss": 0.25, "gaussians": 7},
    ]
    RunLog(run_in(tmp_path), trainer())
    assert lines(tmp_path) == []  # a run that starts over


def test_lines_that_cannot_be_written_cost_no_run(tmp_path: Path) -> None:
    """Catches a full disk, or here a folder in the place of the file, that ends a training."""
    (tmp_path / FILE_NAME).mkdir()
    training = trainer()
    log = RunLog(run_in(tmp_path), training)
    training.curve.add(10, 1.0, 20.0)
    log.follow()
    log.end(None)


# ---- trackers


@pytest.mark.parametrize("name", TRACKERS)
def test_a_tracker_is_sent_the_curve_and_the_results(
    name: str, square: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a point or a result that does not arrive, steps that are off by one, and settings of another run."""
    sent = fake(monkeypatch, name)
    record, folder = run_here(*overrides(square, tmp_path, "model=3dgs", f"log={name}"))
    assert record.metrics
    assert record.cost
    assert [line["iteration"] for line in lines(folder)] == [point.iteration for point in record.curve] == [15, 30]
    for point in record.curve:
        numbers = sent["numbers"][point.iteration]
        assert (numbers["val/psnr"], numbers["train/seconds"]) == (point.psnr_val, point.seconds)
        assert numbers["train/loss"] > 0
    last = sent["numbers"][30]
    assert last["train/gaussians"] == record.cost.num_gaussians
    assert (last["test/psnr"], last["cost/fps"]) == (record.metrics["psnr"], record.cost.fps)
    assert str(sent["settings"]["train.iterations"]) == "30"
    assert sent["ended"] in (["closed"], [0], ["FINISHED"])
    assert not {"log", "results"} & record.provenance.config.keys()
    assert not any(word.startswith("log") for word in record.overrides)


@pytest.mark.parametrize(("name", "killed"), [("wandb", 1), ("mlflow", "KILLED")])
def test_a_resumed_run_has_the_same_id(
    name: str, killed: object, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a run that is two runs of the tracker, one that starts over under its old id, and an id with a path."""
    sent = fake(monkeypatch, name)
    for step in (0, 10, 0):
        RunLog(run_in(tmp_path, name), trainer(step=step)).end(None)
    (tmp_path / ID_FILE).write_text("../../other")
    RunLog(run_in(tmp_path, name), trainer(step=10)).end(None)
    assert sent["ids"] == ["made0", "made0", "made2", "made3"]
    assert sent["ended"] == [killed] * 4


def test_tensorboard_hides_what_is_trained_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a curve that goes back in time after a kill."""
    sent = fake(monkeypatch, "tensorboard")
    RunLog(run_in(tmp_path, "tensorboard"), trainer((10, 1.0, 20.0)))
    assert sent["ids"] == [(str(tmp_path / "tensorboard"), 11)]


@pytest.mark.parametrize("broken", ["start", "add", "end"])
def test_a_tracker_that_fails_is_told_once_and_costs_nothing(
    broken: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches a server that is down and ends a run, or fills its log with the same warning."""
    calls = []

    class Down:
        def __init__(self, _: Subject) -> None:
            self.call("start")

        def call(self, name: str, *_: object) -> None:
            calls.append(name)
            if name == broken:
                raise ConnectionError("no route to host\nmany more lines")

        def add(self, *_: object) -> None:
            self.call("add")

        def end(self, _: str) -> None:
            self.call("end")

    monkeypatch.setitem(TRACKERS, "wandb", Down)
    tracker = Guarded("wandb", Subject(tmp_path, "a run", "mini", {}, 0))
    for _ in range(3):
        tracker.add(1, {})
    tracker.end("ok")
    tracker.end("ok")
    assert calls.count(broken) == 1
    assert calls[-1] == broken
    message = "gsbench: warning: log=wandb: ConnectionError: no route to host: the run goes on without it\n"
    assert capsys.readouterr().err == message


def test_a_run_with_a_server_that_is_down_is_ok(
    square: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches a training that a tracker ends, from the first step to the record."""
    sent = fake(monkeypatch, "mlflow")
    module(monkeypatch, "mlflow", MlflowClient=lambda: 1 / 0)
    record, folder = run_here(*overrides(square, tmp_path, "model=3dgs", "log=mlflow"))
    assert record.status == "ok"
    assert len(lines(folder)) == 2
    assert not sent["numbers"]
    assert capsys.readouterr().err.count("log=mlflow: ZeroDivisionError") == 1


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("wandb", "log=wandb: the package wandb is not installed: pip install '.[wandb]'"),
        ("tensorbord", "log 'tensorbord' is not known. Did you mean 'tensorboard'"),
    ],
)
def test_what_is_not_installed_or_known_is_refused_at_the_door(
    name: str, message: str, square: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a run that trains for hours before it says so, or a finished run whose record becomes a failed one."""
    _, folder = run_here(*overrides(square, tmp_path, "model=3dgs"))
    record = (folder / "record.json").read_bytes()
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    with pytest.raises(InputError, match=re.escape(message)):
        run_here(*overrides(square, tmp_path, "model=3dgs", f"log={name}"))
    assert (folder / "record.json").read_bytes() == record
