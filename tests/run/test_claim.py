"""A run is claimed before it is done: of equal commands one trains, and what a killed one left is taken over."""

import contextlib
import errno
import multiprocessing
import os
import subprocess
from dataclasses import replace
from multiprocessing.synchronize import Barrier
from pathlib import Path

import pytest
from tiny_run import overrides, spec_of

from gsbench.errors import InputError
from gsbench.measure import atomic
from gsbench.reading import as_json
from gsbench.run import execution, progress
from gsbench.run.progress import FILE_NAME, Progress

CROWD, ROUNDS = 6, 15


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def compete(folder: Path, start: Barrier, ended: Barrier) -> None:
    """Claim a run in many rounds at the same moment as others do, and note who had it."""
    for number in range(ROUNDS):
        at, claim = folder / str(number), Progress(["seed=0"])
        start.wait(60)
        if progress.take_claim(at, claim) is None:
            (at / f"won.{os.getpid()}").touch()
        ended.wait(60)  # the winner lives until all have asked


@pytest.mark.parametrize("left", ["nothing", "a dead claim", "half a claim"])
def test_of_many_processes_one_has_the_run(left, tmp_path):
    """Catches a claim that is looked for and then made, so that several make it, and one that nobody takes over."""
    folders = [tmp_path / str(number) for number in range(ROUNDS)]
    for folder in folders:
        folder.mkdir()
        if left == "a dead claim":
            progress.write(folder, Progress(["seed=0"], born=1))
        elif left == "half a claim":
            (folder / FILE_NAME).write_text('{"overrides": [')
    fork = multiprocessing.get_context("fork")
    start, ended = fork.Barrier(CROWD), fork.Barrier(CROWD)
    crowd = [fork.Process(target=compete, args=(tmp_path, start, ended)) for _ in range(CROWD)]
    for process in crowd:
        process.start()
    for process in crowd:
        process.join(60)
        assert process.exitcode == 0
    for folder in folders:
        assert names(folder) == [FILE_NAME, f"won.{progress.read(folder / FILE_NAME).pid}"]


def test_a_claim_is_left_to_the_living_and_taken_from_the_dead(tmp_path):
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
            assert (tmp_path / FILE_NAME).exists() == living  # what is another's stays
    finally:
        sleeper.kill()
        sleeper.wait()
    progress.write(tmp_path, beside)
    assert progress.take_claim(tmp_path, claim) is None
    assert names(tmp_path) == [FILE_NAME]
    progress.release_claim(tmp_path / "gone", claim)


@pytest.mark.parametrize("times", [2, 1000])
def test_a_stale_handle_makes_no_claim_a_dead_one(times, tmp_path, monkeypatch):
    """Catches a live claim that is removed because its file was replaced on the server while it was read."""
    elsewhere, opened, stale = Progress([], host="elsewhere"), os.open, iter(range(times))
    progress.write(tmp_path, elsewhere)

    def open_stale(path: Path, *flags: int) -> int:
        if Path(path).name == FILE_NAME and next(stale, None) is not None:
            raise OSError(errno.ESTALE, "Stale file handle", str(path))
        return opened(path, *flags)

    with monkeypatch.context() as patched:
        patched.setattr(progress.os, "open", open_stale)
        with pytest.raises(OSError, match="Stale file handle") if times > 2 else contextlib.nullcontext():
            assert progress.take_claim(tmp_path, Progress([])) == elsewhere
        progress.release_claim(tmp_path, elsewhere if times > 2 else Progress([]))
    assert progress.read(tmp_path / FILE_NAME) == elsewhere


def test_a_dead_claim_that_is_seen_late_costs_no_live_one(tmp_path):
    """Catches a claim that is removed by a process which read the one before it."""
    dead, claim = as_json(Progress([], born=1)).encode(), Progress([])
    progress.write(tmp_path, claim)
    progress._remove(tmp_path / FILE_NAME, dead, Progress([], host="elsewhere"))
    assert progress.read(tmp_path / FILE_NAME) == claim
    assert names(tmp_path) == [FILE_NAME]


@pytest.mark.parametrize("alive", [True, False])
def test_one_process_alone_removes_a_dead_claim(alive, tmp_path, monkeypatch):
    """Catches two processes that remove a claim in turn, and a run that none can do as one was killed at that."""
    monkeypatch.setattr(progress, "PAUSE", 0)
    progress.write(tmp_path, Progress([], born=1))
    with monkeypatch.context() as patched:  # a process that is killed at this moment
        patched.setattr(Path, "unlink", lambda *_, **__: None)
        content = (tmp_path / FILE_NAME).read_bytes()
        other = Progress([], born=1)
        progress._remove(tmp_path / FILE_NAME, content, replace(other, host="elsewhere") if alive else other)
    if alive:
        with pytest.raises(InputError, match="claim it again and again"):
            progress.take_claim(tmp_path, Progress([]))
        assert (tmp_path / FILE_NAME).read_bytes() == content
    else:
        assert progress.take_claim(tmp_path, Progress([])) is None
        assert [name for name in names(tmp_path) if not name.endswith(".tmp")] == [FILE_NAME]


@pytest.mark.parametrize("number", [errno.EPERM, errno.EOPNOTSUPP])
def test_a_file_system_without_links_has_claims(number, tmp_path, monkeypatch):
    """Catches runs that cannot be done on a FAT disk."""

    def link(*_: object) -> None:
        raise OSError(number, "no links here")

    monkeypatch.setattr(atomic.os, "link", link)
    assert progress.take_claim(tmp_path, Progress(["a=1"])) is None
    holder = progress.take_claim(tmp_path, Progress(["a=1"], host="elsewhere"))
    assert holder.pid == os.getpid()
    assert names(tmp_path) == [FILE_NAME]


def test_a_run_that_another_process_does_is_left_to_it(square, tmp_path, monkeypatch, capsys):
    """Catches two sweeps on one folder that train the same run twice, and a claim made once the scene is loaded."""
    spec = spec_of(overrides(square, tmp_path, "model=3dgs", "train.iterations=3"))
    loaded, claims = execution.load_scene, list[Path]()
    monkeypatch.setattr(
        execution, "load_scene", lambda config: claims.extend(spec.folder.glob(FILE_NAME)) or loaded(config)
    )
    spec.folder.mkdir(parents=True)
    progress.write(spec.folder, Progress([], host="elsewhere", pid=12, step=7))
    assert execution.execute(spec) is None
    assert "left to process 12 on elsewhere, which is at step 7 of it" in capsys.readouterr().err
    assert not claims
    progress.write(spec.folder, Progress([], host="elsewhere", updated=0.0))
    (spec.folder / progress.STOPPED).write_bytes(as_json(Progress([])).encode())
    record = execution.execute(spec)
    assert record.status == "ok"
    assert claims == [spec.folder / FILE_NAME]
    assert not {FILE_NAME, progress.STOPPED} & {*names(spec.folder)}
