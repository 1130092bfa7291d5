"""A run is claimed before it is done: of equal commands one trains, and what a killed one left is taken over."""

import errno
import multiprocessing
import os
import re
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from dataclasses import replace
from multiprocessing.synchronize import Barrier
from pathlib import Path

import pytest
from tiny_run import ROOT, command, environment, overrides, write_moving_square

from gsbench.errors import InputError
from gsbench.measure import atomic
from gsbench.run import progress
from gsbench.run.progress import Progress

CROWD, ROUNDS = 6, 15
HERE = socket.gethostname()


def compete(folder: Path, start: Barrier, ended: Barrier) -> None:
    """Claim a run in many rounds at the same moment as others do, and note who had it."""
    for number in range(ROUNDS):
        at, claim = folder / str(number), Progress(["seed=0"])
        start.wait(60)
        if progress.take_claim(at, claim) is None:
            (at / f"won.{os.getpid()}").touch()
        ended.wait(60)  # the winner lives until all have asked


@pytest.mark.parametrize("left", ["nothing", "a dead claim", "half a claim"])
@pytest.mark.parametrize("locks", [True, False])
def test_of_many_processes_one_has_the_run(
    left: str, locks: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a claim that is looked for and then made, so that several make it, and one that nobody takes over."""
    if not locks:
        monkeypatch.setattr(progress, "_locked", without_locks)
    one_of_many_has_each_run(tmp_path, [tmp_path], left)


@pytest.mark.parametrize("left", ["nothing", "a dead claim", "half a claim"])
def test_of_many_processes_on_two_mounts_one_has_the_run(left: str, two_mounts: list[Path], tmp_path: Path) -> None:
    """Catches a run that two hosts do, as their mounts share no locks and show each other's files late."""
    one_of_many_has_each_run(tmp_path / "disk", two_mounts, left)


@pytest.fixture
def two_mounts(tmp_path: Path) -> Iterator[list[Path]]:
    """Two mounts of the folder `disk`, each with locks and a cache of names and attributes of its own, as on NFS."""
    if shutil.which("bindfs") is None or not os.access("/dev/fuse", os.W_OK):
        pytest.skip("needs bindfs and FUSE")
    mounts = [tmp_path / name for name in ("one", "other")]
    mounted = []
    (tmp_path / "disk").mkdir()
    try:
        for mount in mounts:
            mount.mkdir()
            cached = "attr_timeout=5,entry_timeout=5"
            if subprocess.run(["bindfs", "-o", cached, tmp_path / "disk", mount], check=False).returncode:
                pytest.skip("FUSE cannot be mounted here")
            mounted.append(mount)
        yield mounts
    finally:
        for mount in mounted:
            subprocess.run(["fusermount", "-u", "-z", mount], check=True)


def one_of_many_has_each_run(disk: Path, mounts: list[Path], left: str) -> None:
    """Let processes compete by several mounts of one disk, with what is left of an earlier claim."""
    for number in range(ROUNDS):
        (disk / str(number)).mkdir()
        if left == "a dead claim":
            progress.write(disk / str(number), Progress(["seed=0"], born=1))
        elif left == "half a claim":
            (disk / str(number) / progress.FILE_NAME).write_text('{"overrides": [')
    fork = multiprocessing.get_context("fork")
    start, ended = fork.Barrier(CROWD), fork.Barrier(CROWD)
    crowd = [fork.Process(target=compete, args=(mounts[i % len(mounts)], start, ended)) for i in range(CROWD)]
    for process in crowd:
        process.start()
    for process in crowd:
        process.join(60)
        assert process.exitcode == 0
    for number in range(ROUNDS):
        names = sorted(path.name for path in (disk / str(number)).iterdir())
        assert [name.partition(".")[0] for name in names] == ["progress", "won"], names
        assert names[1] == f"won.{progress.read(disk / str(number) / progress.FILE_NAME).pid}"


def without_locks(_: Path) -> None:
    raise OSError(errno.ENOLCK, "No locks available")


def test_a_claim_is_left_to_the_living_and_taken_from_the_dead(tmp_path: Path) -> None:
    """Catches a run that two commands of one job do, one that a requeued job waits for, and a later claim removed."""
    claim = Progress([], job="7")
    elsewhere = replace(claim, host="elsewhere", job=None)
    sleeper = subprocess.Popen(["sleep", "60"])
    beside = replace(claim, pid=sleeper.pid, born=progress.born(sleeper.pid))
    requeued = replace(elsewhere, job="7")
    silent = replace(elsewhere, updated=claim.updated - 2 * progress.SILENT)
    try:
        for other, living in ((elsewhere, True), (beside, True), (requeued, False), (silent, False), (claim, False)):
            progress.write(tmp_path, other)
            assert progress.take_claim(tmp_path, claim) == (other if living else None)
            progress.release_claim(tmp_path, claim)
            assert (tmp_path / progress.FILE_NAME).exists() == living  # what is another's stays
    finally:
        sleeper.kill()
        sleeper.wait()
    progress.write(tmp_path, beside)
    assert progress.take_claim(tmp_path, claim) is None
    assert sorted(path.name for path in tmp_path.iterdir()) == [progress.FILE_NAME]
    progress.release_claim(tmp_path / "gone", claim)


@pytest.mark.parametrize("times", [2, 1000])
def test_a_stale_handle_makes_no_claim_a_dead_one(times: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a live claim that is removed because its file was replaced on the server while it was read."""
    elsewhere = Progress([], host="elsewhere")
    progress.write(tmp_path, elsewhere)
    stale = iter(range(times))
    opened = os.open

    def open_stale(path: Path, *flags: int) -> int:
        if Path(path).name == progress.FILE_NAME and next(stale, None) is not None:
            raise OSError(errno.ESTALE, "Stale file handle", str(path))
        return opened(path, *flags)

    with monkeypatch.context() as patched:
        patched.setattr(progress.os, "open", open_stale)
        if times == 2:
            assert progress.take_claim(tmp_path, Progress([])) == elsewhere
        else:
            with pytest.raises(OSError, match="Stale file handle"):
                progress.take_claim(tmp_path, Progress([]))
            progress.release_claim(tmp_path, elsewhere)
    assert progress.read(tmp_path / progress.FILE_NAME) == elsewhere


def test_a_dead_claim_that_is_seen_late_costs_no_live_one(tmp_path: Path) -> None:
    """Catches a claim that is removed by a process which read the one before it."""
    dead, claim = progress.encode(Progress([], born=1)), Progress([])
    progress.write(tmp_path, claim)
    progress._remove(tmp_path / progress.FILE_NAME, dead, Progress([], host="elsewhere"))
    assert progress.read(tmp_path / progress.FILE_NAME) == claim
    assert sorted(path.name for path in tmp_path.iterdir()) == [progress.FILE_NAME]


@pytest.mark.parametrize("alive", [True, False])
def test_one_process_alone_removes_a_dead_claim(alive: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches two processes that remove a claim in turn, and a run that none can do as one was killed at that."""
    monkeypatch.setattr(progress, "PAUSE", 0)
    progress.write(tmp_path, Progress([], born=1))
    with monkeypatch.context() as patched:  # a process that is killed at this moment
        patched.setattr(Path, "unlink", lambda *_, **__: None)
        content = (tmp_path / progress.FILE_NAME).read_bytes()
        progress._remove(
            tmp_path / progress.FILE_NAME, content, Progress([], host="elsewhere" if alive else HERE, born=1)
        )
    if alive:
        with pytest.raises(InputError, match="claim it again and again"):
            progress.take_claim(tmp_path, Progress([]))
        assert (tmp_path / progress.FILE_NAME).read_bytes() == content
    else:
        assert progress.take_claim(tmp_path, Progress([])) is None
        assert [path.name for path in tmp_path.iterdir() if not path.name.endswith(".tmp")] == [progress.FILE_NAME]


def test_a_lock_that_is_held_for_ever_is_not_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a command that hangs beside a process that was suspended while it claimed."""
    monkeypatch.setattr(progress, "PATIENCE", 0.1)
    held = progress._locked(tmp_path / progress.CLAIM_LOCK)
    assert held is not None
    assert progress.take_claim(tmp_path, Progress([])) is None
    held.close()


@pytest.mark.parametrize("number", [errno.EPERM, errno.EOPNOTSUPP])
def test_a_file_system_without_links_has_claims(number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches runs that cannot be done on a FAT disk."""

    def link(*_: object) -> None:
        raise OSError(number, "no links here")

    monkeypatch.setattr(atomic.os, "link", link)
    assert progress.take_claim(tmp_path, Progress(["a=1"])) is None
    other = Progress(["a=1"], host=socket.gethostname() + "2")
    holder = progress.take_claim(tmp_path, other)
    assert holder is not None
    assert holder.pid == os.getpid()
    assert sorted(path.name for path in tmp_path.iterdir()) == [progress.FILE_NAME]


@pytest.mark.slow
def test_of_three_commands_at_once_one_trains(tmp_path: Path) -> None:
    """Catches a claim that is made once the scene is loaded: all three trained."""
    data = write_moving_square(tmp_path / "data")
    long = ("model=3dgs", "train.iterations=100000", "train.curve_points=1", "train.densify.stop=1")
    arguments = overrides(data, tmp_path / "r", *long)
    runs = [subprocess.Popen(command(*arguments), cwd=ROOT, env=environment(), stderr=subprocess.PIPE, text=True)
            for _ in range(3)]  # fmt: skip
    try:
        deadline, others = time.monotonic() + 240, []
        while len(others) < 2 and time.monotonic() < deadline:
            time.sleep(0.1)
            others = [run for run in runs if run.poll() is not None]
        (winner,) = (run for run in runs if run.poll() is None)
        for run in others:
            errors = run.communicate()[1]
            assert run.returncode == 0, errors
            lines = [line for line in errors.splitlines() if re.search(rf"left to process {winner.pid} on ", line)]
            assert len(lines) == 1, errors
        winner.send_signal(signal.SIGTERM)
        assert "stopped " in winner.communicate(timeout=60)[1]
        assert not list((tmp_path / "r").rglob(progress.FILE_NAME))
    finally:
        for run in runs:
            run.kill()
            run.wait()
