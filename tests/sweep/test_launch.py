"""Sweeps as they are launched: the plan, several processes, retry, and ablations that change what they say."""

import json
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import crowd
import pytest
import torch
from forked import python_m
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from tiny_run import gsbench, main_here, overrides, write_moving_square

from gsbench.config import CONF, register_schema
from gsbench.config_roles import flat
from gsbench.errors import InputError
from gsbench.sweep import callbacks, plan, status
from gsbench.sweep.__main__ import main as sweep_main
from gsbench.sweep.plan import Plan, identity
from gsbench.sweep.retry import retry
from gsbench.train import checkpoint

SCENE = ("scene=", "scene.name=")
ABLATIONS = {  # what each changes of 7DGS as it is; of another model, only its name
    "none": {},
    "no_agr": {"agr": False},
    "fixed_lambda": {"model.lr.lambda.start": 0.0},
    "no_time_split": {"model.options.split_in_time": False},
    "time_only": {"model.name": "4dgs"},
    "direction_only": {"model.name": "6dgs"},
    "no_effects": {"model.name": "3dgs"},
    "paper_order": {"model.options.factor_order": "paper"},
    "schur": {"model.options.scheme": "schur"},
    "cholesky": {"model.options.scheme": "cholesky"},
    "raw_off_diagonal": {"model.options.off_diagonal": "raw"},
    "row_scaled": {"model.options.off_diagonal": "row_scaled"},
}


@pytest.fixture
def square(tmp_path: Path) -> Path:
    return write_moving_square(tmp_path / "data")


@pytest.fixture
def composer() -> Iterator[None]:
    register_schema()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        yield


def composed(*words: str, **more: Any) -> DictConfig:
    return compose("config", ["+exp=ablation", "scene=suzanne", *words], **more)


def sweep(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run `python -m gsbench.sweep`."""
    return python_m("gsbench.sweep", *arguments)


def states(experiment: Path) -> list[str]:
    return sorted(run.state for run in status.status(status.read(experiment)))


@pytest.mark.usefixtures("composer")
@pytest.mark.parametrize("name", ABLATIONS)
def test_an_ablation_changes_what_it_says_and_nothing_else(name: str) -> None:
    """Catches an ablation that is the whole model, or one that changes a second thing."""
    whole, changed = (dict(flat(OmegaConf.to_container(composed(f"+ablation={one}"), resolve=True)))  # type: ignore[arg-type]
                      for one in ("none", name))  # fmt: skip
    other = "model.name" in ABLATIONS[name]
    differs = {key: value for key, value in changed.items() if whole.get(key) != value}
    assert (differs | ABLATIONS[name] == differs) if other else (differs == ABLATIONS[name])
    assert not other or changed["agr"] is True  # AGR stays, so that only the effects differ


@pytest.mark.usefixtures("composer")
def test_the_ablation_sweeps_over_all_ablations_by_itself() -> None:
    """Catches an ablation that is shipped and not in the sweep, and a plan that forgets the experiment's own axes."""
    loader = GlobalHydra.instance().config_loader()
    config = loader.load_configuration("config", ["+exp=ablation", "scene=a,b"], run_mode=RunMode.MULTIRUN)
    asked = [
        word.removeprefix("+ablation=")
        for run in callbacks.expand(config)
        for word in run
        if word.startswith("+ablation=")
    ]
    assert sorted(asked) == sorted([*ABLATIONS, *ABLATIONS])
    assert {path.stem for path in (CONF / "ablation").glob("*.yaml")} == set(ABLATIONS)


def test_launch_settings_change_no_number() -> None:
    """Catches a partition, or a results folder, that makes another run of the same run."""
    words = ["model=7dgs", "+launch=slurm", "launch.partition=gpu", "+launch.sbatch.qos=x", "results=r", "resume=false"]
    assert identity([*words, "+exp=mini"]) == ("+exp=mini", "model=7dgs")


def test_retry_takes_only_settings_of_the_launch(tmp_path: Path) -> None:
    """Catches a retry that may change what its runs are."""
    with pytest.raises(InputError, match=r"launch\.memory=16G, got 'train\.iterations=5'"):
        retry(status.read(tmp_path), ["train.iterations=5"], print)
    with pytest.raises(InputError, match=r"retry: config key 'launch\.nosuch' is not known"):
        retry(status.read(tmp_path), ["launch.nosuch=1"], print)


def test_retry_passes_over_what_cannot_be_launched(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
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
        one = Plan("basic", [words], [], cwd, "elsewhere", 1, 1, 0.0)
        plan.write(one, experiment / plan.FOLDER / f"2026-11-22_00-00-0{number}.000000")
    assert sweep_main(["retry", str(experiment)]) == 1  # they are lost as before
    told = [line for line in capsys.readouterr().err.splitlines() if "cannot be launched again" in line]
    reasons = (f"'{gone}'", "Did you mean 'iterations'", "at input '['", "launch.at_once: expected at least 1")
    for line, said in zip(sorted(told), reasons, strict=True):
        assert said in line


def test_retry_names_the_command_of_a_run_that_is_of_no_sweep(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches a retry that says that no run failed, beside a status that lists one."""
    run = ("7dgs", "lego", 0)
    folder = tmp_path / "mini" / "lego" / "7dgs" / "seed0"
    folder.mkdir(parents=True)
    broken = crowd.record(*run) | {"status": "failed", "reason": "out of memory"}
    (folder / "record.json").write_text(json.dumps(broken, default=str))
    assert sweep_main(["retry", str(tmp_path / "mini")]) == 1
    said = capsys.readouterr().err
    assert f"python -m gsbench {' '.join(identity(crowd.overrides(*run)))} results={tmp_path}" in said
    assert "no run was stopped" not in said


def test_a_retry_launches_with_the_settings_that_it_was_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches more memory that is asked for and never given, and a run that loses what decides its numbers."""
    monkeypatch.chdir(tmp_path)  # a retry goes to where the command was given
    experiment = tmp_path / "mini"
    words = ["+exp=mini", "model=4dgs", "seed=3", "launch.memory=8G", "results=elsewhere"]
    asked = Plan("basic", [words], [], str(tmp_path), "elsewhere", 1, 1, 0.0)
    plan.write(asked, experiment / plan.FOLDER / "2026-11-22_00-00-00.000000")
    launched: list[DictConfig] = []
    assert retry(status.read(experiment), ["launch.memory=16G"], launched.append) == 1
    (config,) = launched
    assert (config.model.name, config.seed, config.launch.memory) == ("4dgs", 3, "16G")
    assert config.results == str(tmp_path)


def test_retry_does_what_is_missing_and_repeats_nothing(square: Path, tmp_path: Path) -> None:
    """Catches a retry that loses a run's overrides, trains a finished run again, or hides that nothing is left."""
    results = tmp_path / "results"
    words = [word for word in overrides(square, results, "model=3dgs", "seed=0,1") if not word.startswith(SCENE)]
    assert gsbench("-m", *words).returncode == 0  # scene=all: the scene has no file in conf/
    experiment = results / "dnerf"
    kept, lost = sorted(experiment.rglob("record.json"))
    assert states(experiment) == ["done", "done"]
    before = kept.stat().st_mtime_ns, lost.read_text()
    shutil.rmtree(lost.parent)
    assert states(experiment) == ["done", "failed"]
    again = sweep("retry", str(experiment))
    assert again.returncode == 0, again.stderr
    assert "1 runs again" in again.stderr
    assert states(experiment) == ["done", "done"]
    assert kept.stat().st_mtime_ns == before[0]
    assert json.loads(lost.read_text())["metrics"] == json.loads(before[1])["metrics"]
    assert "no run was stopped, failed" in sweep("retry", str(experiment)).stderr


@pytest.mark.slow
def test_several_processes_give_the_bits_of_one(square: Path, tmp_path: Path) -> None:
    """Catches runs that depend on the process they share, or on how many run beside them."""
    for launch in ("local", "parallel"):
        words = overrides(square, tmp_path / launch, f"+launch={launch}", "launch.at_once=2", "model=7dgs", "seed=0,1")
        assert gsbench("-m", *words).returncode == 0
        assert states(tmp_path / launch / "dnerf") == ["done"] * 2
    for path in sorted((tmp_path / "local").rglob("checkpoint.pt")):
        other = tmp_path / "parallel" / path.relative_to(tmp_path / "local")
        one, two = (checkpoint.read(file).state["model"] for file in (path, other))
        assert all(torch.equal(one[name], two[name]) for name in one)
        metrics = [json.loads(file.with_name("record.json").read_text())["metrics"] for file in (path, other)]
        assert metrics[0] == metrics[1]


def test_without_slurm_the_error_says_where_to_go(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches an error of submitit that only asks whether this is a cluster."""
    monkeypatch.setenv("PATH", str(tmp_path))
    words = ["-m", "+exp=mini", "scene=suzanne", "model=3dgs", "+launch=slurm", f"results={tmp_path / 'results'}"]
    assert main_here(*words) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith("gsbench: error: +launch=slurm: expected a machine of a Slurm cluster, srun is not on PATH")
    assert said.endswith("(docs/runs.md#slurm-from-a-login-node-to-the-table)")
