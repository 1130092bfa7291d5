"""Sweeps as they are launched: the plan, several processes, retry, and ablations that change what they say."""

import json
import os
import re
import shutil
import signal
import time
from pathlib import Path
from typing import Any

import crowd
import pytest
from forked import python_m
from interrupted import assert_same_bits, bits
from tiny_run import gsbench, main_here, overrides

from gsbench.errors import InputError
from gsbench.launch import plan, processes, status
from gsbench.launch import sweep as launcher
from gsbench.launch.__main__ import main as sweep_main
from gsbench.launch.command import RunConfig, compose_run, hydra_with
from gsbench.launch.plan import Ended, Plan, identity
from gsbench.launch.status import RecordStatus
from gsbench.launch.sweep import retry
from gsbench.run import execution
from gsbench.run.execution import UnrecordedError

SCENE = ("scene=", "scene.name=")


def states(experiment: Path) -> list[str]:
    return sorted(run.state for run in status.status(status.read(experiment)))


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("train.iterations=5", r"launch\.memory=16G, got 'train\.iterations=5'"),
        ("launch.nosuch=1", r"config key 'launch\.nosuch' is not known"),
    ],
)
def test_retry_takes_only_settings_of_the_launch(word, message, tmp_path):
    """Catches a retry that may change what its runs are."""
    with pytest.raises(InputError, match=message):
        retry(status.read(tmp_path), [word])


def test_retry_passes_over_what_cannot_be_launched(tmp_path, capsys, monkeypatch):
    """Catches a stack trace, or a whole retry that ends, for a folder that is gone and words that are not known."""
    monkeypatch.chdir(tmp_path)
    experiment, gone = tmp_path / "mini", str(tmp_path / "gone")
    asked = {
        gone: ["+exp=mini", "scene=suzanne", "seed=0"],
        str(tmp_path): ["+exp=mini", "scene=suzanne", "train.iteratons=5", "seed=1"],
        "/": ["+exp=mini", "seed=[", "seed=2"],
        "/usr": ["+exp=mini", "scene=suzanne", "+launch=parallel", "launch.at_once=0", "seed=3"],
    }
    for number, (cwd, words) in enumerate(asked.items()):
        folder = experiment / plan.FOLDER / f"2026-11-22_00-00-0{number}.000000"
        plan.write(Plan("local", [words], cwd=cwd, born=None, started=0.0), folder)
    assert sweep_main(["retry", str(experiment)]) == 1  # they are lost as before
    errors = [line for line in capsys.readouterr().err.splitlines() if "cannot be launched again" in line]
    reasons = (f"'{gone}'", "Did you mean 'iterations'", "at input '['", "launch.at_once: expected at least 1")
    for line, reason in zip(sorted(errors), reasons, strict=True):
        assert reason in line


def test_retry_names_the_command_of_a_run_that_is_of_no_sweep(tmp_path, capsys):
    """Catches `no run failed` beside a status that lists one, and a command for a record whose words are lost."""
    run, folder = ("7dgs", "lego", 0), tmp_path / "mini" / "seed0"
    folder.mkdir(parents=True)
    broken = crowd.record(*run) | {"status": "failed", "reason": "out of memory"}
    (folder / "record.json").write_text(json.dumps(broken, default=str))
    (folder.parent / "record.json").write_text("{}")
    assert sweep_main(["retry", str(tmp_path / "mini")]) == 1
    errors = capsys.readouterr().err
    assert f"python -m gsbench {' '.join(identity(crowd.overrides(*run)))} results={tmp_path}" in errors
    assert errors.count("python -m gsbench") == 1
    assert "no run was stopped" not in errors


def test_a_retry_launches_with_the_settings_that_it_gets(tmp_path, monkeypatch):
    """Catches more memory that is asked for and never used, and a run that loses what decides its numbers."""
    monkeypatch.chdir(tmp_path)  # a retry goes to where the command was typed
    experiment = tmp_path / "mini"
    words = ["+exp=mini", "model=4dgs", "scene=suzanne", "seed=3", "launch.memory=8G", "results=elsewhere"]
    plan.write(Plan("local", [words], born=None, started=0.0), experiment / plan.FOLDER / "2026-11-22_00-00-00.000000")
    launched: list[RunConfig] = []
    monkeypatch.setattr(launcher, "launch", lambda configs, _: launched.extend(configs))
    assert retry(status.read(experiment), ["launch.memory=16G"]) == 1
    ((config),) = (run.config for run in launched)
    assert (config.model.name, config.seed, config.launch.memory) == ("4dgs", 3, "16G")
    assert config.results == str(tmp_path)


def test_a_sweep_ends_with_its_own_runs(tmp_path, monkeypatch):
    """Catches a sweep that ends badly because of a run of another sweep in the same folder of results, and a plan that
    is left of a sweep whose runs were all refused as they began."""
    words = ["+exp=mini", "scene=suzanne", "model=3dgs", f"results={tmp_path}"]
    ends = {"0": Ended(reason="step 0: nan"), "1": Ended("mini/record.json"), "2": Ended(reason="no", is_refused=True)}
    end = lambda run, folder, number: plan.write_ended(folder, number, ends[str(run.config.seed)])  # noqa: E731
    monkeypatch.setattr(launcher, "do_planned", end)
    monkeypatch.setattr(
        status, "_kept", lambda _, run: run and run.ended.record and RecordStatus(tmp_path, "ok", None, 20.0, 0.0)
    )
    with hydra_with(None):
        outcomes = [launcher.launch([compose_run([*words, f"seed={seed}"])], None) for seed in ends]
    assert [[run.reason for run in outcome.broken] for outcome in outcomes] == [["step 0: nan"], [], []]
    assert [outcome.is_refused for outcome in outcomes] == [False, False, True]
    assert {outcome.experiment for outcome in outcomes} == {tmp_path / "mini"}
    assert len(plan.find(tmp_path / "mini")) == 2


def test_plans_are_read_oldest_first(tmp_path):
    """Catches plans in the order of the file system: the status of a run is that of its last sweep."""
    names = [f"2026-01-{day:02}" for day in (3, 11, 9, 2, 8, 4, 27)]
    for name in names:
        (tmp_path / plan.FOLDER / name).mkdir(parents=True)
        (tmp_path / plan.FOLDER / name / plan.FILE_NAME).touch()
    assert [path.parent.name for path in plan.find(tmp_path)] == sorted(names)


@pytest.mark.parametrize(
    ("error", "reason", "is_refused", "traces"),
    [
        (MemoryError("full"), "out of memory: full", False, False),
        (ValueError("a\nb"), "ValueError: a", False, True),
        (UnrecordedError("no record"), "no record", False, False),
        (InputError("no scene"), "no scene", True, False),
    ],
)
def test_a_run_that_raises_ends_with_a_reason(error, reason, is_refused, traces, tmp_path, monkeypatch, capsys):
    """Catches an error that ends the sweep, one told as another, and a stack trace for what users can mend."""
    monkeypatch.setattr(execution, "execute", lambda _: (_ for _ in ()).throw(error))
    with hydra_with(None):
        ended = processes.do(compose_run(["+exp=mini", "scene=suzanne", f"results={tmp_path}"]))
    assert ended == Ended(reason=reason, is_refused=is_refused)
    errors = capsys.readouterr().err
    assert errors.endswith(f"gsbench: error: suzanne: {reason}\n")
    assert ("Traceback" in errors) == traces


def test_a_path_that_only_a_node_knows_is_left_to_its_job(tmp_path, monkeypatch):
    """Catches TMPDIR of a node that is refused before its job, one not refused here, and a stack trace there."""
    monkeypatch.delenv("DISK_OF_NODE", raising=False)
    words = ["+exp=dnerf", "scene=trex", "data.root=${oc.env:DISK_OF_NODE}", f"results={tmp_path}"]
    with hydra_with(None):
        with pytest.raises(InputError, match="DISK_OF_NODE"):
            compose_run(words)
        ended = processes.do(compose_run([*words, "+launch=slurm"]))
    assert ended.is_refused
    assert "DISK_OF_NODE" in str(ended.reason)


def test_a_run_looks_for_its_parent_without_haste(monkeypatch):
    """Catches a thread that takes a CPU from the training, and a run that goes on when its parent is gone."""
    parents, done = iter([7, 7, 1]), list[Any]()
    monkeypatch.setattr(os, "getppid", lambda: next(parents))
    monkeypatch.setattr(os, "kill", lambda *call: done.append(call))
    monkeypatch.setattr(time, "sleep", done.append)
    processes._end_with(7)
    assert done == [processes.POLL, processes.POLL, (os.getpid(), signal.SIGTERM)]


def test_without_slurm_the_error_says_where_to_go(monkeypatch, tmp_path, capsys):
    """Catches an error of submitit that only asks whether this is a cluster."""
    monkeypatch.setenv("PATH", str(tmp_path))
    words = ["-m", "+exp=mini", "scene=suzanne", "model=3dgs", "+launch=slurm", f"results={tmp_path / 'results'}"]
    assert main_here(*words) == 2
    message = capsys.readouterr().err.splitlines()[-1]
    assert message.startswith("gsbench: error: +launch=slurm: expected a machine of a Slurm cluster, sbatch is not on")
    assert message.endswith("(docs/runs.md#slurm-from-a-login-node-to-the-table)")


def test_the_time_left_is_that_of_the_runs_that_have_not_ended(tmp_path):
    """Catches runs that were kept and count as trained in no time, runs that failed and are waited for, runs at once
    that are added up, and a line that divides by nothing."""
    plan.write(Plan("local", [[f"seed={i}"] for i in range(10)]), tmp_path)
    assert plan.time_left(tmp_path, 2) == ""
    plan.write_ended(tmp_path, 0, Ended("record.json", None))  # kept
    assert plan.time_left(tmp_path, 2) == ""
    plan.write_ended(tmp_path, 1, Ended("record.json", None, seconds=30.0))
    plan.write_ended(tmp_path, 2, Ended("record.json", None, seconds=50.0))
    assert plan.time_left(tmp_path, 2) == "3 of 10 runs have ended; about 2 min left"
    assert plan.time_left(tmp_path, 1) == "3 of 10 runs have ended; about 5 min left"
    for number in range(3, 9):
        plan.write_ended(tmp_path, number, Ended(None, "it ended without a record"))
    assert plan.time_left(tmp_path, 4) == "9 of 10 runs have ended; about 40 s left"
    plan.write_ended(tmp_path, 9, Ended("record.json", None, seconds=1.0))
    assert plan.time_left(tmp_path, 2) == ""


def test_a_sweep_has_the_bits_of_one_process_and_a_retry_does_what_is_missing(square, tmp_path):
    """Catches runs that depend on the process they share, a sweep that says nothing until its end, one that is repeated
    and expects its kept runs to train, an outcome that a run of a process of its own writes without its record, and a
    retry that loses a run's overrides, trains a finished run again, or hides that nothing is left. In a process of its
    own: `+launch=parallel` forks, and a fork of a process with threads can wait for them forever."""
    for launch in ("local", "parallel"):
        experiment = tmp_path / launch / "dnerf"
        more = ("model=3dgs", "train.iterations=2", "seed=0,1", f"+launch={launch}", "launch.at_once=1")
        words = [word for word in overrides(square, tmp_path / launch, *more) if not word.startswith(SCENE)]
        first = gsbench("-m", *words)  # scene=all: the scene has no file in conf/
        assert first.returncode == 0, first.stderr
        assert len(re.findall(r"1 of 2 runs have ended; about \d+ s left\n", first.stderr)) == 1
        assert "gsbench: error" not in first.stderr
        (folder,) = experiment.glob(".sweep/*")
        assert [outcome.reason for outcome in plan.read_ended(folder).values()] == [None, None]
        assert states(experiment) == ["done", "done"]
        again = gsbench("-m", *words)
        assert again.returncode == 0, again.stderr
        assert "have ended" not in again.stderr
    kept, lost = sorted(path.parent for path in experiment.rglob("record.json"))
    for run in (kept, lost):
        assert_same_bits(bits(run), bits(tmp_path / "local" / run.relative_to(tmp_path / "parallel")))
    before = kept.joinpath("record.json").stat().st_mtime_ns, bits(lost)
    shutil.rmtree(lost)
    assert states(experiment) == ["done", "failed"]
    again = python_m("gsbench.launch", "retry", str(experiment))
    assert again.returncode == 0, again.stderr
    assert "1 runs again" in again.stderr
    assert states(experiment) == ["done", "done"]
    assert kept.joinpath("record.json").stat().st_mtime_ns == before[0]
    assert_same_bits(bits(lost), before[1])
    assert "no run was stopped, failed" in python_m("gsbench.launch", "retry", str(experiment)).stderr
