"""The Technicolor layout: cameras and images land where they should, and what is wrong is said in one line."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from scenes.capture import COLOR, Capture, has_estimated_up
from scenes.tiny_scene import assert_refused, write_image, write_points

from gsbench import scenes
from gsbench.errors import InputError
from gsbench.scenes import files
from gsbench.scenes.points import frustum_points
from gsbench.scenes.technicolor import CAMERAS, TEST_CAMERA

PLAYROOM = Path(__file__).resolve().parents[2] / "../shared/data/scenes/playroom"
HEADER = "f cu cv ar sk qw qx qy qz tx ty tz"
COUNT, FRAMES, WIDTH, HEIGHT = 16, (100, 101, 102), 8, 6


def row(camera: int) -> str:
    """A camera at (x, y, 0) of a 4 x 4 array that looks along +z; its centre is not the middle of the image."""
    x, y = camera % 4, camera // 4
    return f"10.0 3.5 2.5 1.5 0.0 1.0 0.0 0.0 0.0 {-0.1 * x} {-0.1 * y} 0.0"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A release of three frames; the red of an image is its camera, the green its frame."""
    folder = tmp_path / "Tiny"
    folder.mkdir()
    (folder / CAMERAS).write_text("\n".join([HEADER, *map(row, range(COUNT))]) + "\n")
    for frame in FRAMES:
        for camera in range(COUNT):
            image = np.full((HEIGHT, WIDTH, 3), (camera, frame, 7), np.uint8)
            write_image(folder / f"Tiny_undist_{frame:05d}_{camera:02d}.png", image)
    return folder


def test_cameras_times_and_splits(root):
    """Catches a transposed rotation, a centre in the middle, a held-out camera that trains, and times of raw frames."""
    scene = scenes.load(root)
    assert has_estimated_up(scene)
    assert (len(scene.train), len(scene.val), len(scene.test)) == (45, 0, 3)
    assert [view.time for view in scene.test] == [0.0, 0.5, 1.0]
    assert all(view.name.endswith(f"_{TEST_CAMERA}") for view in scene.test)
    view = scene.test[1]
    torch.testing.assert_close(view.image[0, 0] * 255, torch.tensor([10.0, 101.0, 7.0]))
    torch.testing.assert_close(scene.placement.to_user(view.camera.center).float(), torch.tensor([0.2, 0.2, 0.0]))
    torch.testing.assert_close(view.camera.K, torch.tensor([[10.0, 0, 3.5], [0, 15.0, 2.5], [0, 0, 1]]))
    assert (view.camera.width, view.camera.height) == (WIDTH, HEIGHT)
    assert scene.points is None
    assert view.pixels.dtype == torch.uint8  # 21 GB of floats for a scene of the release
    half = scenes.load(root, downscale=2).train[0]
    assert half.pixels.dtype == torch.float32
    assert half.image.shape == (HEIGHT // 2, WIDTH // 2, 3)
    torch.testing.assert_close(half.camera.K[:2], torch.tensor([[5.0, 0, 1.75], [0, 7.5, 1.25]]))


def test_points_keep_their_times(root):
    """Catches times that are lost where a scene comes to its standard place, and a fingerprint without the points."""
    before = scenes.load(root).fingerprint
    write_points(root / "points3d.ply", [(0, 0, 50), (1, 1, 50)], COLOR, time=[0.25, 1])
    scene = scenes.load(root)
    points = scene.points
    assert scene.fingerprint != before
    assert points.times.tolist() == [0.25, 1.0]
    assert points.means.dtype == points.times.dtype == torch.float32


def test_frames_can_be_chosen(root):
    """Catches frames counted from 0, and a last one that is left out."""
    scene = scenes.load(root, frames=(101, 102))
    assert [view.name for view in scene.test] == ["Tiny_undist_00101_10", "Tiny_undist_00102_10"]
    assert [view.time for view in scene.test] == [0.0, 1.0]
    for frames, message in (((100, 103), "00103_00"), ((102, 101), "first <= last"), ((1.5, 2), "frames")):
        with pytest.raises(InputError, match=message):
            scenes.load(root, frames=frames)  # type: ignore[arg-type]


def test_columns_are_read_by_name(root):
    """Catches numbers taken by their place: releases differ in their columns, and originals have d1 d2 after sk."""
    turned = [" ".join(reversed(line.split())) for line in (root / CAMERAS).read_text().splitlines()]
    first = scenes.load(root).test[0].camera
    (root / CAMERAS).write_text("\n".join(turned))
    other = scenes.load(root).test[0].camera
    assert torch.equal(first.viewmat, other.viewmat)
    assert torch.equal(first.K, other.K)


def test_what_is_not_read_is_told(root):
    """Catches a column of distortion and a rounded size in silence, and Windows' mark at the start of a table."""
    header, *rows = (root / CAMERAS).read_text().splitlines()
    (root / CAMERAS).write_text("\n".join([f"\ufeff{header} d3", *(f"{row} 0.1" for row in rows)]))
    unread, size, _ = scenes.load(root, downscale=4).notes
    assert unread == f"{CAMERAS}: keys that are not read: 'd3'"
    assert "reduced to 2x2" in size


def table(change: Callable[[str], str]) -> Callable[[Path], object]:
    return lambda root: (root / CAMERAS).write_text(change((root / CAMERAS).read_text()))


IMAGE = "Tiny_undist_00101_03.png"
FAULTS: list[tuple[Callable[[Path], object], str]] = [
    (table(lambda text: text.replace(HEADER, HEADER.replace(" qw", ""))), "expected a header with"),
    (table(lambda text: text.replace(" sk ", " sk d1 d2 ").replace("1.5 0.0 ", "1.5 0.0 0.1 0.0 ")), "d1: expected 0"),
    (table(lambda text: text.replace("1.5 0.0 ", "1.5 0.2 ")), "sk: expected 0"),
    (table(lambda text: text.replace("1.0 0.0 0.0 0.0", "2.0 0.0 0.0 0.0")), "unit quaternion"),
    (table(lambda text: text.replace("10.0 ", "nan ")), "f: expected a number"),
    (table(lambda text: text.replace("10.0 ", "-1 ")), "positive f"),
    (table(lambda text: text.replace(f"{row(15)}\n", "")), "expected a row of camera 15 of .* got 15 rows"),
    (table(lambda text: "\n".join(text.splitlines()[:9])), "more than 10 cameras"),
    (table(lambda text: text.replace("2.5 ", "")), "expected 12 numbers"),
    (table(lambda _: ""), "expected a header"),
    (table(lambda text: text + row(16)), "16.png of every camera"),
    (lambda root: (root / IMAGE).unlink(), "undist_00101_03"),
    (lambda root: write_image(root / IMAGE, np.zeros((4, 4, 3), np.uint8)), "expected 8x6"),
    (lambda root: (root / IMAGE).rename(root / "Other_undist_00101_03.png"), "of one .*, got those of Other, Tiny"),
]


@pytest.mark.parametrize(("apply", "message"), FAULTS)
def test_faulty_files_are_told(root, apply, message):
    """Catches distorted originals, tables read askew, a missing view, one of another size, and two scenes in one."""
    assert_refused(root, apply, message)


def damage(root: Path, name: str) -> Path:
    """Cut the end off an image, as in the release's Birthday_undist_00173_09.png."""
    path = root / f"{name}.png"
    path.write_bytes(path.read_bytes()[:-20])
    return path


def test_a_damaged_image_is_replaced_if_it_is_named(root, capsys):
    """Catches an image of another camera or frame, and a replacement that no message, scene or fingerprint tells."""
    whole = scenes.load(root)
    damage(root, "Tiny_undist_00101_09")
    with pytest.raises(InputError, match=r"copy it again, or replace .* data\.repair=\[Tiny_undist_00101_09\]$"):
        scenes.load(root)
    repaired = scenes.load(root, repair=["Tiny_undist_00101_09", "Other_undist_00101_03"])
    message = capsys.readouterr().err.splitlines()
    assert f"{root}/Tiny_undist_00101_09.png: damaged, replaced by Tiny_undist_00100_09.png (data.repair)" in message
    views = {view.name: view for view in repaired.train}
    replaced = views["Tiny_undist_00101_09"]
    torch.testing.assert_close(replaced.image[0, 0] * 255, torch.tensor([9.0, 100.0, 7.0]))
    assert replaced.time == 0.5
    assert repaired.repaired == ("Tiny_undist_00101_09",)
    for view in whole.train:
        assert torch.equal(view.pixels, views[view.name].pixels) == (view.name != "Tiny_undist_00101_09")
    plain = files.fingerprint({path.name: files.digest(path.read_bytes()) for path in root.iterdir()})
    (root / "Tiny_undist_00101_09.png").write_bytes((root / "Tiny_undist_00100_09.png").read_bytes())
    copied = scenes.load(root)
    assert copied.repaired == ()
    assert len({whole.fingerprint, repaired.fingerprint, copied.fingerprint, plain}) == 4


@pytest.mark.parametrize(
    ("damaged", "repair", "message"),
    [
        ("", ["Tiny_undist_00101_09"], "is whole: leave it out"),
        ("00100_09", ["Tiny_undist_00100_09"], "images that are loaded, as those before them, got .*00100_09: leave"),
        ("00101_09 00100_09", ["Tiny_undist_00101_09"], "00100_09.png: damaged"),
        ("00101_10", ["Tiny_undist_00101_10"], "expected training images that are loaded"),
        ("00101_09", ["Tiny_undist_00108_09"], "images that are loaded"),
        ("00101_09", ["00101_09"], "expected names such as"),
        ("00101_09", "Tiny_undist_00101_09", "repair: expected names such as"),
    ],
)
def test_what_cannot_be_replaced_is_refused(root, damaged, repair, message):
    """Catches a whole image thrown away, a test by another frame, an image of nothing, and a name read as letters."""
    for single in damaged.split():
        damage(root, f"Tiny_undist_{single}")
    with pytest.raises(InputError, match=message):
        scenes.load(root, repair=repair)


@pytest.mark.parametrize("kind", ["bin", "txt"])
def test_points_of_colmap(root, kind):
    """Catches points of a reconstruction that are left out, not moved with the cameras, or said to be left out."""
    means = np.array([(0.5, -0.25, 4.0), (1.5, 2.0, 5.0)])
    capture = Capture("PINHOLE", WIDTH, HEIGHT, (1, 1, 1, 1), [], np.empty((0, 4, 4)), means)
    capture.write(root, kind)
    scene = scenes.load(root)
    torch.testing.assert_close(scene.placement.to_user(scene.points.means).numpy(), means, rtol=0, atol=1e-6)
    torch.testing.assert_close(scene.points.colors, (torch.tensor([COLOR]) / 255).expand(2, 3))
    assert not any("and not sparse" in note for note in scene.notes)


def test_points_in_the_frustum_are_seen_by_all(root):
    """Catches initial points behind the array or beside what it sees, which would never get a gradient."""
    scene = scenes.load(root)
    cameras = [view.camera for view in scene.train[:15]]
    points = frustum_points(500, cameras, scene.extent, torch.Generator().manual_seed(0))
    assert points.means.shape == (500, 3)
    for camera in cameras:
        x = (points.means @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]) @ camera.K.T
        pixel = x[:, :2] / x[:, 2:]
        assert (x[:, 2] > 0).all()
        assert ((pixel >= 0) & (pixel <= torch.tensor([WIDTH, HEIGHT]))).all()
    depth = points.means @ cameras[0].viewmat[2, :3] + cameras[0].viewmat[2, 3]  # all cameras look along z
    assert depth.min() >= 2 * scene.extent - 1e-4
    assert depth.quantile(0.9) > 5 * scene.extent
    assert 20 * scene.extent < depth.max() <= 100 * scene.extent + 1e-3


@pytest.mark.skipif(not PLAYROOM.is_dir(), reason="../shared/data/scenes/playroom is not here")
def test_playrooms_points_project_onto_their_colours():
    """Catches a pose that is inverted or mirrored: points of the scene have the colours of the pixels they fall on."""
    scene = scenes.load(PLAYROOM)
    for view in scene.train[:15:7]:
        x = scene.points.means @ view.camera.viewmat[:3, :3].T + view.camera.viewmat[:3, 3]
        pixel = (x @ view.camera.K.T)[:, :2] / x[:, 2:]
        inside = (pixel > 0).all(1) & (pixel < torch.tensor([view.camera.width, view.camera.height])).all(1)
        assert inside.float().mean() > 0.9
        column, line = pixel[inside].long().unbind(1)
        error = (view.image[line, column] - scene.points.colors[inside]).abs().mean()
        assert error < 0.08  # 0.17 where points are shuffled
