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


def words(data: Path, results: Path, iterations: int) -> list[str]:
    """A sweep of three seeds, two at a time."""
    of_runs = (f"train.iterations={iterations}", "train.densify.stop=1", "model=3dgs", "seed=0,1,2")
    return ["-m", *overrides(data, results, *of_runs, "+launch=parallel", "launch.at_once=2")]


def workers(results: Path) -> list[int]:
    try:
        claims = [progress.read(path) for path in results.rglob(progress.FILE_NAME)]
    except ValueError:  # a file was replaced or removed just now
        return []
    return [claim.pid for claim in claims if claim.steps]


def states(results: Path) -> list[status.RunStatus]:
    return status.status(status.read(results / "dnerf"))


SAVED = ["not started", "stopped", "stopped"]


@pytest.mark.parametrize(
    ("at", "number", "code", "iterations", "ended"),
    [
        ("parent", signal.SIGTERM, 143, 100_000, SAVED),
        ("worker", signal.SIGHUP, 129, 100_000, SAVED),
        ("all", signal.SIGINT, 130, 100_000, SAVED),
        ("parent", signal.SIGKILL, -9, 100_000, SAVED),
        ("worker", signal.SIGKILL, 1, 3_000, ["done", "done", "lost"]),
    ],
)
def test_a_signal_lets_each_run_save_and_no_other_begins(at, number, code, iterations, ended, square, tmp_path):
    """Catches runs that are killed with their checkpoints, siblings that are lost, orphans that train for days after
    their sweep was killed, and a sweep that ends as the kernel kills one of its runs for memory."""
    sweep, deadline = Forked(tmp_path, "gsbench", *words(square, tmp_path, iterations)), time.monotonic() + 120
    while len(running := workers(tmp_path)) != 2:
        assert sweep.poll() is None, sweep.err
        assert time.monotonic() < deadline, sweep.err
        time.sleep(0.02)
    assert sweep.pid not in running
    assert Path(f"/proc/{running[0]}/oom_score_adj").read_text() == "500\n"
    for pid in {"parent": [sweep.pid], "worker": running[:1], "all": [sweep.pid, *running]}[at]:
        os.kill(pid, number)
    assert sweep.wait() == code, sweep.err
    while any(progress.born(pid) for pid in running) and number == signal.SIGKILL and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(progress.born(pid) for pid in running)
    runs = states(tmp_path)
    assert sorted(run.state for run in runs) == ended
    assert "Traceback" not in sweep.err
    if code > 128:
        assert f"gsbench: stopped by {number.name}" in sweep.err.splitlines()
    if code == 1:
        assert "its process was ended by SIGKILL (memory may have run out): the same command continues" in sweep.err
        return
    saved = {checkpoint.read(path).state["step"] for path in tmp_path.rglob("checkpoint.pt")}
    assert saved == {run.step for run in runs if run.state == "stopped"}
    assert {int(step) for step in re.findall(r"stopped at step (\d+), saved in", sweep.err)} == saved
    assert {run.reason for run in runs} == {
        None,
        *(f"stopped at step {step} of 100000: the same command continues" for step in saved),
    }


@pytest.mark.parametrize("launch", ["local", "parallel"])
def test_a_sweep_that_is_refused_leaves_no_plan(launch, tmp_path):
    """Catches eight runs that never started, for ever, after a command without data.root."""
    assert main_here("+exp=dnerf", f"results={tmp_path}", f"+launch={launch}") == 2
    assert not list(tmp_path.rglob(plan.FILE_NAME))
    assert not states(tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(12))
def test_a_signal_at_any_time_loses_nothing(seed, square, tmp_path):
    """Catches a moment in which a signal loses a run, a record or a bit: imports, loading, training and measuring."""
    draw = random.Random(seed)
    whole, results = tmp_path / "whole", tmp_path / "results"
    assert gsbench(*words(square, whole, 1500)).returncode == 0
    sweep = Forked(tmp_path, "gsbench", *words(square, results, 1500))
    time.sleep(draw.uniform(0.1, 4))
    running = [pid for pid in workers(results) if progress.born(pid)]
    target = draw.choice([[sweep.pid], running[:1] or [sweep.pid], [sweep.pid, *running]])
    number = draw.choice([signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
    for pid in target:
        if progress.born(pid):
            os.kill(pid, number)
    sweep.wait()
    assert {run.state for run in states(results)} <= {"stopped", "not started", "done"}, sweep.err
    assert not any(progress.born(pid) for pid in running)
    again = gsbench(*words(square, results, 1500))
    assert again.returncode == 0, again.stderr
    assert [run.state for run in states(results)] == ["done"] * 3
    for path in whole.rglob("checkpoint.pt"):
        assert_same_bits(bits(path.parent), bits(results / path.parent.relative_to(whole)))
