"""Hostile command lines: each ends in one line and the exit status of docs/runs.md, and never in a stack trace."""

import re

import pytest
from tiny_run import main_here, overrides

import gsbench
from gsbench.measure import record


@pytest.mark.parametrize(
    ("words", "status", "message"),
    [
        (["~seed"], 2, "config key 'seed': expected a value, it was deleted"),
        (["+model.options.agr=1"], 1, "model.options: expected no 'agr', which has a key of its own: set agr"),
        (["+model.options.name=1"], 1, "set model.name"),
        (["+model.options.backend=cpu"], 1, "set raster.backend"),
        (["+model.options.x="], 1, "model '3dgs' has no option 'x'"),
        (["hydra=null"], 2, "hydra: expected a key of gsbench's"),
        (["--resolve"], 2, "--resolve"),
        (["--shell-completion"], 2, "install"),
        (["results="], 2, "results: expected a folder"),
        (["seed=-1"], 2, "seed: expected at least 0, got -1"),
        (["results=/dev/null"], 2, "results: expected a folder that can be written"),
        (["protocol.lpips_alex=/nowhere.npz"], 1, "/nowhere.npz: expected the weights"),
        (["train.checkpoint_minutes=nan"], 2, "train.checkpoint_minutes: expected a finite number, got nan"),
        (["seed=9223372036854775808"], 2, "seed: expected at most 9.22337204e+18, got"),
        (["+train.iteratons=1"], 2, "config key 'train.iteratons' is not known. Did you mean 'iterations'?"),
        (["model=7dgs", "model.options.directional_half=no"], 1, "directional_half: expected bool, got 'no'"),
        (["device=cpu:5"], 2, "device 'cpu:5' is not known"),
        (["model.lr.means=1"], 2, "model.lr.means': expected values of its keys, start, end"),
        (["optim.lr=1"], 2, "config key 'optim': expected a value, it has no keys"),
        (["data.root='~nobody0/x'"], 2, "data.root=~nobody0/x: there is no such folder"),
        (["data.root=pkg://nosuch"], 2, "data.root: expected pkg://MODULE"),
        (["scene.downscale=16"], 1, "scene.downscale=16: expected images of at least 11 pixels"),
    ],
)
def test_bad_words_are_one_line_and_a_known_status(words, status, message, square, tmp_path, capsys):
    """Catches a stack trace, one status for bad input and failed runs, and a fault that is noticed after a training."""
    assert main_here(*overrides(square, tmp_path, "model=3dgs"), *words) == status
    errors = [line for line in capsys.readouterr().err.splitlines() if line.startswith("gsbench: error:")]
    assert len(errors) == 1
    assert message in errors[0]
    assert [record.read(path).status for path in record.find(tmp_path)] == (["failed"] if status == 1 else [])
    assert not list(tmp_path.rglob("checkpoint.pt")), "refused after the training"


def test_a_scene_without_a_name_says_which_key(tmp_path, capsys):
    """Catches a message that names a missing value of OmegaConf's and not what to type."""
    words = ["+exp=dnerf", "scene=custom", f"data.root={tmp_path}", f"results={tmp_path}"]
    assert main_here(*words) == 2
    assert "scene.name=FOLDER" in capsys.readouterr().err


def test_the_version_is_that_of_gsbench(capsys):
    """Catches the version of Hydra."""
    assert main_here("--version") == 0
    assert capsys.readouterr().out == f"gsbench {gsbench.__version__}\n"


def test_a_reader_who_has_gone_costs_no_record(square, tmp_path, monkeypatch, capsys):
    """Catches `python -m gsbench ... | head`, which put a failed record in the place of a finished run's."""
    words = [*overrides(square, tmp_path, "model=3dgs", "train.iterations=3"), "protocol.pictures=0"]
    words.remove("train.iterations=30")
    assert main_here(*words) == 0
    (path,) = record.find(tmp_path)

    def closed(*_: object, file: object = None, **__: object) -> None:
        if file is None:
            raise BrokenPipeError(32, "Broken pipe")

    with monkeypatch.context() as patched:
        patched.setattr("builtins.print", closed)
        assert main_here(*words) != 0
    assert record.read(path).status == "ok"
    assert not list(tmp_path.rglob("progress.json"))
    capsys.readouterr()


def fault(*_: object) -> None:
    raise ZeroDivisionError("here")


@pytest.mark.parametrize(
    ("measure", "reason", "frame"),
    [
        (None, "an error that gsbench did not foresee, TypeError: .*; please report it, with", "execution.py"),
        (fault, r"an error in test_command_lines.py, line \d+: ZeroDivisionError: here; see", "in fault"),
    ],
)
def test_an_error_that_nobody_foresaw_is_a_record(measure, reason, frame, square, tmp_path, monkeypatch, capsys):
    """Catches a fault of gsbench's own, as in a new model, that ends the sweep and leaves neither a row nor a stack,
    and one of a user's code that is said to be gsbench's."""
    monkeypatch.setattr("gsbench.run.execution.Execution.measure", measure)
    words = [*overrides(square, tmp_path, "model=3dgs"), "-m", "seed=0,1"]
    assert main_here(*words) == 1
    written = [record.read(path) for path in record.find(tmp_path)]
    assert [run.status for run in written] == ["failed", "failed"]
    for run, path in zip(written, record.find(tmp_path), strict=True):
        assert re.match(reason, str(run.reason))
        assert frame in path.with_name("traceback.txt").read_text()
    capsys.readouterr()
