"""Kill a run after some of its checkpoints, count its steps, and compare the states of two runs bit by bit."""

import copy
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from tiny_training import train

from gsbench.measure.record import Record
from gsbench.train import checkpoint
from gsbench.train.loop import Trainer

# Keys of a training's state whose values are bit-equal in all trainings with one seed, interrupted or not.
REPRODUCED = frozenset({"step", "model", "optimizer", "density", "hooks", "exact"})
# Keys of measured times, and of what only saves time, at any depth of the state. They differ between two trainings with
# one seed.
TIMES = frozenset({"stages", "effort", "replay", "curve", "seconds", "frame_ms_before", "frame_ms", "frame_ms_without"})


class Killed(BaseException):
    """The process ends here."""


def run_through_kills(
    saves: int, monkeypatch: pytest.MonkeyPatch, run: Callable[[], tuple[Record, Path]]
) -> tuple[Record, Path]:
    """Repeat a run that is killed after so many checkpoints until it finishes, and return its record and folder."""
    written, attempts, save = 0, 0, checkpoint.save

    def save_and_die(*arguments: Any) -> None:
        nonlocal written
        save(*arguments)
        written += 1
        if written == saves:
            raise Killed

    monkeypatch.setattr(checkpoint, "save", save_and_die)
    while True:
        written, attempts = 0, attempts + 1
        try:
            ended = run()
        except Killed:
            continue
        assert attempts > 1, "the run was never killed"
        return ended


def counted_steps(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """Count the training steps of all runs from now on, under "all"."""
    steps, descend = Counter[str](), Trainer.train_step

    def counted(self: Trainer) -> None:
        steps["all"] += 1
        descend(self)

    monkeypatch.setattr(Trainer, "train_step", counted)
    return steps


def assert_resumes(start: Callable[[], Trainer], step: int) -> tuple[Trainer, Trainer]:
    """Check that a training which goes on from its state after some steps ends with the bits of one that never stopped.

    Returns:
        The whole training, and the one that stopped.
    """
    whole, stopped = train(start()), train(start(), until=step)
    assert stopped.step == step
    resumed = start()
    resumed.load_state_dict(copy.deepcopy(stopped.state_dict()))
    ends = [without_times(trainer.state_dict()) for trainer in (whole, train(resumed))]
    assert_same_bits(*ends)
    return whole, stopped


def without_times(state: Any) -> Any:
    """Remove measured times from a training's state, so that two trainings with one seed can be compared bit by bit."""
    if isinstance(state, dict):
        return {key: without_times(value) for key, value in state.items() if key not in TIMES}
    return [without_times(value) for value in state] if isinstance(state, (list, tuple)) else state


def bits(folder: Path) -> dict[str, Any]:
    """The final state of a run without times and without what it chose on val, for `assert_same_bits`."""
    state = dict(checkpoint.read(folder / checkpoint.FILE_NAME).state)
    state["hooks"] = {name: hook for name, hook in state["hooks"].items() if name != "choices"}
    comparable: dict[str, Any] = without_times(state)
    return comparable


def assert_same_bits(a: Any, b: Any, where: str = "state") -> None:
    if isinstance(a, dict | list):
        assert type(a) is type(b), where
        assert len(a) == len(b), where
        for key in a if isinstance(a, dict) else range(len(a)):
            assert_same_bits(a[key], b[key], f"{where}.{key}")
    else:
        assert torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b, where
