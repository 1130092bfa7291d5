"""The option --plys of `python -m gsbench.export`: one PLY for each time of a clip, and what can be asked wrong."""

import errno
import json
import os
import re
import stat
from collections import namedtuple
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from gsbench.export import main
from gsbench.models import GaussianModel, Gaussians3D, Query
from gsbench.run.load import load_run
from gsbench.scenes.trained import TrainedGaussians, ply_of, read_trained
from gsbench.view import sequence

FOUR = ("--seconds", "0.5", "--fps", "8")
ALONG = ("--direction", "0,0,-1")
Usage = namedtuple("Usage", "free")


@pytest.mark.parametrize("place", [("--camera", "2"), ALONG, ()])
def test_each_file_is_the_slice_of_its_time(
    place: tuple[str, ...], folder: Path, other_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches a time that is left out or repeated, a named view's time in every file, and lost harmonics."""
    run = str(folder if place else other_folder)
    assert main([run, "--plys", str(tmp_path / "clip"), *place, *FOUR]) == 0
    said = capsys.readouterr().out
    written = sorted((tmp_path / "clip").iterdir())
    assert [path.name for path in written] == ["frame0000.ply", "frame0001.ply", "frame0002.ply", "frame0003.ply"]
    for path, time in zip(written, ("0", "0.3333333333333333", "0.6666666666666666", "1"), strict=True):
        assert main([run, "--ply", str(tmp_path / "a.ply"), "--time", time, *place]) == 0
        assert path.read_bytes() == (tmp_path / "a.ply").read_bytes()
    assert len({path.read_bytes() for path in written}) == 4
    counts = [len(read_trained(path)) for path in written]
    assert f"frame0000.ply to frame0003.ply at times 0 to 1, {min(counts)} to {max(counts)} Gaussians" in said
    assert ("harmonics" in said) == (not place)


@pytest.mark.parametrize("count", [2, 10_000, 10_001])
def test_names_are_those_of_a_sequence(count: int) -> None:
    """Catches numbers of different width, which sort wrongly, and prefixes by which SuperSplat sees single models."""
    names = sequence.names(count)
    found = [re.fullmatch(r"(.*?)(\d+)\.ply", name) for name in names]
    assert {match[1] for match in found if match} == {"frame"}
    assert [int(match[2]) for match in found if match] == [*range(count)]
    assert sorted(names) == names
    assert len(names[0]) == len("frame0000.ply") + (count > 10_000)


def test_an_empty_folder_is_filled_and_json_names_it(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches an empty folder that is refused, and one that --json leaves out."""
    (tmp_path / "clip").mkdir()
    assert main([str(folder), "--plys", str(tmp_path / "clip"), *ALONG, *FOUR, "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["written"] == {"ply": None, "plys": str(tmp_path / "clip"), "video": None, "images": None}
    assert len(printed["notes"]) == 1
    assert len([*(tmp_path / "clip").iterdir()]) == 4


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--plys", "clip"), "--direction"),
        (("--plys", "clip", *ALONG, "--time", "0.5"), "--time"),
        (("--plys", "clip", *ALONG, "--fps", "1", "--seconds", "1.4"), "at least 2 files"),
        (("--plys", "nowhere/clip", *ALONG), "nowhere"),
        (("--plys", "a\0", *ALONG), "a file"),
        (("--plys", "full", *ALONG), "full has files"),
        (("--plys", "full/file", *ALONG), "is a file"),
    ],
)
def test_a_sequence_that_cannot_be_is_refused_in_one_line(
    words: tuple[str, ...], said: str, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """Catches a stack trace, a frame among other files, one file that no viewer plays, and a folder left behind."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").touch()
    assert main([str(folder), *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
    assert len(line) < 300
    assert sorted(tmp_path.rglob("*")) == [tmp_path / "full", tmp_path / "full" / "file"]


@pytest.mark.parametrize("still", ["scene", "model"])
def test_what_stands_still_is_sent_to_a_single_ply(
    still: str, other_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """Catches a sequence of equal files, of a scene without times or of a model that is the same at all of them."""
    run = load_run(other_folder)
    if still == "scene":
        run = replace(run, scene=replace(run.scene, has_time=False))
    else:
        monkeypatch.setattr(type(run.model), "observes", ())
    monkeypatch.setattr("gsbench.export.load_run", lambda *_: run)
    assert main([str(other_folder), "--plys", str(tmp_path / "clip"), *FOUR]) == 2
    said = capsys.readouterr().err
    assert f"expected a {still} " in said
    assert "use --ply" in said
    assert [*tmp_path.iterdir()] == []


def test_a_time_at_which_nothing_is_seen_is_told_before_a_file_is_written(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches a sequence that ends where the model has faded out, and a message that does not say when."""
    plain = GaussianModel.slice

    def fading(self: GaussianModel, query: Query) -> Gaussians3D:
        seen = plain(self, query)
        assert query.time is not None
        return seen._replace(opacities=seen.opacities * (query.time < 0.9))

    monkeypatch.setattr(GaussianModel, "slice", fading)
    monkeypatch.setattr(sequence, "ply_of", lambda _: pytest.fail("a file was made"))
    assert main([str(folder), "--plys", str(tmp_path / "clip"), *ALONG, *FOUR]) == 2
    assert "no Gaussian can be seen from this place at time 1," in capsys.readouterr().err
    assert [*tmp_path.iterdir()] == []


def test_a_full_disk_is_told_before_a_file_is_written(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches a disk that is filled by half a sequence, and one that is refused though there is room."""
    words = [str(folder), *ALONG, *FOUR, "--plys"]
    assert main([*words, str(tmp_path / "a")]) == 0
    size = sum(path.stat().st_size for path in (tmp_path / "a").iterdir())
    free = size - 1
    monkeypatch.setattr("shutil.disk_usage", lambda _: Usage(free))
    capsys.readouterr()
    assert main([*words, str(tmp_path / "b")]) == 2
    assert "4 files need" in capsys.readouterr().err
    assert not (tmp_path / "b").exists()
    free = size + 4 * sequence.HEADER
    assert main([*words, str(tmp_path / "b")]) == 0


def test_a_frame_appears_when_it_is_whole(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches half a frame after a kill: while a file is flushed, there are only the earlier frames, all whole."""
    plain, seen = os.fsync, []

    def watching(descriptor: int) -> None:
        if stat.S_ISREG(os.fstat(descriptor).st_mode):
            seen.append([len(read_trained(path)) for path in sorted((tmp_path / "clip").glob("*.ply"))])
        plain(descriptor)

    monkeypatch.setattr(os, "fsync", watching)
    assert main([str(folder), "--plys", str(tmp_path / "clip"), *ALONG, *FOUR]) == 0
    assert [len(counts) for counts in seen] == [0, 1, 2, 3]
    assert all(counts == seen[-1][: len(counts)] for counts in seen)


@pytest.mark.parametrize("made", [True, False])
@pytest.mark.parametrize("failure", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()])
def test_a_sequence_that_fails_leaves_nothing(
    failure: BaseException, made: bool, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a short sequence that looks like a whole one, and a folder of the user's that is removed."""
    calls = []

    def failing(trained: TrainedGaussians) -> bytes:
        calls.append(trained)
        if len(calls) == 3:
            raise failure
        return ply_of(trained)

    monkeypatch.setattr(sequence, "ply_of", failing)
    if made:
        (tmp_path / "clip").mkdir()
    words = [str(folder), "--plys", str(tmp_path / "clip"), *ALONG, *FOUR]
    if isinstance(failure, OSError):
        assert main(words) == 2
    else:
        with pytest.raises(KeyboardInterrupt):
            main(words)
    assert len(calls) == 3
    assert [*tmp_path.rglob("*")] == ([tmp_path / "clip"] if made else [])


def test_a_sequence_says_that_it_has_no_profiles(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches Beta profiles that are lost without a word."""
    plain = GaussianModel.slice

    def shaped(self: GaussianModel, query: Query) -> Gaussians3D:
        seen = plain(self, query)
        return seen._replace(shapes=torch.full_like(seen.opacities, 2.0))

    monkeypatch.setattr(GaussianModel, "slice", shaped)
    assert main([str(folder), "--plys", str(tmp_path / "clip"), *ALONG, *FOUR]) == 0
    assert "their alpha profiles (1 - r^2)^b are now the Gaussians" in capsys.readouterr().out.splitlines()[1]
