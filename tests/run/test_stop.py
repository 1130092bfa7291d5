"""A run that is told to end: it saves, says so in one line, and goes on from there with the same bits."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from forked import Forked
from tiny_run import overrides, run_here

from gsbench.errors import InputError
from gsbench.measure import atomic
from gsbench.run import progress, stop
from gsbench.train import checkpoint

LONG = ("model=3dgs", "train.iterations=100000", "train.curve_points=1", "train.densify.stop=1")


def trains(results: Path) -> bool:
    """Whether a process has begun the training of the only run there is."""
    try:
        return any(progress.read(path).steps > 0 for path in results.rglob(progress.FILE_NAME))
    except InputError:  # it was removed or replaced just now
        return False


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130), (signal.SIGUSR2, 140)])
def test_a_signal_saves_and_ends_in_one_line(number, code, square, tmp_path):
    """Catches the minutes since the last checkpoint lost, a stack trace, and a run that looks as if it still ran."""
    results = tmp_path / "results"
    process, deadline = Forked(tmp_path, "gsbench", *overrides(square, results, *LONG)), time.monotonic() + 120
    while not trains(results) and time.monotonic() < deadline:
        assert process.poll() is None, process.err
        time.sleep(0.02)
    process.send_signal(number)
    assert process.wait() == code, process.err
    errors = process.err
    assert "Traceback" not in errors
    match = re.search(r"stopped at step (\d+), saved in (.*): the same command continues from there", errors)
    assert match, errors
    assert checkpoint.read(Path(match[2])).state["step"] == int(match[1])
    assert not list(results.rglob(progress.FILE_NAME))
    assert not list(results.rglob("*.tmp"))


@pytest.mark.parametrize("number", stop.SIGNALS)
def test_a_signal_is_noted_while_a_run_lasts(number, monkeypatch):
    """Catches a handler that stays after its run, a process that cannot be stopped while it saves to a disk that hangs,
    one that `timeout` ends at once, as it signals the process and then its group, and Ctrl-C for a sweep in the
    background."""
    called = list[int]()

    def earlier(number: int, _: object) -> None:
        called.append(number)

    before = signal.signal(number, earlier)
    try:
        with stop.requested() as request:
            signal.raise_signal(number)
            signal.raise_signal(number)
            assert (request.signal, called) == (number, [])
            monkeypatch.setattr(stop, "SAME_REQUEST", 0.0)
            signal.raise_signal(number)
            assert called == [number]
        assert signal.getsignal(number) is earlier
        signal.signal(number, signal.SIG_IGN)
        with stop.requested() as request:
            signal.raise_signal(number)
            assert request.signal is None
    finally:
        signal.signal(number, before)


def test_a_second_request_ends_a_process_that_had_no_handler():
    """Catches a process that cannot be ended by its signal while it saves."""
    code = """
import os, signal
from gsbench.run import stop
stop.SAME_REQUEST = 0.0
with stop.requested() as request:
    os.kill(os.getpid(), signal.SIGTERM)
    assert request.signal == signal.SIGTERM
    os.kill(os.getpid(), signal.SIGTERM)
"""
    assert subprocess.run([sys.executable, "-c", code]).returncode == -signal.SIGTERM


def test_a_run_reports_once_an_interval(tmp_path, monkeypatch):
    """Catches a run that never reports after its start, which looks dead, and one that reports after each step."""
    clock = SimpleNamespace(monotonic=lambda: now, time=time.time)
    monkeypatch.setattr(progress, "time", clock)
    now = 5.0
    report = progress.Reporter(tmp_path, [], 100)
    for step in (10, 20):
        assert not report.is_due()
        now += progress.EVERY
        assert report.is_due()
        report(step, 1.0, None)
        assert progress.read(tmp_path / progress.FILE_NAME).step == step


def test_leftovers_of_killed_processes_go(square, tmp_path, monkeypatch):
    """Catches folders that fill with parts of checkpoints, and a part that another process is just writing removed."""
    words = overrides(square, tmp_path, "model=3dgs", "train.iterations=3", "protocol.pictures=0")
    _, folder = run_here(*words)
    dead = subprocess.Popen(["true"])
    dead.wait()
    parts = []
    for pid in (dead.pid, os.getpid()):
        with monkeypatch.context() as patched:
            patched.setattr(os, "getpid", lambda pid=pid: pid)
            parts.append(atomic._beside(folder / "record.json"))
        parts[-1].write_bytes(b"{")
    run_here(*words)
    assert [part.exists() for part in parts] == [False, True]
