"""A run that is told to end: it saves, says so in one line, and goes on from there with the same bits."""

import os
import re
import signal
import subprocess
import time
from dataclasses import replace
from pathlib import Path

import pytest
from forked import Forked
from tiny_run import gsbench, overrides

from gsbench.errors import InputError
from gsbench.measure.atomic import HOST
from gsbench.run import progress, stop
from gsbench.train import checkpoint

LONG = ("model=3dgs", "train.iterations=100000", "train.curve_points=1", "train.densify.stop=1")


def started(*arguments: str, results: Path, folder: Path) -> Forked:
    """A run in a process of its own, once it trains; what it says goes to files in a folder."""
    process = Forked(folder, "gsbench", *arguments)
    deadline = time.monotonic() + 120
    while not trains(results, process.pid) and time.monotonic() < deadline:
        assert process.poll() is None, process.err
        time.sleep(0.02)
    return process


def trains(results: Path, pid: int) -> bool:
    """Whether a process has begun the training of the only run there is."""
    try:
        return any(at.pid == pid and at.steps > 0 for at in map(progress.read, results.rglob(progress.FILE_NAME)))
    except InputError:  # it was removed or replaced just now
        return False


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130), (signal.SIGUSR2, 140)])
def test_a_signal_saves_and_ends_in_one_line(number: signal.Signals, code: int, square: Path, tmp_path: Path) -> None:
    """Catches the minutes since the last checkpoint lost, a stack trace, and a run that looks as if it still ran."""
    results = tmp_path / "results"
    process = started(*overrides(square, results, *LONG), results=results, folder=tmp_path)
    process.send_signal(number)
    assert process.wait() == code, process.err
    errors = process.err
    assert "Traceback" not in errors
    match = re.search(r"stopped at step (\d+), saved in (.*): the same command continues from there", errors)
    assert match, errors
    assert checkpoint.read(Path(match[2])).state["step"] == int(match[1])
    assert not list(results.rglob(progress.FILE_NAME))
    assert not list(results.rglob("*.tmp"))


def test_a_run_that_another_process_does_is_left_to_it(square: Path, tmp_path: Path) -> None:
    """Catches two sweeps on one folder that train the same run twice, and a dead process that is waited for."""
    results = tmp_path / "results"
    process = started(*overrides(square, results, *LONG), results=results, folder=tmp_path)
    second = gsbench(*overrides(square, results, *LONG))
    assert second.returncode == 0, second.stderr
    assert f"left to process {process.pid}" in second.stderr
    process.send_signal(signal.SIGKILL)
    process.wait()
    (path,) = results.rglob(progress.FILE_NAME)
    assert not progress.is_alive(progress.read(path))
    third = started(*overrides(square, results, *LONG), results=results, folder=tmp_path)
    assert progress.read(path).pid == third.pid
    third.send_signal(signal.SIGKILL)
    third.wait()


@pytest.mark.parametrize("number", stop.SIGNALS)
def test_the_earlier_handler_acts_once_the_run_has_ended(number: int) -> None:
    """Catches a handler that stays after its run, so that the next signal is noted and nothing ends."""
    called = []
    before = signal.signal(number, lambda number, _: called.append(number))
    try:
        with stop.requested() as request:
            signal.raise_signal(number)
            assert (request.signal, called) == (number, [])
        signal.raise_signal(number)
        assert called == [number]
    finally:
        signal.signal(number, before)


def test_a_second_signal_ends_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a process that cannot be stopped while it saves to a disk that hangs, and one that `timeout` ends at
    once: it signals the process and then its group."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with stop.requested():
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)
            monkeypatch.setattr(stop, "SAME_REQUEST", 0.0)
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_signal_that_is_ignored_stays_ignored() -> None:
    """Catches a sweep in the background of a script that ends when its terminal is told Ctrl-C."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with stop.requested() as request:
            signal.raise_signal(signal.SIGINT)
            assert request.signal is None
    finally:
        signal.signal(signal.SIGINT, before)


def test_leftovers_of_killed_processes_go(square: Path, tmp_path: Path) -> None:
    """Catches folders that fill with parts of checkpoints, and a part that another process is just writing removed."""
    arguments = overrides(square, tmp_path, "model=3dgs", "train.iterations=3", "protocol.pictures=0")
    assert gsbench(*arguments).returncode == 0
    (record,) = tmp_path.rglob("record.json")
    dead = subprocess.Popen(["true"])
    dead.wait()
    parts = {pid: record.with_name(f".record.json.{HOST}.{pid}.0123abcd.tmp") for pid in (dead.pid, os.getpid())}
    for part in parts.values():
        part.write_bytes(b"{")
    assert gsbench(*arguments).returncode == 0
    assert [part.exists() for part in parts.values()] == [False, True]


def test_progress_can_be_read_and_a_later_process_with_its_number_is_not_it(tmp_path: Path) -> None:
    """Catches a lost run that counts as running because its process number was given away again."""
    here = progress.Progress(["seed=1"], step=3, steps=9, psnr_val=20.5)
    progress.write(tmp_path, here)
    assert progress.read(tmp_path / progress.FILE_NAME) == here
    assert progress.is_alive(here)
    assert here.born is not None
    assert not progress.is_alive(replace(here, born=here.born - 1))
    assert progress.is_alive(replace(here, host="elsewhere"))
    assert not progress.is_alive(replace(here, host="elsewhere", updated=here.updated - 2 * progress.SILENT))
