"""Checkpoints: a run that was killed ends with the bits of one that was not, and a bad file is refused."""

import json
import os
import pickle
import shutil
import signal
import time
import tracemalloc
from pathlib import Path

import pytest
import torch
from forked import Forked
from interrupted import assert_resumes, assert_same_bits
from tiny_run import gsbench, overrides, run_here
from tiny_training import trainer

from gsbench.errors import InputError
from gsbench.measure import record
from gsbench.train import checkpoint
from gsbench.train.checkpoint import Checkpoint
from gsbench.train.hooks.average import Average

RUN = (
    "model=7dgs",
    "train.iterations=60",
    "train.densify.every=10",
    "train.checkpoint_minutes=0",
    "data.initial_points=60",
)


@pytest.fixture(scope="module")
def whole(square: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of an unbroken run, which tests only read."""
    results = tmp_path_factory.mktemp("whole")
    done = gsbench(*overrides(square, results, *RUN))
    assert done.returncode == 0, done.stderr
    return results


def final_state(results: Path) -> dict[str, object]:
    (path,) = results.rglob(checkpoint.FILE_NAME)
    return checkpoint.read(path).state


def comparable_state(results: Path) -> object:
    return checkpoint.without_times(final_state(results))


def test_a_killed_run_ends_with_the_bits_of_an_unbroken_one(square: Path, whole: Path, tmp_path: Path) -> None:
    """Catches anything that the next step depends on and the checkpoint lacks: SIGKILL twice, at no chosen moment.

    The model has everything there is to lose: AGR, moments of cloned and split Gaussians, statistics of density
    control, the order of views, trained lambdas. A second unbroken run first: the same seed gives the same bits.
    """
    done = gsbench(*overrides(square, tmp_path / "again", *RUN))
    assert done.returncode == 0, done.stderr
    assert_same_bits(comparable_state(whole), comparable_state(tmp_path / "again"))

    killed_at = []
    for _ in range(2):
        process = Forked(tmp_path, "gsbench", *overrides(square, tmp_path / "broken", *RUN))
        start = killed_at[-1] if killed_at else 0
        deadline = time.monotonic() + 120
        step = start
        while step < start + 12 and time.monotonic() < deadline:
            assert process.poll() is None, "the run ended before it could be killed"
            time.sleep(0.01)
            saved = list((tmp_path / "broken").rglob(checkpoint.FILE_NAME))
            step = checkpoint.read(saved[0]).state["step"] if saved else 0
        process.send_signal(signal.SIGKILL)
        process.wait()
        killed_at.append(step)
        spent = final_state(tmp_path / "broken")["effort"]["cpu_s"]
    assert 0 < killed_at[0] < killed_at[1] < 60
    done = gsbench(*overrides(square, tmp_path / "broken", *RUN))
    assert done.returncode == 0, done.stderr
    assert "continues from step" in done.stderr
    assert_same_bits(comparable_state(whole), comparable_state(tmp_path / "broken"))

    scores = []
    for results in (whole, tmp_path / "broken"):
        (path,) = record.find(results)
        scores.append(record.read(path))
    assert scores[0].metrics == scores[1].metrics
    assert scores[1].cost.train_cpu_s > spent > 0, "CPU-seconds of the last attempt alone"
    assert [p.psnr_val for p in scores[0].curve] == [p.psnr_val for p in scores[1].curve]
    (log,) = (tmp_path / "broken").rglob("curve.jsonl")
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    assert [line["iteration"] for line in lines] == [p.iteration for p in scores[1].curve]


ROUNDS = ("train.densify.start=0", "train.densify.stop=50", "train.densify.every=10", "train.iterations=60",
          "train.recipe_iterations=60", "train.refine_from=0")  # fmt: skip


def test_relocation_and_averages_continue_from_a_checkpoint() -> None:
    """Catches random numbers or sums of relocation and of averages that a checkpoint does not have."""
    words = (*ROUNDS, "train.densify.kind=mcmc", "train.average_from=40")
    whole, stopped = assert_resumes(lambda: trainer("7dgs", *words), 55)
    assert len(whole.model) > len(trainer("7dgs", *words).model)
    assert stopped.hook(Average).count == 1  # of step 50: it started anew with the round before
    assert whole.hook(Average).count == 0


def test_scores_of_several_views_continue_from_a_checkpoint() -> None:
    """Catches random numbers, scores or counts of FastGS' rule that a checkpoint does not have."""
    words = (*ROUNDS, "train.densify.kind=multiview", "train.densify.grad_threshold=1e-6", "model.min_opacity=0.09")
    whole, stopped = assert_resumes(lambda: trainer("7dgs", *words), 25)
    assert len(whole.model) > len(stopped.model)


def test_a_reloaded_checkpoint_measures_the_same(square: Path, whole: Path, tmp_path: Path) -> None:
    """Catches a score that differs between the model in training and on disk (elsewhere 32.63 and 33.02 dB)."""
    results = shutil.copytree(whole, tmp_path / "copy")
    (path,) = record.find(results)
    first = record.read(path)
    path.unlink()
    done = gsbench(*overrides(square, results, *RUN))
    assert "continues from step 60" in done.stderr
    assert record.read(path).metrics == first.metrics


def test_every_key_of_a_state_is_reproduced_or_a_time(square: Path, whole: Path, tmp_path: Path) -> None:
    """Catches a new key of the state that nobody sorted: seconds among what must be equal failed every comparison once.

    Gates are in the state too, and measure times of their own.
    """
    assert final_state(whole).keys() <= checkpoint.REPRODUCED | checkpoint.TIMES
    assert not checkpoint.REPRODUCED & checkpoint.TIMES
    words = ("effects.gate=end", "effects.budget_db=10")
    for name in ("one", "two"):
        run_here(*overrides(square, tmp_path / name, *RUN, *words))
    state = final_state(tmp_path / "one")
    assert keys(state) >= checkpoint.REPRODUCED | checkpoint.TIMES, "a name that no state has any more"
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


@pytest.mark.filterwarnings("ignore:Detected pickle protocol")
@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 not a zip", pickle.dumps(Exploit()), json.dumps({}).encode()])
def test_a_file_that_is_no_checkpoint_is_refused(
    content: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a stack trace for a damaged file, and code that runs because a file says so."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / checkpoint.FILE_NAME
    path.write_bytes(content)
    with pytest.raises(InputError, match="start over with resume=false"):
        checkpoint.load(path, "config", "data", "cpu")
    assert not Path("owned").exists()


def test_a_checkpoint_is_written_without_a_copy_in_memory(tmp_path: Path) -> None:
    """Catches a state of gigabytes that is copied to write it: a training at the limit of the memory would end then."""
    state = {"model": torch.zeros(1 << 20)}
    tracemalloc.start()
    checkpoint.save(tmp_path / checkpoint.FILE_NAME, Checkpoint("settings", "data", state))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < state["model"].nbytes / 2


def test_a_checkpoint_of_another_run_is_not_taken(tmp_path: Path) -> None:
    """Catches a run that goes on from another config's or another data set's parameters."""
    path = tmp_path / checkpoint.FILE_NAME
    assert checkpoint.load(path, "training", "data", "cpu") is None
    checkpoint.save(path, Checkpoint("training", "data", {"step": 3}))
    assert checkpoint.load(path, "training", "data", "cpu") == {"step": 3}
    assert checkpoint.load(path, "other", "data", "cpu") is None
    assert checkpoint.load(path, "training", "other", "cpu") is None
