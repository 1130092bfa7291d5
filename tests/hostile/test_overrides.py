"""Hostile overrides: a faulty value is refused in one line before step 0, and no training that finished is lost.

Every case is a run of three steps in this process with one to three random overrides. It may end well, or be refused.
"""

import errno
import io
import os
import random
import signal
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from types import FrameType
from typing import Any

import hydra
import pytest
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from tiny_run import overrides, write_moving_square

from gsbench.config import CONF, register_schema
from gsbench.config_roles import flat
from gsbench.errors import InputError
from gsbench.launch.command import compose_run, parse, runs_of
from gsbench.measure import record
from gsbench.run import progress
from gsbench.run.execution import execute
from gsbench.run.identity import identify
from gsbench.train import checkpoint

SAMPLE, ALL = 30, 700
NUMBERS = (
    *("0", "1", "-1", "2", "0.5", "1e-3", "1e39", "-1e-9", "nan", "inf", "-inf", "1.5"),
    *("9223372036854775807", "9223372036854775808", "1e400", "100000", "true", "null", "abc", "''", "[]", "{a: 1}"),
    *("no", "'\\0'", "../..", "pkg://nosuch", "/dev/zero", "/proc/self/mem", "cuda:7", "cpu:5", "é"),
)
LONG = ("train.iterations", "train.recipe_iterations", "data.initial_points", "protocol.renders")  # many are slow
SECONDS = 60


class TooLong(Exception):  # noqa: N818
    """A case that took longer than SECONDS."""


@pytest.fixture(scope="module")
def square(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    register_schema()
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        yield write_moving_square(tmp_path_factory.mktemp("data"))


def keys() -> list[str]:
    """Every key of the config, and some that are none."""
    composed = hydra.compose("config", ["+exp=mini", "scene=suzanne", "model=7dgs"])
    plain = OmegaConf.to_container(composed)
    assert isinstance(plain, dict)
    return [
        *(key for key, _ in flat(plain) if key != "results"),
        *("+foo", "+train.foo", "+model.options.foo", "+model.lr.means.foo", "~data.root", "~model.lr.motion"),
        *("model", "scene", "train", "protocol"),
    ]


def case(seed: int, known: list[str]) -> list[str]:
    draw = random.Random(seed)
    words = []
    for key in draw.sample(known, draw.choice((1, 1, 2, 3))):
        value = draw.choice(NUMBERS)
        if key in LONG and value in ("100000", "9223372036854775807"):
            value = "7"
        words.append(key if key.startswith("~") else f"{key}={value}")
    return words


def end(words: list[str], square: Path, results: Path) -> str:
    """Do the run of a case; how it ended."""
    model = random.Random(repr(words)).choice(("3dgs", "4dgs", "7dgs", "7dgs agr=false"))
    base = overrides(square, results, f"model={model.split()[0]}", *model.split()[1:], "train.curve_points=1")
    base = ["train.iterations=3" if word == "train.iterations=30" else word for word in base]
    try:
        (run_words, *_), _ = runs_of(parse([*base, *words]))
        composed = compose_run([*run_words, f"results={results}"]).config
        done = execute(identify(composed))
    except (InputError, HydraException, OmegaConfBaseException):
        return "refused"
    assert done is not None
    (path,) = record.find(results)
    assert record.read(path).status == done.status
    if done.status == "failed":
        assert done.reason
        assert "\n" not in done.reason
        assert "did not foresee" not in done.reason
        assert not list(results.rglob("checkpoint.pt")), f"trained, and then lost: {done.reason}"
    return done.status


@pytest.mark.parametrize("seeds", [range(SAMPLE), pytest.param(range(SAMPLE, ALL), marks=pytest.mark.slow)])
def test_hostile_overrides_are_refused_or_run(seeds, square, tmp_path):
    """Catches a stack trace, a hang, and a training that ends well and is then lost."""
    known, ends = keys(), dict.fromkeys(("refused", "ok", "failed", "diverged"), 0)

    def give_up(_: int, __: FrameType | None) -> None:
        raise TooLong

    before = signal.signal(signal.SIGALRM, give_up)
    try:
        for seed in seeds:
            words = case(seed, known)
            signal.alarm(SECONDS)
            try:
                with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
                    ends[end(words, square, tmp_path / str(seed))] += 1
            except Exception as error:
                raise AssertionError(f"case {seed}: {words}: {type(error).__name__}: {error}") from error
            finally:
                signal.alarm(0)
    finally:
        signal.signal(signal.SIGALRM, before)
    assert ends["refused"] + ends["failed"] > len(seeds) / 4
    assert ends["ok"] > 0


def test_a_full_disk_is_one_runs_end(square, tmp_path, monkeypatch):
    """Catches a disk without room for a record that ends the whole sweep in a stack trace, or loses the training."""
    composed, fsync = hydra.compose("config", overrides(square, tmp_path, "model=3dgs", "train.iterations=3")), os.fsync

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")  # as the system does, which names no file

    def full_for_checkpoints(descriptor: int) -> None:
        if os.fstat(descriptor).st_size > 10_000:
            full()
        fsync(descriptor)

    def run(seed: int, place: Any, name: str, replacement: Any) -> Any:
        composed.seed = seed
        with monkeypatch.context() as patched:
            patched.setattr(place, name, replacement)
            return execute(identify(composed))

    with pytest.raises(InputError, match="its record cannot be written: No space left on device"):
        run(0, record, "write", full)
    assert len(list(tmp_path.rglob("checkpoint.pt"))) == 1
    assert run(0, os, "fsync", fsync).status == "ok"
    failed = run(1, os, "fsync", full_for_checkpoints)
    (path,) = (written.with_name(checkpoint.FILE_NAME) for written in tmp_path.rglob("seed1/record.json"))
    assert (failed.status, failed.reason) == ("failed", f"{path}: No space left on device")
    failed = run(2, checkpoint, "save", full)
    assert failed.reason == f"{path.parents[1] / 'seed2'}: No space left on device"
    with pytest.raises(InputError, match=r"seed3: the run cannot be claimed: .*No space left on device"):
        run(3, progress, "create_atomically", full)
