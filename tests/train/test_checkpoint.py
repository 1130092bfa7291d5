"""Checkpoints: a run that was killed ends with the bits of one that was not, and a bad file is refused."""

import json
import os
import pickle
import signal
import time
import tracemalloc
from pathlib import Path

import pytest
import torch
from forked import Forked
from interrupted import REPRODUCED, TIMES, assert_resumes, assert_same_bits, without_times
from test_early_stop import with_val
from tiny_run import gsbench, overrides, run_here
from tiny_training import trainer

from gsbench.errors import InputError
from gsbench.measure import record
from gsbench.train import checkpoint
from gsbench.train.checkpoint import Checkpoint
from gsbench.train.hooks.average import Average

RUN = (
    *("model=7dgs", "train.iterations=60", "train.densify.every=10", "train.checkpoint_minutes=0"),
    "data.initial_points=60",
)
ROUNDS = (
    *("train.densify.start=0", "train.densify.stop=50", "train.densify.every=10"),
    *("train.iterations=60", "train.recipe_iterations=60", "train.refine_from=0"),
)
MULTIVIEW = ("train.densify.kind=multiview", "train.densify.grad_threshold=1e-6")


def final_state(results: Path) -> dict[str, object]:
    (path,) = results.rglob(checkpoint.FILE_NAME)
    return checkpoint.read(path).state


def comparable_state(results: Path) -> object:
    return without_times(final_state(results))


def test_a_killed_run_ends_with_the_bits_of_an_unbroken_one(square, tmp_path):
    """Catches anything that the next step depends on and the checkpoint lacks: SIGKILL twice, at no chosen moment. The
    model has everything there is to lose: AGR, moments of cloned and split Gaussians, statistics of density control,
    the order of views, trained lambdas."""
    whole, _ = run_here(*overrides(square, tmp_path / "whole", *RUN))
    broken, words, step = tmp_path / "broken", overrides(square, tmp_path / "broken", *RUN), 0
    for _ in range(2):
        process, start, deadline = Forked(tmp_path, "gsbench", *words), step, time.monotonic() + 120
        while step < start + 12 and time.monotonic() < deadline:
            assert process.poll() is None, "the run ended before it could be killed"
            time.sleep(0.01)
            step = next((checkpoint.read(path).state["step"] for path in broken.rglob(checkpoint.FILE_NAME)), 0)
        process.send_signal(signal.SIGKILL)
        process.wait()
        spent = final_state(broken)["effort"]["cpu_s"]
        assert start < step < 60
    done = gsbench(*words)
    assert done.returncode == 0, done.stderr
    assert "continues from step" in done.stderr
    assert_same_bits(comparable_state(tmp_path / "whole"), comparable_state(broken))
    (path,) = record.find(broken)
    resumed = record.read(path)
    assert whole.metrics == resumed.metrics
    for steps in (whole.parts["steps"], resumed.parts["steps"]):  # those before the last attempt count too
        assert steps["launched"] + steps["replayed"] == whole.curve[-1].iteration
        assert 0 < steps["recordings"] < steps["launched"]
    assert resumed.cost.train_cpu_s > spent > 0, "CPU-seconds of the last attempt alone"
    assert [point.psnr_val for point in whole.curve] == [point.psnr_val for point in resumed.curve]
    lines = [json.loads(line) for line in path.with_name("curve.jsonl").read_text().splitlines()]
    assert [line["iteration"] for line in lines] == [point.iteration for point in resumed.curve]


@pytest.mark.parametrize(
    ("start", "step"),
    [
        (lambda: trainer("7dgs", *ROUNDS, "train.densify.kind=mcmc", "train.average_from=40"), 55),
        (lambda: trainer("7dgs", *ROUNDS, *MULTIVIEW, "model.min_opacity=0.09"), 25),
        (lambda: with_val({60: 50.0}, "effects.gate=off"), 67),
    ],
    ids=["relocation and average", "several views", "patience"],
)
def test_a_training_continues_from_its_state(start, step):
    """Catches random numbers, sums, scores or counts of a rule or a hook that a checkpoint does not have,
    and a checkpoint that has lost the best iteration, or how long ago it was."""
    whole, stopped = assert_resumes(start, step)
    if step == 55:
        assert len(whole.model) > len(start().model)
        assert stopped.hook(Average).count == 1  # of step 50: it started anew with the round before
        assert whole.hook(Average).count == 0
    if step == 25:
        assert len(whole.model) > len(stopped.model)


def test_every_key_of_a_state_is_reproduced_or_a_time(square, tmp_path):
    """Catches a new key of the state that nobody sorted: seconds among what must be equal failed every comparison once.
    Gates are in the state too, and measure times of their own."""
    words = (*RUN, "effects.gate=end", "effects.budget_db=10")
    for name in ("one", "two"):
        run_here(*overrides(square, tmp_path / name, *words))
    state = final_state(tmp_path / "one")
    assert state.keys() <= REPRODUCED | TIMES
    assert not REPRODUCED & TIMES
    assert keys(state) >= REPRODUCED | TIMES, "a name that no state has any more"
    assert_same_bits(comparable_state(tmp_path / "one"), comparable_state(tmp_path / "two"))


def keys(state: object) -> set[str]:
    """All keys in a state, at any depth."""
    if isinstance(state, dict):
        return {str(key) for key in state}.union(*map(keys, state.values()))
    return set().union(*map(keys, state)) if isinstance(state, list) else set()


class Exploit:
    """Pickled, a file that makes a folder named `owned` when it is loaded carelessly."""

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return (os.mkdir, ("owned",))


@pytest.mark.parametrize("state", [None, [], {}, {"seen": 1}, {"seen": torch.zeros(3)}, {"seen": torch.zeros(2).int()}])
def test_a_tensor_of_a_checkpoint_is_the_one_expected(state):
    """Catches a stack trace for a part of another kind, and a tensor that broadcasts or is converted."""
    with pytest.raises(InputError, match="checkpoint: expected 'seen' as "):
        checkpoint.tensor(state, "seen", (2,), torch.float32)


@pytest.mark.filterwarnings("ignore:Detected pickle protocol")
@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 not a zip", pickle.dumps(Exploit()), json.dumps({}).encode()])
def test_a_file_that_is_no_checkpoint_is_refused(content, tmp_path, monkeypatch):
    """Catches a stack trace for a damaged file, and code that runs because a file says so."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / checkpoint.FILE_NAME
    path.write_bytes(content)
    with pytest.raises(InputError, match="start over with resume=false"):
        checkpoint.load(path, "config", "data", "cpu")
    assert not Path("owned").exists()


def test_a_checkpoint_is_written_without_a_copy_in_memory(tmp_path):
    """Catches a state of gigabytes that is copied to write it: a training at the limit of the memory would end then."""
    state = {"model": torch.zeros(1 << 20)}
    tracemalloc.start()
    checkpoint.save(tmp_path / checkpoint.FILE_NAME, Checkpoint("settings", "data", state))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < state["model"].nbytes / 2


def test_a_checkpoint_of_another_run_is_not_taken(tmp_path):
    """Catches a run that goes on from another config's or another data set's parameters."""
    path = tmp_path / checkpoint.FILE_NAME
    assert checkpoint.load(path, "training", "data", "cpu") is None
    checkpoint.save(path, Checkpoint("training", "data", {"step": 3}))
    assert checkpoint.load(path, "training", "data", "cpu") == {"step": 3}
    assert checkpoint.load(path, "other", "data", "cpu") is None
    assert checkpoint.load(path, "training", "other", "cpu") is None
