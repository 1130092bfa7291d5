"""Sweeps in several processes that get a signal: each run saves, none is lost, and the same command gives its bits."""

import os
import random
import re
import signal
import time
from pathlib import Path

import pytest
from forked import Forked
from interrupted import assert_same_bits, bits
from tiny_run import gsbench, main_here, overrides

from gsbench.launch import plan, status
from gsbench.run import progress
from gsbench.train import checkpoint

RUNS = 3
LONG, SHORT = "train.iterations=100000", "train.iterations=1500"
ENDED = {"stopped", "not started", "done"}


def words(data: Path, results: Path, iterations: str) -> list[str]:
    """A sweep of RUNS seeds, two at a time."""
    return ["-m", *overrides(data, results, iterations, "train.densify.stop=1", "model=3dgs", "seed=0,1,2"),
            "+launch=parallel", "launch.at_once=2"]  # fmt: skip


def workers(results: Path, parent: int) -> list[int]:
    """The processes of the runs that train."""
    at = [path for path in results.rglob(progress.FILE_NAME) if path.exists()]
    pids = [progress.read(path).pid for path in at if progress.read(path).steps]
    assert parent not in pids
    return pids


def wait_for(count: int, results: Path, sweep: Forked) -> list[int]:
    """Wait until so many runs of a sweep train, and return their processes."""
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline:
        assert sweep.poll() is None, sweep.err
        try:
            if len(pids := workers(results, sweep.pid)) == count:
                return pids
        except ValueError:  # a file was replaced or removed just now
            pass
        time.sleep(0.02)
    raise AssertionError(f"{count} runs do not train: {sweep.err}")


def states(results: Path) -> list[status.RunStatus]:
    return status.status(status.read(results / "dnerf"))


@pytest.mark.parametrize(
    ("at", "number"), [("parent", signal.SIGTERM), ("worker", signal.SIGHUP), ("all", signal.SIGINT)]
)
def test_a_signal_lets_each_run_save_and_no_other_begins(
    at: str, number: signal.Signals, square: Path, tmp_path: Path
) -> None:
    """Catches runs that are killed with their checkpoints, siblings that are lost, and processes left behind."""
    sweep = Forked(tmp_path, "gsbench", *words(square, tmp_path, LONG))
    running = wait_for(2, tmp_path, sweep)
    for pid in {"parent": [sweep.pid], "worker": running[:1], "all": [sweep.pid, *running]}[at]:
        os.kill(pid, number)
    assert sweep.wait() == 128 + number, sweep.err
    assert not any(Path(f"/proc/{pid}").exists() for pid in running)
    assert "Traceback" not in sweep.err
    assert f"gsbench: stopped by {number.name}" in sweep.err.splitlines()
    runs = states(tmp_path)
    assert sorted(run.state for run in runs) == ["not started", "stopped", "stopped"]
    saved = {checkpoint.read(path).state["step"] for path in tmp_path.rglob("checkpoint.pt")}
    assert saved == {run.step for run in runs if run.state == "stopped"}
    assert {int(step) for step in re.findall(r"stopped at step (\d+), saved in", sweep.err)} == saved
    assert {run.reason for run in runs} == {
        None, *(f"stopped at step {step} of 100000: the same command continues" for step in saved)
    }  # fmt: skip


def test_a_run_that_is_killed_leaves_the_others_alone(square: Path, tmp_path: Path) -> None:
    """Catches a sweep that ends as the kernel kills one of its runs for memory, and a run that is lost unsaid."""
    sweep = Forked(tmp_path, "gsbench", *words(square, tmp_path, "train.iterations=3000"))
    killed = wait_for(2, tmp_path, sweep)[0]
    assert Path(f"/proc/{killed}/oom_score_adj").read_text() == "500\n"
    os.kill(killed, signal.SIGKILL)
    assert sweep.wait() == 1
    assert "its process was ended by SIGKILL (memory may have run out): the same command continues" in sweep.err
    assert sorted(run.state for run in states(tmp_path)) == ["done", "done", "lost"]


def test_runs_end_with_their_parent(square: Path, tmp_path: Path) -> None:
    """Catches orphans that train for days after their sweep was killed, and work that is lost with it."""
    sweep = Forked(tmp_path, "gsbench", *words(square, tmp_path, LONG))
    running = wait_for(2, tmp_path, sweep)
    sweep.send_signal(signal.SIGKILL)
    sweep.wait()
    deadline = time.monotonic() + 60
    while any(progress.born(pid) for pid in running):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert sorted(run.state for run in states(tmp_path)) == ["not started", "stopped", "stopped"]


def test_a_stopped_run_is_listed_until_it_goes_on(square: Path, tmp_path: Path) -> None:
    """Catches a single run that is unknown once a signal stopped it, and one that is stopped for ever."""
    run = overrides(square, tmp_path, "model=3dgs", "train.iterations=40000", "train.densify.stop=1")
    process = Forked(tmp_path, "gsbench", *run)
    wait_for_training(tmp_path)
    process.send_signal(signal.SIGTERM)
    assert process.wait() == 143, process.err
    assert [run.state for run in states(tmp_path)] == ["stopped"]
    process = Forked(tmp_path, "gsbench", *run)
    wait_for_training(tmp_path)
    assert [run.state for run in states(tmp_path)] == ["running"]
    assert not list(tmp_path.rglob(progress.STOPPED))
    process.send_signal(signal.SIGKILL)
    process.wait()
    (lost,) = states(tmp_path)
    assert (lost.state, str(lost.reason).endswith(": the same command continues from its last checkpoint")) == (
        "lost",
        True,
    )


def wait_for_training(results: Path) -> None:
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        try:
            if any(progress.read(path).steps for path in results.rglob(progress.FILE_NAME)):
                return
        except ValueError:
            pass
        time.sleep(0.02)


@pytest.mark.parametrize("launch", ["local", "parallel"])
def test_a_sweep_that_is_refused_leaves_no_plan(launch: str, tmp_path: Path) -> None:
    """Catches eight runs that never started, for ever, after a command without data.root."""
    assert main_here("+exp=dnerf", f"results={tmp_path}", f"+launch={launch}") == 2
    assert not list(tmp_path.rglob(plan.FILE_NAME))
    assert not states(tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(12))
def test_a_signal_at_any_time_loses_nothing(seed: int, square: Path, tmp_path: Path) -> None:
    """Catches a moment in which a signal loses a run, a record or a bit: imports, loading, training and measuring."""
    draw = random.Random(seed)
    whole, results = tmp_path / "whole", tmp_path / "results"
    assert gsbench(*words(square, whole, SHORT)).returncode == 0
    sweep = Forked(tmp_path, "gsbench", *words(square, results, SHORT))
    time.sleep(draw.uniform(0.1, 4))
    running = [pid for pid in workers_now(results) if progress.born(pid)]
    target = draw.choice([[sweep.pid], running[:1] or [sweep.pid], [sweep.pid, *running]])
    number = draw.choice([signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
    for pid in target:
        if progress.born(pid):
            os.kill(pid, number)
    sweep.wait()
    assert {run.state for run in states(results)} <= ENDED, sweep.err
    assert not any(progress.born(pid) for pid in running)
    again = gsbench(*words(square, results, SHORT))
    assert again.returncode == 0, again.stderr
    assert [run.state for run in states(results)] == ["done"] * RUNS
    for path in whole.rglob("checkpoint.pt"):
        assert_same_bits(bits(path.parent), bits(results / path.parent.relative_to(whole)))


def workers_now(results: Path) -> list[int]:
    try:
        return workers(results, 0)
    except (ValueError, FileNotFoundError):
        return []
