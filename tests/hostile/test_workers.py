"""The pool itself: every kind of failure is found, named with its seed and its input, and survived."""

import os
import signal
import time
import warnings
from pathlib import Path

import pytest
import workers
from workers import Case, Pool

from gsbench.errors import InputError


def fail(error: Exception) -> None:
    raise error


ENDS = {
    "accepted": lambda: None,
    "refused": lambda: fail(InputError("expected this, got that")),
    "raised": lambda: fail(KeyError("depths")),
    "died": lambda: os.kill(os.getpid(), signal.SIGSEGV),
    "two lines": lambda: fail(InputError("expected\nthis")),
    "hung": lambda: time.sleep(60),
    "warned": lambda: warnings.warn("from the depths", stacklevel=1),
}


def draw(seed: int, _: Path) -> Case:
    name = list(ENDS)[seed]
    return Case(f"the case that is {name}", ENDS[name])


@pytest.mark.slow
def test_failures_are_named_with_seed_and_input(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a pool that lets a signal, a hang, a warning or a stack trace pass for a clear message."""
    monkeypatch.setattr(workers, "LIMIT_S", 5)
    pool = Pool(tmp_path)
    try:
        with pytest.raises(AssertionError, match="5 of 7 cases failed") as caught:
            pool.check(__name__, len(ENDS))
        pool.check("test_ply", 20)
    finally:
        pool.stop()
    message = str(caught.value)
    for seed, name in enumerate(ENDS):
        assert (f'test_workers.draw({seed}): "the case that is {name}"' in message) == (seed >= 2)
    assert "exit status -11" in message
    assert "no answer within 5 s" in message
