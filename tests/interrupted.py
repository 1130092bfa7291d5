"""Kill a run after some of its checkpoints, count its steps, and compare the states of two runs bit by bit."""

from collections import Counter
from pathlib import Path
from typing import Any

import pytest
import torch

from gsbench.train import checkpoint
from gsbench.train.loop import Trainer


class Killed(BaseException):
    """The process ends here."""


def killed_after(saves: int, monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """Raise Killed after so many checkpoints; the next attempt clears the counter that is returned."""
    written, save = Counter[str](), checkpoint.save

    def save_and_die(*given: Any) -> None:
        save(*given)
        written["now"] += 1
        if written["now"] == saves:
            raise Killed

    monkeypatch.setattr(checkpoint, "save", save_and_die)
    return written


def counted_steps(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """Count the training steps of all runs from now on, under "all"."""
    steps, descend = Counter[str](), Trainer._descend

    def counted(self: Trainer) -> None:
        steps["all"] += 1
        descend(self)

    monkeypatch.setattr(Trainer, "_descend", counted)
    return steps


def bits(folder: Path) -> dict[str, Any]:
    """The final state of a run without times and without what it chose on val, for `assert_equal`."""
    state = dict(checkpoint.read(folder / checkpoint.FILE_NAME).state)
    del state["comparison"], state["length_choice"]
    found: dict[str, Any] = checkpoint.without_times(state)
    return found


def assert_equal(a: object, b: object) -> None:
    """Compare two states bit by bit."""
    if isinstance(a, dict):
        assert isinstance(b, dict)
        assert a.keys() == b.keys()
        for key in a:
            assert_equal(a[key], b[key])
    elif isinstance(a, list):
        assert isinstance(b, list)
        for x, y in zip(a, b, strict=True):
            assert_equal(x, y)
    elif isinstance(a, torch.Tensor):
        assert isinstance(b, torch.Tensor)
        assert torch.equal(a, b)
    else:
        assert a == b
