"""The command `python -m gsbench.export`: PLY files, a clip of them, videos and images, and what can be asked wrong."""

import errno
import json
import math
import os
import shutil
import stat
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from gsbench.errors import TooLargeError
from gsbench.export import check_read, direction, main, parser
from gsbench.measure.images import to_bytes
from gsbench.models import CameraTime, GaussianModel, Gaussians3D, build, cameras
from gsbench.models.render import render
from gsbench.run.load import LoadedRun, load_run
from gsbench.run.setup import load_scene
from gsbench.scenes import Points
from gsbench.scenes.gaussian_ply import TrainedGaussians, ply_of, read_trained
from gsbench.view import slice_ply, video

FOUR = ("--seconds", "0.5", "--fps", "8")
ALONG = ("--direction", "0,0,-1")


def exports(run: Path, *words: object) -> bool:
    """Whether the command with these words does its work; the working folder is the test's."""
    return main([str(run), *map(str, words)]) == 0


def replace_run(monkeypatch: pytest.MonkeyPatch, run: LoadedRun) -> None:
    """Let the command load this run."""
    monkeypatch.setattr("gsbench.export.load_run", lambda *_: run)


def change_slices(monkeypatch: pytest.MonkeyPatch, change: Callable[[Gaussians3D, CameraTime], dict[str, Any]]) -> None:
    """Let every model slice other Gaussians than it has."""
    plain = GaussianModel.slice

    def slice_otherwise(self: GaussianModel, query: CameraTime) -> Gaussians3D:
        gaussians = plain(self, query)
        return gaussians._replace(**change(gaussians, query))

    monkeypatch.setattr(GaussianModel, "slice", slice_otherwise)


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


# ---- PLY files


@pytest.mark.parametrize("place", [("--camera", "2"), (*ALONG, "--time", "0.5"), ("--direction", "-1,0,0")])
def test_a_ply_says_what_it_holds(place, folder, tmp_path, capsys):
    """Catches a count of what is left out that is not that of the file."""
    assert exports(folder, "--ply", "a.ply", *place)
    kept, total = len(read_trained(tmp_path / "a.ply")), len(load_run(folder).model)
    text = capsys.readouterr().out
    assert f": {kept} Gaussians at time" in text
    assert f"{total - kept} of {total} are left out" in text
    assert exports(folder, "--ply", "a.ply", *place, "--json")
    printed = json.loads(capsys.readouterr().out)
    assert printed["written"] == {"ply": "a.ply", "plys": None, "video": None, "images": None}
    assert printed["notes"] == text.splitlines()


@pytest.mark.parametrize("option", [("--ply", "a.ply"), ("--plys", "a", *FOUR)])
def test_a_ply_says_how_it_differs_from_the_model(option, folder, monkeypatch, capsys):
    """Catches Beta profiles or an antialiasing filter that are lost without a word, and a word where there are none."""
    assert exports(folder, *option, *ALONG)
    (line,) = capsys.readouterr().out.splitlines()
    assert (" at time 0, " in line) == (option[0] == "--ply")
    shutil.rmtree("a", ignore_errors=True)
    run = load_run(folder)
    run.config.raster.antialias = True
    replace_run(monkeypatch, run)
    change_slices(monkeypatch, lambda gaussians, _: {"beta_exponents": torch.full_like(gaussians.opacities, 2.0)})
    assert exports(folder, *option, *ALONG)
    _, profiles, filtered = capsys.readouterr().out.splitlines()
    assert f"{option[1]}: their alpha profiles (1 - r^2)^b are now the Gaussians" in profiles
    assert f"{option[1]}: trained with raster.antialias=true" in filtered


@pytest.mark.parametrize("place", [("--camera", "2"), ALONG, ()])
def test_each_file_of_a_clip_is_the_slice_of_its_time(place, folder, other_folder, tmp_path, capsys):
    """Catches a time that is left out or repeated, a named view's time in every file, and lost harmonics."""
    run = folder if place else other_folder
    (tmp_path / "clip").mkdir()
    assert exports(run, "--plys", "clip", *place, *FOUR, "--json")
    printed = json.loads(capsys.readouterr().out)
    assert printed["written"]["plys"] == "clip"
    written = sorted((tmp_path / "clip").iterdir())
    assert [path.name for path in written] == ["frame0000.ply", "frame0001.ply", "frame0002.ply", "frame0003.ply"]
    for path, time in zip(written, ("0", "0.3333333333333333", "0.6666666666666666", "1"), strict=True):
        assert exports(run, "--ply", "a.ply", "--time", time, *place)
        assert path.read_bytes() == (tmp_path / "a.ply").read_bytes()
    assert len({path.read_bytes() for path in written}) == 4
    assert exports(run, "--plys", "two", *place, "--seconds", "2", "--fps", "1")  # the fewest
    assert len(list((tmp_path / "two").iterdir())) == 2
    counts = [len(read_trained(path)) for path in written]
    (text,) = printed["notes"]
    assert f"frame0000.ply to frame0003.ply at times 0 to 1, {min(counts)} to {max(counts)} Gaussians" in text
    assert ("harmonics" in text) == (not place)


def test_names_of_a_long_clip_sort(folder, tmp_path, monkeypatch):
    """Catches numbers of different width, which viewers sort wrongly."""
    monkeypatch.setattr(slice_ply, "write_ply", lambda _, __, path, **___: path.name)
    names: Any = slice_ply.write_clip(load_run(folder), [None] * 10_001, tmp_path / "a", keep_harmonics=False)  # type: ignore[list-item]
    assert sorted(names) == names
    assert (names[0], names[-1]) == ("frame00000.ply", "frame10000.ply")


@pytest.mark.parametrize("still", ["scene", "model"])
def test_what_stands_still_is_sent_to_a_single_ply(still, other_folder, tmp_path, monkeypatch, capsys):
    """Catches a clip of equal files, and --time without effect in a scene without times."""
    run = load_run(other_folder)
    if still == "scene":
        run = replace(run, scene=replace(run.scene, has_time=False))
    else:
        monkeypatch.setattr(type(run.model), "observes", ())
    replace_run(monkeypatch, run)
    assert not exports(other_folder, "--plys", "clip", *FOUR)
    text = capsys.readouterr().err
    assert f"expected a {still} " in text
    assert "use --ply" in text
    if still == "scene":
        assert not exports(other_folder, "--ply", "a.ply", "--time", "0.5")
        assert "--time: expected a scene with times" in capsys.readouterr().err
    assert [*tmp_path.iterdir()] == []


def test_a_frame_appears_when_it_is_whole(folder, tmp_path, monkeypatch):
    """Catches half a frame after a kill: while a file is flushed, there are only the earlier frames, all whole."""
    plain, present = os.fsync, []

    def watching(descriptor: int) -> None:
        if stat.S_ISREG(os.fstat(descriptor).st_mode):
            present.append([len(read_trained(path)) for path in sorted((tmp_path / "clip").glob("*.ply"))])
        plain(descriptor)

    monkeypatch.setattr(os, "fsync", watching)
    assert exports(folder, "--plys", "clip", *ALONG, *FOUR)
    assert [len(counts) for counts in present] == [0, 1, 2, 3]
    assert all(counts == present[-1][: len(counts)] for counts in present)


@pytest.mark.parametrize("is_there", [True, False])
@pytest.mark.parametrize("failure", [OSError(errno.ENOSPC, "No space left"), KeyboardInterrupt(), None])
def test_a_clip_that_fails_leaves_nothing(failure, is_there, folder, tmp_path, monkeypatch, capsys):
    """Catches a short clip that looks like a whole one, a folder of the user's that is removed, and a time not named.
    Without a failure of the disk the model fades out at the end."""
    calls = []

    def failing(trained: TrainedGaussians) -> bytes:
        calls.append(trained)
        if len(calls) == 3 and failure is not None:
            raise failure
        return ply_of(trained)

    monkeypatch.setattr(slice_ply, "ply_of", failing)
    if failure is None:
        change_slices(monkeypatch, lambda gaussians, query: {"opacities": gaussians.opacities * (query.time < 0.9)})
    if is_there:
        (tmp_path / "clip").mkdir()
    with pytest.raises(KeyboardInterrupt) if isinstance(failure, KeyboardInterrupt) else nullcontext():
        assert not exports(folder, "--plys", "clip", *ALONG, *FOUR)
    assert len(calls) == 3
    assert ("no Gaussian can be seen from this place at time 1:" in capsys.readouterr().err) == (failure is None)
    assert [*tmp_path.rglob("*")] == ([tmp_path / "clip"] if is_there else [])


def test_defaults_are_those_that_the_help_names():
    """Catches a help that says another default than there is."""
    named = {"fps": 30, "seconds": 4, "supersample": 1, "path": "orbit", "device": "cpu", "json": False}
    options = parser().parse_args(["run", "--video", "a.mp4"])
    check_read(options)
    has = {name: value for name, value in vars(options).items() if value is not None}
    assert has == named | {"run": Path("run"), "video": Path("a.mp4")}
    text = " ".join(parser().format_help().split())
    for words in ("frames a second (30)", "an orbit, a spiral or --plys (4)", "and average (1)"):
        assert words in text


def test_a_direction_has_no_length():
    """Catches a slice seen from the middle of the model, as a long or a short direction is rounded to none."""
    for text in ("0,3,4", "0,3e38,4e38", "0,3e-45,4e-45"):
        torch.testing.assert_close(direction(text), torch.tensor([0, 0.6, 0.8]))


# ---- videos and images


@pytest.mark.parametrize(
    ("words", "moves"),
    [
        (("--path", "orbit"), True),
        (("--path", "spiral"), True),
        (("--camera", "train/r_0"), True),
        (("--camera", "train/r_0", "--time", "0.5"), False),
    ],
)
def test_time_runs_once_unless_it_stands_still(words, moves, folder):
    """Catches a clip that is cut off, and --time without effect."""
    assert exports(folder, "--images", "a", *words, *FOUR)
    images = [cv2.imread(str(file)) for file in sorted(Path("a").iterdir())]
    assert len(images) == 4
    assert any((image != images[0]).any() for image in images) == moves


def test_images_are_what_the_model_renders(folder):
    """Catches swapped colours, and test views that are rendered at other times than their own."""
    assert exports(folder, "--images", "a", "--path", "test")
    run = load_run(folder)
    for file, view in zip(sorted(Path("a").iterdir()), load_scene(run.config).test, strict=True):
        rendered = render(run.model, view.camera, view.time, torch.tensor(run.scene.background))
        assert (cv2.imread(str(file))[:, :, ::-1] == to_bytes(rendered.numpy())).all()


def test_a_video_and_images_say_what_they_are(folder, capsys):
    """Catches files whose size and number only the files tell."""
    assert exports(folder, "--video", "a.mp4", "--images", "a", "--seconds", "1", "--fps", "2", "--width", "32")
    assert capsys.readouterr().out.splitlines() == [
        "a.mp4: 2 frames of 32 x 32 pixels, 2 a second",
        "a: 2 frames of 32 x 32 pixels",
    ]


def test_images_of_a_longer_clip_are_told(tmp_path, capsys):
    """Catches a clip whose last images are those of an earlier export, in silence."""
    for count, is_told in ((3, False), (2, True), (3, False)):
        video.write_images([np.zeros((2, 2, 3), np.uint8)] * count, tmp_path / "a")
        assert ("0002.png: it was there before" in capsys.readouterr().err) == is_told


def test_frames_have_the_size_that_is_asked_for(folder, tmp_path):
    """Catches a video of another length, rate or size, and a side that has not the proportion of the training's."""
    for words, size in (
        (("--width", 34), (34, 34)),
        (("--height", 24), (24, 24)),
        (("--width", 40, "--height", 20, "--supersample", 3), (40, 20)),
    ):
        assert exports(folder, "--video", "a.mp4", "--images", "a", *FOUR, *words)
        assert {cv2.imread(str(file)).shape for file in (tmp_path / "a").iterdir()} == {(size[1], size[0], 3)}
        read = cv2.VideoCapture("a.mp4")
        frames = []
        while (step := read.read())[0]:
            frames.append(step[1].shape)
        assert frames == [(size[1], size[0], 3)] * 4
        assert read.get(cv2.CAP_PROP_FPS) == 8
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "a.mp4"]


@pytest.mark.parametrize(
    ("size", "expected"),
    [
        ((100, 100), (720, 720)),
        ((800, 800), (800, 800)),
        ((1357, 761), (1356, 760)),
        ((201, 101), (1432, 720)),
        ((80, 160), (720, 1440)),
    ],
)
def test_a_video_is_large_enough_to_be_looked_at(size, expected, folder, monkeypatch):
    """Catches a stamp of 80 pixels, sides that VP9 cannot encode, other proportions, and PNGs of another size."""
    run = load_run(folder)
    replace_run(monkeypatch, replace(run, scene=replace(run.scene, width=size[0], height=size[1])))
    written: dict[str, set[tuple[int, int]]] = {}
    monkeypatch.setattr(video, "frames", lambda _, shots, __: iter(shots))

    def note(images: Any, path: Path, *_: object) -> None:
        written[str(path)] = {(camera.width, camera.height) for camera, _ in images}

    for name in ("write_video", "write_images"):
        monkeypatch.setattr(video, name, note)
    monkeypatch.setattr("gsbench.export.closing", nullcontext)
    assert exports(folder, "--video", "a.mp4", "--images", "a", *FOUR)
    assert written == {"a.mp4": {expected}, "a": {size}}


def test_another_size_shows_the_same(folder):
    """Catches a larger image that is a crop, a wide one that is stretched, and a centre that moves."""
    run = load_run(folder)
    (camera,) = video.orbit(run, 1)
    plain, fine, wide, averaged = (
        torch.from_numpy(next(video.frames(run, [(sized, 0.5)], n))).double() / 255
        for sized, n in (
            (camera, 1),
            (video.resized(camera, 48, 48), 1),
            (video.resized(camera, 16, 8), 1),
            (camera, 3),
        )
    )
    blocks = fine.reshape(16, 3, 16, 3, 3).mean((1, 3))
    assert (plain - plain.mean((0, 1))).abs().mean() > 0.02
    torch.testing.assert_close(averaged, blocks, rtol=0, atol=1 / 255)
    torch.testing.assert_close(wide, plain[4:12], rtol=0, atol=1 / 255)
    assert (plain - blocks).abs().mean() < 0.02


@pytest.mark.parametrize("up", [cameras.UP, (0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.6, 0.0, -0.8)])
def test_an_orbit_looks_at_the_model(folder, up):
    """Catches cameras that look away, stand on their heads, are left-handed or turn about another axis."""
    run = load_run(folder)
    run = replace(run, scene=replace(run.scene, up=list(up)))
    for camera in video.orbit(run, 5):
        height = (camera.center - cameras.middle(run.model)) @ torch.tensor(up)
        assert float(height) == pytest.approx(run.scene.extent * math.sin(cameras.ELEVATION), rel=1e-4)
    for camera in (*video.orbit(run, 5), *video.spiral(run, 5), video.around(run, 0.0, 1.5707963)):
        rotation = camera.viewmat[:3, :3]
        torch.testing.assert_close(rotation @ rotation.T, torch.eye(3), atol=1e-5, rtol=0)
        assert torch.linalg.det(rotation) > 0
        assert rotation[1] @ torch.tensor(up) < 1e-3  # y points down
        center = camera.viewmat[:3, :3] @ cameras.middle(run.model) + camera.viewmat[:3, 3]
        torch.testing.assert_close(center, torch.tensor([0, 0, run.scene.extent]), atol=1e-3, rtol=1e-3)


def test_the_middle_is_a_median_by_opacity():
    """Catches a mean, which one far Gaussian moves, a Gaussian that is hardly seen counted whole, and another rank."""
    model = build("3dgs")
    means = torch.tensor([0.0, 1, 2, 3, 100])[:, None].expand(5, 3)
    model.initialise(Points(means, means), 1.0, torch.Generator())
    torch.testing.assert_close(cameras.middle(model), torch.full((3,), 2.0))
    model.splats["opacities"].data[:] = torch.tensor([-9.0, -9, -9, 2, 1])
    torch.testing.assert_close(cameras.middle(model), torch.full((3,), 3.0))


# ---- what fails

PLY, VIDEO, CLIP = ("--ply", "a.ply"), ("--video", "a.mp4"), ("--plys", "clip")


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ((), "--ply OUT.ply"),
        (PLY, "--direction"),
        ((*PLY, "--camera", "6"), "0 to 5"),
        ((*PLY, "--camera", "²"), "0 to 5"),
        ((*PLY, "--camera", "train/r_9"), "train/r_9"),
        ((*PLY, "--camera", "9" * 5000), "0 to 5"),
        ((*PLY, "--camera", "\x1b[31m"), r"\x1b[31m"),
        ((*PLY, "--camera", "a\nb"), r"'a\nb'"),
        (("--ply", "a\0.ply", "--camera", "0"), "a file"),
        (("--ply", ".", "--camera", "0"), "a file"),
        (("--ply", "a.spz", "--camera", "0"), "ends in .ply, got 'a.spz'"),
        (("--ply", "nowhere/a.ply"), "nowhere"),
        ((*PLY, "--direction", "," * 5000), "--direction"),
        ((*PLY, "--direction", "1e300,1e300,1e300"), "--direction"),
        ((*PLY, "--direction", "0,0,0"), "--direction"),
        ((*PLY, "--direction", "1,x"), "--direction"),
        ((*PLY, "--camera", "0", "--data-root", "/nowhere"), "--data-root"),
        ((*PLY, "--time", "1.5"), "--time"),
        ((*PLY, "--time", "nan"), "--time"),
        ((*PLY, "--device", "gpu"), "device"),
        (("--video", "a.ts"), "--video: expected a file name that ends in .mp4"),
        (("--video", "a\0.mp4"), "a file"),
        (("--images", "a\0"), "a file"),
        (("--images", "nowhere/a"), "nowhere"),
        (("--images", "full/file"), "--images: expected a folder, full/file is a file: name another"),
        (("--video", "full/a.mp4"), "--video: expected a file name, 'full/a.mp4' is a folder: name another"),
        ((*PLY, "--direction", "-1,x"), "--direction: expected three numbers X,Y,Z"),
        ((*VIDEO, "--fps", "0"), "--fps"),
        ((*VIDEO, "--seconds", "inf"), "--seconds"),
        ((*VIDEO, "--width", "0"), "--width"),
        ((*VIDEO, "--height", "-1"), "--height"),
        ((*VIDEO, "--width", "9000", "--supersample", "2"), "at most 16384"),
        ((*VIDEO, "--supersample", "0"), "--supersample"),
        ((*VIDEO, "--width", "33"), "even numbers"),
        (CLIP, "--direction"),
        ((*CLIP, *ALONG, "--time", "0.5"), "--time"),
        ((*CLIP, *ALONG, "--fps", "1", "--seconds", "1.4"), "at least 2 files"),
        (("--plys", "nowhere/clip", *ALONG), "to write into, there is none: make it first"),
        (("--plys", "full", *ALONG), "full has files"),
        (("--plys", "full/file", *ALONG), "is a file: name another"),
        ((*PLY, "--seconds", "2"), "--seconds: expected --plys or --video or --images, which reads it"),
        ((*VIDEO, "--data-root", "."), "--data-root: expected --camera or --path test"),
        ((*PLY, "--path", "orbit"), "--path: expected --video or --images"),
        ((*VIDEO, *ALONG), "--direction: expected --ply or --plys"),
        (("--images", "a", "--path", "test", "--fps", "8"), "--fps: expected --plys or --video beside --path test"),
        ((*VIDEO, "--path", "test", "--seconds", "2"), "--seconds: expected --plys beside --path test"),
        ((*VIDEO, "--path", "orbit", "--camera", "0"), "--path: expected no --camera beside it"),
    ],
)
def test_what_is_asked_wrong_is_answered_in_one_line(words, text, folder, tmp_path, capfd):
    """Catches a stack trace, a message that does not name the option, and a file that is left behind."""
    (tmp_path / "full" / "a.mp4").mkdir(parents=True)
    (tmp_path / "full" / "file").touch()
    assert not exports(folder, *words)
    (line,) = [line for line in capfd.readouterr().err.splitlines() if line.startswith("gsbench.export:")]
    assert text in line
    assert line.isprintable()
    assert len(line) < 400
    assert sorted(tmp_path.rglob("*")) == [tmp_path / "full", tmp_path / "full" / "a.mp4", tmp_path / "full" / "file"]


def test_a_disk_that_refuses_a_video_is_named(folder, tmp_path, monkeypatch, capfd):
    """Catches a video that lacks frames, as OpenCV does not report a full disk, and an error of a temporary file."""
    path, writer_of = tmp_path / "a.mp4", cv2.VideoWriter

    class Full:  # not a subclass, whose memory OpenCV's bindings corrupt
        fourcc = writer_of.fourcc

        def __init__(self, *arguments: object) -> None:
            self._writer = writer_of(*arguments)
            self.isOpened, self.release = self._writer.isOpened, self._writer.release

        def write(self, *_: object) -> None:
            pass

    def refused(self: Path, *_: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(self))

    assert exports(folder, "--video", path, *FOUR)
    whole = path.read_bytes()
    with monkeypatch.context() as patched:
        patched.setattr(cv2, "VideoWriter", Full)
        assert not exports(folder, "--video", path, *FOUR)
    assert f"{path}: expected a video of 4 frames, 0 can be read" in capfd.readouterr().err
    assert [*tmp_path.iterdir()] == [path]
    with monkeypatch.context() as patched:
        patched.setattr(Path, "write_bytes", refused)
        patched.setattr(Path, "unlink", refused)
        assert not exports(folder, "--video", path, *FOUR)
    assert f"gsbench.export: {path}: Read-only file system" in capfd.readouterr().err
    assert path.read_bytes() == whole


@pytest.mark.parametrize("words", [("--ply", "a.ply"), ("--video", "a.mp4", *FOUR), ("--images", "a", *FOUR)])
def test_memory_that_runs_out_ends_in_one_line(words, folder, tmp_path, monkeypatch, capfd):
    """Catches a traceback for an allocation that fails, a file that it leaves, and a mistake of gsbench called so."""
    errors = [
        RuntimeError("expected a tensor of another shape"),
        MemoryError(),
        RuntimeError("[enforce fail at alloc_cpu.cpp:118] DefaultCPUAllocator: can't allocate memory"),
        OSError(errno.ENOMEM, "Cannot allocate memory"),
        TooLargeError("frames need 9.0 GiB of memory"),
    ]

    def fails(*_: object) -> None:
        raise errors[-1]

    monkeypatch.setattr("gsbench.view.video.render", fails)
    monkeypatch.setattr("gsbench.view.slice_ply.ply_of", fails)
    while len(errors) > 1:
        assert not exports(folder, *words, "--camera", "0")
        (line,) = [line for line in capfd.readouterr().err.splitlines() if line.startswith("gsbench.export:")]
        assert line.startswith("gsbench.export: out of memory: ")
        assert not [path for path in tmp_path.rglob("*") if path.is_file()]
        errors.pop()
    with pytest.raises(RuntimeError, match="another shape"):
        exports(folder, *words, "--camera", "0")


def test_a_folder_without_a_checkpoint_and_other_data_are_refused(folder, square, tmp_path, capsys):
    """Catches images of one scene that are taken for another's, and a stack trace for a wrong path."""
    assert not exports(tmp_path, *PLY)
    assert "checkpoint.pt" in capsys.readouterr().err
    shutil.copytree(square, tmp_path / "moved")
    words = (*PLY, "--camera", "0", "--data-root", tmp_path / "moved")
    assert exports(folder, *words)
    transforms = tmp_path / "moved" / "square" / "transforms_train.json"
    transforms.write_text(transforms.read_text().replace("0.7", "0.8"))
    assert not exports(folder, *words)
    assert "expected the data of the training" in capsys.readouterr().err
