"""The log of a run: curve.jsonl in its folder, and the trackers, which are faked here and may fail as they like."""

import importlib.machinery
import importlib.util
import itertools
import json
import math
import re
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock, call

import pytest
from tiny_run import overrides, run_here

from gsbench.errors import InputError
from gsbench.measure.curve import Curve
from gsbench.run.log import FILE_NAME, ID_FILE, TRACKERS, RunLog


def lines(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / FILE_NAME).read_text().splitlines()]


@pytest.fixture
def packages(monkeypatch: pytest.MonkeyPatch) -> dict[str, MagicMock]:
    """Mocks of the packages of all trackers, which note every call; each run of theirs has an id of its own."""
    ids = map("made_anew_{}".format, itertools.count())
    mocks = {name: MagicMock() for name in (*TRACKERS, "torch.utils.tensorboard")}
    mocks["wandb"].init.side_effect = lambda id=None, **_: MagicMock(
        id=id or next(ids), log=mocks["wandb"].log, finish=mocks["wandb"].finish
    )
    mocks["mlflow"].MlflowClient().create_run.side_effect = lambda *_, **__: MagicMock(
        info=SimpleNamespace(run_id=next(ids))
    )
    mocks["mlflow"].entities.Param = lambda *pair: pair
    for name, mock in mocks.items():
        mock.__spec__ = importlib.machinery.ModuleSpec(name, None)
        monkeypatch.setitem(sys.modules, name, mock)
    return mocks


def trainer(*points: tuple[int, float, float], step: int | None = None) -> Any:
    """What the log reads of a trainer that has measured some points."""
    curve = Curve()
    for point in points:
        curve.add(*point)
    last = points[-1][0] if points else 0
    return SimpleNamespace(curve=curve, finite_check=SimpleNamespace(loss=0.25), model=range(7), step=step or last)


def run_in(folder: Path, log: str | None = None) -> Any:
    scene = SimpleNamespace(eval_split="test")
    return SimpleNamespace(
        folder=folder,
        name="square 7dgs seed0",
        plain={"train": {"iterations": 30}},
        config=SimpleNamespace(scene=scene, log=log, experiment="mini", resume=True),
    )


def test_a_resumed_run_repeats_no_line(tmp_path):
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


def test_lines_that_cannot_be_written_cost_no_run(tmp_path):
    """Catches a full disk, or here a folder in the place of the file, that ends a training."""
    (tmp_path / FILE_NAME).mkdir()
    training = trainer()
    log = RunLog(run_in(tmp_path), training)
    training.curve.add(10, 1.0, 20.0)
    log.follow()
    log.end(None)


def sent_to(name: str, packages: dict[str, MagicMock]) -> tuple[dict[int, dict[str, float]], str, object]:
    """What a tracker was sent in one run: numbers by step, its settings as text, and how it ended."""
    if name == "tensorboard":
        writer = packages["torch.utils.tensorboard"].SummaryWriter()
        calls = [(step, {key: value}) for (key, value, step), _ in writer.add_scalar.call_args_list]
        settings, end = writer.add_text.call_args.args[1], writer.close.call_args
    elif name == "wandb":
        calls = [(words["step"], numbers) for (numbers,), words in packages[name].log.call_args_list]
        settings, end = packages[name].init.call_args.kwargs["config"], packages[name].finish.call_args
    else:
        client = packages[name].MlflowClient()
        calls = [(words["step"], {key: value}) for (_, key, value), words in client.log_metric.call_args_list]
        batches = [words["params"] for _, words in client.log_batch.call_args_list]
        assert max(map(len, batches)) <= 100
        settings, end = dict(itertools.chain(*batches)), client.set_terminated.call_args
    by_step: dict[int, dict[str, float]] = {}
    for step, numbers in calls:
        by_step.setdefault(step, {}).update(numbers)
    return by_step, str(settings), end


@pytest.mark.parametrize(
    ("name", "ended"),
    [("tensorboard", call()), ("wandb", call(exit_code=0)), ("mlflow", call("made_anew_0", "FINISHED"))],
)
def test_a_tracker_is_sent_the_curve_and_the_results(name, ended, packages, square, tmp_path):
    """Catches a point or a result that does not arrive, steps that are off by one, and settings of another run."""
    record, folder = run_here(*overrides(square, tmp_path, "model=3dgs", f"log={name}"))
    by_step, settings, end = sent_to(name, packages)
    assert [line["iteration"] for line in lines(folder)] == [point.iteration for point in record.curve] == [15, 30]
    for point in record.curve:
        numbers = by_step[point.iteration]
        assert (numbers["val/psnr"], numbers["train/seconds"]) == (point.psnr_val, point.seconds)
        assert numbers["train/loss"] > 0
    last = by_step[30]
    assert last["train/gaussians"] == record.cost.num_gaussians
    assert (last["test/psnr"], last["cost/fps"]) == (record.metrics["psnr"], record.cost.fps)
    assert re.search(r"train.iterations'?: '?30\b", settings)
    assert end == ended
    assert not {"log", "results"} & record.provenance.config.keys()
    assert not any(word.startswith("log") for word in record.overrides)


@pytest.mark.parametrize("name", ["wandb", "mlflow"])
def test_a_resumed_run_has_the_same_id(name, packages, tmp_path):
    """Catches a run that is two runs of the tracker, one that starts over under its old id, and an id with a path."""
    ids = []
    for step in (0, 10, 0):
        RunLog(run_in(tmp_path, name), trainer(step=step)).end(None)
        ids.append((tmp_path / ID_FILE).read_text())
    (tmp_path / ID_FILE).write_text("../../other")
    RunLog(run_in(tmp_path, name), trainer(step=10)).end(None)
    assert [*ids, (tmp_path / ID_FILE).read_text()] == ["made_anew_0", "made_anew_0", "made_anew_1", "made_anew_2"]
    client = packages["mlflow"].MlflowClient()
    if name == "mlflow":
        assert client.update_run.call_args_list == [call("made_anew_0", status="RUNNING")]
        assert client.set_terminated.call_args == call("made_anew_2", "KILLED")
    else:
        assert [words["id"] for _, words in packages[name].init.call_args_list] == [None, "made_anew_0", None, None]
        assert packages[name].finish.call_args == call(exit_code=1)


def test_tensorboard_hides_what_is_trained_again(packages, tmp_path):
    """Catches a curve that goes back in time after a kill."""
    RunLog(run_in(tmp_path, "tensorboard"), trainer((10, 1.0, 20.0)))
    writer = packages["torch.utils.tensorboard"].SummaryWriter
    assert writer.call_args == call(str(tmp_path / "tensorboard"), purge_step=11)


@pytest.mark.parametrize("broken", ["start", "add", "end"])
def test_a_tracker_that_fails_is_told_once_and_costs_nothing(broken, tmp_path, monkeypatch, capsys):
    """Catches a server that is down and ends a run, or fills its log with the same warning."""
    start = MagicMock()
    part = start if broken == "start" else getattr(start.return_value, broken)
    part.side_effect = ConnectionError("no route to host\nmany more lines")
    monkeypatch.setitem(TRACKERS, "wandb", start)
    log = RunLog(run_in(tmp_path, "wandb"), training := trainer())
    for step in (1, 2, 3):
        training.curve.add(step, 1.0, 20.0)
        log.follow()
    log.end(None)
    log.end(None)
    assert part.call_count == 1
    assert start.return_value.end.call_count == (broken == "end")
    message = "gsbench: warning: log=wandb: ConnectionError: no route to host: the run goes on without it\n"
    assert capsys.readouterr().err == message


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("wandb", "log=wandb: the package wandb is not installed: pip install '.[wandb]'"),
        ("tensorbord", "log 'tensorbord' is not known. Did you mean 'tensorboard'"),
    ],
)
def test_what_is_not_installed_or_known_is_refused_at_the_door(name, message, square, tmp_path, monkeypatch):
    """Catches a run that trains for hours before it says so, or a finished run whose record becomes a failed one."""
    _, folder = run_here(*overrides(square, tmp_path, "model=3dgs"))
    record = (folder / "record.json").read_bytes()
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    with pytest.raises(InputError, match=re.escape(message)):
        run_here(*overrides(square, tmp_path, "model=3dgs", f"log={name}"))
    assert (folder / "record.json").read_bytes() == record
