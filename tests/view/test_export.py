"""The command `python -m gsbench.export`: what it writes, and everything that can be asked wrong."""

import errno
import json
import math
import os
import shutil
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import cv2
import pytest
import torch

from gsbench.errors import TooLargeError
from gsbench.export import direction, main
from gsbench.measure.images import to_bytes
from gsbench.models import GaussianModel, Gaussians3D, Query, build, cameras
from gsbench.models.render import render
from gsbench.run.load import load_run
from gsbench.run.setup import load_scene
from gsbench.scenes import Points
from gsbench.scenes.trained import read_trained
from gsbench.view import film, paths

SHORT = ("--seconds", "0.5", "--fps", "8")


@pytest.mark.parametrize("place", [("--camera", "2"), ("--direction", "0,0,-1", "--time", "0.5")])
def test_a_ply_says_what_it_holds(
    place: tuple[str, ...], folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches a count of what is left out that is not that of the file."""
    assert main([str(folder), "--ply", str(tmp_path / "a.ply"), *place]) == 0
    kept, total = len(read_trained(tmp_path / "a.ply")), len(load_run(folder).model)
    said = capsys.readouterr().out
    assert f": {kept} Gaussians at time" in said
    assert f"{total - kept} of {total} are left out" in said
    assert main([str(folder), "--ply", str(tmp_path / "a.ply"), *place, "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["written"] == {"ply": str(tmp_path / "a.ply"), "plys": None, "video": None, "images": None}
    assert printed["notes"] == said.splitlines()


def test_a_ply_says_that_it_has_no_profiles(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches Beta profiles that are lost without a word, and a word about them where there are none."""
    plain, asked = GaussianModel.slice, [str(folder), "--ply", str(tmp_path / "a.ply"), "--camera", "2"]
    assert main(asked) == 0
    assert "profiles" not in capsys.readouterr().out

    def shaped(self: GaussianModel, query: Query) -> Gaussians3D:
        seen = plain(self, query)
        return seen._replace(shapes=torch.full_like(seen.opacities, 2.0))

    monkeypatch.setattr(GaussianModel, "slice", shaped)
    assert main(asked) == 0
    said = capsys.readouterr().out.splitlines()
    assert len(said) == 2
    assert "a.ply: their alpha profiles (1 - r^2)^b are now the Gaussians" in said[1]


def test_a_ply_says_that_viewers_must_antialias(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches a PLY that other viewers show with too opaque Gaussians, without a word."""
    asked = [str(folder), "--ply", str(tmp_path / "a.ply"), "--camera", "2"]
    assert main(asked) == 0
    assert "antialias" not in capsys.readouterr().out
    loaded = load_run(folder)
    loaded.config.raster.antialias = True
    monkeypatch.setattr("gsbench.export.load_run", lambda *_: loaded)
    assert main(asked) == 0
    assert "a.ply: trained with raster.antialias=true" in capsys.readouterr().out


def test_a_video_has_its_frames(folder: Path, tmp_path: Path) -> None:
    """Catches a video that cannot be read, or with another length, size or rate than was asked for."""
    path = tmp_path / "a.mp4"
    assert main([str(folder), "--video", str(path), *SHORT]) == 0
    video = cv2.VideoCapture(str(path))
    count = 0
    while video.read()[0]:
        count += 1
    assert (count, video.get(cv2.CAP_PROP_FPS)) == (4, 8)
    assert [*tmp_path.iterdir()] == [path]


@pytest.mark.parametrize("path", ["test", "orbit", "spiral"])
def test_images_are_what_the_model_renders(path: str, folder: Path, tmp_path: Path) -> None:
    """Catches swapped colours, and test views that are rendered at other times than their own."""
    assert main([str(folder), "--images", str(tmp_path / "a"), "--path", path, *SHORT]) == 0
    images = [cv2.imread(str(file)) for file in sorted((tmp_path / "a").iterdir())]
    run = load_run(folder)
    if path != "test":
        assert len(images) == 4
        assert any((image != images[0]).any() for image in images)
        return
    views = load_scene(run.config).test
    assert len(images) == len(views)
    for image, view in zip(images, views, strict=True):
        rendered = render(run.model, view.camera, view.time, torch.tensor(run.scene.background))
        expected = to_bytes(rendered.numpy())
        assert (image[:, :, ::-1] == expected).all()


def test_time_runs_once_unless_it_stands_still(folder: Path, tmp_path: Path) -> None:
    """Catches a clip that is cut off, and --time without effect."""
    for more, differ in (((), True), (("--time", "0.5"), False)):
        out = tmp_path / f"still{differ}"
        assert main([str(folder), "--images", str(out), "--camera", "train/r_0", *SHORT, *more]) == 0
        first, *others = [cv2.imread(str(file)) for file in sorted(out.iterdir())]
        assert any((image != first).any() for image in others) == differ


@pytest.mark.parametrize(
    ("words", "size"),
    [
        (("--width", "34"), (34, 34)),
        (("--height", "24"), (24, 24)),
        (("--width", "40", "--height", "20", "--supersample", "3"), (40, 20)),
    ],
)
def test_frames_have_the_size_that_is_asked_for(
    words: tuple[str, ...], size: tuple[int, int], folder: Path, tmp_path: Path
) -> None:
    """Catches sides that are swapped, and one that has not the proportion of the training's images."""
    assert main([str(folder), "--video", str(tmp_path / "a.mp4"), "--images", str(tmp_path / "a"), *SHORT, *words]) == 0
    assert {cv2.imread(str(file)).shape for file in (tmp_path / "a").iterdir()} == {(size[1], size[0], 3)}
    read, frame = cv2.VideoCapture(str(tmp_path / "a.mp4")).read()
    assert read
    assert frame.shape == (size[1], size[0], 3)


@pytest.mark.parametrize(
    ("size", "expected"),
    [((100, 100), (720, 720)), ((800, 800), (800, 800)), ((1357, 761), (1356, 760)), ((201, 101), (1432, 720)),
     ((80, 160), (720, 1440))],
)  # fmt: skip
def test_a_video_is_large_enough_to_be_looked_at(
    size: tuple[int, int], expected: tuple[int, int], folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a stamp of 80 pixels, sides that VP9 cannot encode, other proportions, and PNGs of another size."""
    run = load_run(folder)
    run = replace(run, scene=replace(run.scene, width=size[0], height=size[1]))
    monkeypatch.setattr("gsbench.export.load_run", lambda *_: run)
    written: dict[Path, set[tuple[int, int]]] = {}
    monkeypatch.setattr(film, "frames", lambda _, shots, __: iter(shots))
    for name in ("write_video", "write_images"):
        monkeypatch.setattr(film, name, lambda images, path, *_: written.update(
            {path: {(camera.width, camera.height) for camera, _ in images}}))  # fmt: skip
    monkeypatch.setattr("gsbench.export.closing", nullcontext)
    assert main([str(folder), "--video", str(tmp_path / "a.mp4"), "--images", str(tmp_path / "a"), *SHORT]) == 0
    assert written == {tmp_path / "a.mp4": {expected}, tmp_path / "a": {size}}


def test_another_size_shows_the_same(folder: Path) -> None:
    """Catches a larger image that is a crop, a wide one that is stretched, and a centre that moves."""
    run = load_run(folder)
    (camera,) = paths.orbit(run, 1)
    plain, fine, wide, averaged = (
        torch.from_numpy(next(film.frames(run, [(one, 0.5)], n))).double() / 255
        for one, n in ((camera, 1), (paths.resized(camera, 48, 48), 1), (paths.resized(camera, 16, 8), 1), (camera, 3))
    )
    blocks = fine.reshape(16, 3, 16, 3, 3).mean((1, 3))
    assert (plain - plain.mean((0, 1))).abs().mean() > 0.02
    torch.testing.assert_close(averaged, blocks, rtol=0, atol=1 / 255)
    torch.testing.assert_close(wide, plain[4:12], rtol=0, atol=1 / 255)
    assert (plain - blocks).abs().mean() < 0.02


@pytest.mark.parametrize("up", [cameras.UP, (0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.6, 0.0, -0.8)])
def test_an_orbit_looks_at_the_model(folder: Path, up: tuple[float, float, float]) -> None:
    """Catches cameras that look away, stand on their heads, are left-handed or turn about another axis."""
    run = load_run(folder)
    run = replace(run, scene=replace(run.scene, up=list(up)))
    for camera in paths.orbit(run, 5):
        height = (camera.center - cameras.middle(run.model)) @ torch.tensor(up)
        assert float(height) == pytest.approx(run.scene.extent * math.sin(cameras.ELEVATION), rel=1e-4)
    for camera in (*paths.orbit(run, 5), *paths.spiral(run, 5), paths.around(run, 0.0, 1.5707963)):
        rotation = camera.viewmat[:3, :3]
        torch.testing.assert_close(rotation @ rotation.T, torch.eye(3), atol=1e-5, rtol=0)
        assert torch.linalg.det(rotation) > 0
        assert rotation[1] @ torch.tensor(up) < 1e-3  # y points down
        center = camera.viewmat[:3, :3] @ cameras.middle(run.model) + camera.viewmat[:3, 3]
        torch.testing.assert_close(center, torch.tensor([0, 0, run.scene.extent]), atol=1e-3, rtol=1e-3)


def test_the_middle_is_a_median_by_opacity() -> None:
    """Catches a mean, which one far Gaussian moves, a Gaussian that is hardly seen counted whole, and another rank."""
    model = build("3dgs")
    means = torch.tensor([0.0, 1, 2, 3, 100])[:, None].expand(5, 3)
    model.initialise(Points(means, means), 1.0, torch.Generator())
    torch.testing.assert_close(cameras.middle(model), torch.full((3,), 2.0))
    model.splats["opacities"].data[:] = torch.tensor([-9.0, -9, -9, 2, 1])
    torch.testing.assert_close(cameras.middle(model), torch.full((3,), 3.0))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "--ply OUT.ply"),
        (("--ply", "a.ply"), "--direction"),
        (("--ply", "a.ply", "--camera", "6"), "0 to 5"),
        (("--ply", "a.ply", "--camera", "²"), "0 to 5"),
        (("--ply", "a.ply", "--camera", "train/r_9"), "train/r_9"),
        (("--ply", "a.ply", "--camera", "9" * 5000), "0 to 5"),
        (("--ply", "a.ply", "--camera", "\x1b[31m"), r"\x1b[31m"),
        (("--ply", "a.ply", "--camera", "a\nb"), r"'a\nb'"),
        (("--ply", "a\0.ply", "--camera", "0"), "a file"),
        (("--ply", ".", "--camera", "0"), "a file"),
        (("--ply", "a.spz", "--camera", "0"), "ends in .ply, got 'a.spz'"),
        (("--video", "a.ts"), "--video: expected a file name that ends in .mp4"),
        (("--video", "a.png"), "--video: expected a file name that ends in .mp4"),
        (("--images", "a\0"), "a file"),
        (("--video", "a\0.mp4"), "a file"),
        (("--ply", "a.ply", "--direction", "," * 5000), "--direction"),
        (("--ply", "a.ply", "--direction", "1e300,1e300,1e300"), "--direction"),
        (("--ply", "a.ply", "--camera", "0", "--data-root", "/nowhere"), "--data-root"),
        (("--ply", "a.ply", "--direction", "0,0,0"), "--direction"),
        (("--ply", "a.ply", "--direction", "1,x"), "--direction"),
        (("--ply", "a.ply", "--time", "1.5"), "--time"),
        (("--ply", "a.ply", "--time", "nan"), "--time"),
        (("--ply", "nowhere/a.ply"), "nowhere"),
        (("--images", "nowhere/a"), "nowhere"),
        (("--video", "a.nothing"), "a.nothing"),
        (("--video", "a.mp4", "--fps", "0"), "--fps"),
        (("--video", "a.mp4", "--seconds", "inf"), "--seconds"),
        (("--ply", "a.ply", "--device", "gpu"), "device"),
        (("--video", "a.mp4", "--width", "0"), "--width"),
        (("--video", "a.mp4", "--height", "-1"), "--height"),
        (("--video", "a.mp4", "--width", "9000", "--supersample", "2"), "at most 16384"),
        (("--video", "a.mp4", "--supersample", "0"), "--supersample"),
        (("--video", "a.mp4", "--width", "33"), "even numbers"),
    ],
)
def test_what_is_asked_wrong_is_told_in_one_line(
    words: tuple[str, ...], said: str, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """Catches a stack trace, a message that does not name the option, and a file that is left behind."""
    monkeypatch.chdir(tmp_path)
    assert main([str(folder), *words]) == 2
    (line,) = [line for line in capfd.readouterr().err.splitlines() if line.startswith("gsbench.export:")]
    assert said in line
    assert line.isprintable()
    assert len(line) < 400
    assert [*tmp_path.iterdir()] == []


def test_a_disk_that_refuses_a_video_is_told(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Catches a video that lacks frames, as OpenCV does not tell that a disk is full, in the place of a whole one, and
    an error that names a temporary file."""
    video = tmp_path / "a.mp4"
    words, writer_of = [str(folder), "--video", str(video), *SHORT], cv2.VideoWriter

    class Full:  # not a subclass, whose memory OpenCV's bindings corrupt
        fourcc = writer_of.fourcc

        def __init__(self, *arguments: object) -> None:
            self._writer = writer_of(*arguments)
            self.isOpened, self.release = self._writer.isOpened, self._writer.release

        def write(self, *_: object) -> None:
            pass

    def refused(self: Path, *_: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(self))

    assert main(words) == 0
    whole = video.read_bytes()
    with monkeypatch.context() as patched:
        patched.setattr(cv2, "VideoWriter", Full)
        assert main(words) == 2
    assert f"{video}: expected a video of 4 frames, 0 can be read" in capfd.readouterr().err
    assert [*tmp_path.iterdir()] == [video]
    with monkeypatch.context() as patched:
        patched.setattr(Path, "write_bytes", refused)
        patched.setattr(Path, "unlink", refused)
        assert main(words) == 2
    assert f"gsbench.export: {video}: Read-only file system" in capfd.readouterr().err
    assert video.read_bytes() == whole


@pytest.mark.parametrize(
    "error",
    [MemoryError(), RuntimeError("[enforce fail at alloc_cpu.cpp:118] DefaultCPUAllocator: can't allocate memory"),
     OSError(errno.ENOMEM, "Cannot allocate memory"), TooLargeError("frames need 9.0 GiB of memory")],
)  # fmt: skip
@pytest.mark.parametrize("option", ["--ply", "--video", "--images"])
def test_memory_that_runs_out_ends_in_one_line(
    error: Exception, option: str, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """Catches a traceback for an allocation that fails while the export is at work, and a file that it leaves."""

    def fails(*_: object) -> None:
        raise error

    monkeypatch.setattr("gsbench.view.film.render", fails)
    monkeypatch.setattr("gsbench.export.ply_of", fails)
    name = {"--ply": "a.ply", "--video": "a.mp4", "--images": "a"}[option]
    assert main([str(folder), option, str(tmp_path / name), "--camera", "0", *SHORT]) == 2
    (line,) = [line for line in capfd.readouterr().err.splitlines() if line.startswith("gsbench.export:")]
    assert line.startswith("gsbench.export: out of memory: ")
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_an_error_of_another_kind_is_no_lack_of_memory(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a mistake in gsbench that is said to be a lack of memory."""

    def fails(*_: object) -> None:
        raise RuntimeError("expected a tensor of another shape")

    monkeypatch.setattr("gsbench.export.ply_of", fails)
    with pytest.raises(RuntimeError, match="another shape"):
        main([str(folder), "--ply", str(tmp_path / "a.ply"), "--camera", "0"])


def test_a_direction_has_no_length() -> None:
    """Catches a slice seen from the middle of the model, as a long or a short direction is rounded to none."""
    for text in ("0,3,4", "0,3e38,4e38", "0,3e-45,4e-45"):
        torch.testing.assert_close(direction(text), torch.tensor([0, 0.6, 0.8]))


def test_a_scene_without_times_has_none_to_ask_for(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches --time without effect."""
    run = load_run(folder)
    static = replace(run, scene=replace(run.scene, has_time=False))
    monkeypatch.setattr("gsbench.export.load_run", lambda *_: static)
    assert main([str(folder), "--ply", str(tmp_path / "a.ply"), "--direction", "0,0,1", "--time", "0.5"]) == 2
    assert "--time: expected a scene with times" in capsys.readouterr().err


def test_a_folder_without_a_checkpoint_and_other_data_are_refused(
    folder: Path, square: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Catches images of one scene that are taken for another's, and a stack trace for a wrong path."""
    assert main([str(tmp_path), "--ply", str(tmp_path / "a.ply")]) == 2
    assert "checkpoint.pt" in capsys.readouterr().err
    shutil.copytree(square, tmp_path / "moved")
    asked = [str(folder), "--ply", str(tmp_path / "a.ply"), "--camera", "0", "--data-root", str(tmp_path / "moved")]
    assert main(asked) == 0
    transforms = tmp_path / "moved" / "square" / "transforms_train.json"
    transforms.write_text(transforms.read_text().replace("0.7", "0.8"))
    assert main(asked) == 2
    assert "expected the data of the training" in capsys.readouterr().err
