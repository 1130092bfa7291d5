"""The layout of Neural 3D Video: films and poses land where they should, frames stay on disk, and faults are told."""

import re
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from scenes.capture import COLOR, Capture, has_estimated_up
from scenes.tiny_scene import assert_refused, write_image, write_points
from scipy.spatial.transform import Rotation

from gsbench import scenes
from gsbench.errors import InputError
from gsbench.measure.regions import moving
from gsbench.scenes import Camera, View, n3v

WIDTH, HEIGHT, FRAMES, CAMERAS = 32, 24, 5, ("cam00", "cam01", "cam02", "cam04")


def row_of(camera: int) -> np.ndarray:  # [17]
    """A camera at (0.3 camera, 0, 4) that looks along -z: its axes down, right and backwards are -y, x and z."""
    axes = np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    return np.concatenate([np.c_[axes, (0.3 * camera, 0, 4), (HEIGHT, WIDTH, 20)].ravel(), [1, 9]])


def pixels_of(camera: int, frame: int) -> np.ndarray:
    """One colour, whose red is of the camera and whose green of the frame."""
    return np.full((HEIGHT, WIDTH, 3), (40 + 20 * camera, 60 + 30 * frame, 128), np.uint8)


def write_film(path: Path, frames: list[np.ndarray], rate: float = 30) -> None:
    height, width = frames[0].shape[:2]
    film = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), rate, (width, height))
    for pixels in frames:
        film.write(pixels[..., ::-1])
    film.release()


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Four films of five frames; cam03 does not exist."""
    for camera, name in enumerate(CAMERAS):
        write_film(tmp_path / f"{name}.mp4", [pixels_of(camera, frame) for frame in range(FRAMES)])
    np.save(tmp_path / "poses_bounds.npy", np.stack([row_of(camera) for camera in range(len(CAMERAS))]))
    return tmp_path


def test_a_camera_of_the_release():
    """Catches axes in another order, a pose that is not inverted, and a principal point off the centre."""
    row = np.zeros(17)
    turn = (Rotation.from_euler("y", 20, degrees=True) * Rotation.from_euler("x", -10, degrees=True)).as_matrix()
    right, up, backwards = turn.T
    row[:15] = np.c_[-up, right, backwards, (0.5, -0.2, 1), (2028, 2704, 1462)].ravel()
    expected = [0.05939117, 0.93969262, 0.33682409, 0.5, 2028, -0.98480775, 0, 0.17364818, -0.2, 2704]
    np.testing.assert_allclose(row[:10], expected, atol=1e-8)
    viewmat, lens = n3v.camera_of(row, "")
    expected_viewmat = [
        [0.93969262, 0.00000000, -0.34202014, -0.12782617],
        [0.05939117, -0.98480775, 0.16317591, -0.38983305],
        [-0.33682409, -0.17364818, -0.92541658, 1.05909899],
        [0, 0, 0, 1],
    ]
    np.testing.assert_allclose(viewmat.numpy(), expected_viewmat, rtol=0, atol=1e-8)
    half = lens.resized(1352, 1014)
    assert half is not None
    np.testing.assert_array_equal(half.K, [[731, 0, 676], [0, 731, 507], [0, 0, 1]])
    x = viewmat.numpy() @ (1, 0.5, -5, 1)
    np.testing.assert_allclose(x[:3], (2.52196717, -1.63872531, 5.26253370), rtol=0, atol=1e-8)
    pixel = half.K @ x[:3] / x[2]
    np.testing.assert_allclose(pixel[:2], (1026.31756680, 279.37044603), rtol=0, atol=1e-8)


def test_films_cameras_times_and_splits(root):
    """Catches films mixed with rows, frames of another time, blue for red, and a test camera that trains."""
    scene = scenes.load(root)
    assert has_estimated_up(scene)
    assert (len(scene.train), len(scene.val), len(scene.test)) == (15, 0, 5)
    assert [view.name for view in scene.train[2:5]] == ["cam04/0000", "cam01/0001", "cam02/0001"]
    assert [view.name for view in scene.test] == [f"cam00/{frame:04d}" for frame in range(FRAMES)]
    assert [view.time for view in scene.test] == [0.0, 0.25, 0.5, 0.75, 1.0]
    for view in (*scene.train, *scene.test):
        name, frame = view.name.split("/")
        camera = CAMERAS.index(name)
        actual = view.image.mean((0, 1)) * 255
        torch.testing.assert_close(actual, torch.tensor(pixels_of(camera, int(frame))[0, 0]).float(), rtol=0, atol=4)
        x, y, z = scene.placement.to_user(view.camera.center).tolist()
        assert (round(x, 5), round(y, 5), round(z, 5)) == (round(0.3 * camera, 5), 0, 4)
    torch.testing.assert_close(scene.test[0].camera.K, torch.tensor([[20.0, 0, 16], [0, 20, 12], [0, 0, 1]]))
    half = scenes.load(root, downscale=2).test[0]
    torch.testing.assert_close(half.camera.K, torch.tensor([[10.0, 0, 8], [0, 10, 6], [0, 0, 1]]))
    assert half.image.shape == (HEIGHT // 2, WIDTH // 2, 3)


def test_frames_and_cameras_can_be_chosen(root):
    """Catches frames counted from 1, poses of the next film, a choice that is not told, and a name read as letters."""
    all_frames = scenes.load(root)
    whole = {view.name: view for view in all_frames.train}
    scene = scenes.load(root, frames=(1, 3), leave_out=["cam01"])
    assert [view.name for view in scene.train] == [f"{name}/000{n}" for n in (1, 2, 3) for name in ("cam02", "cam04")]
    assert [view.time for view in scene.test] == [0.0, 0.5, 1.0]
    for view in scene.train:
        assert torch.equal(view.pixels, whole[view.name].pixels)
        center = all_frames.placement.to_user(whole[view.name].camera.center)
        torch.testing.assert_close(scene.placement.to_user(view.camera.center).float(), center.float())
    assert "cameras left out: cam01" in scene.notes
    assert "there is no cam03: rows of poses_bounds.npy are of the other films, in their order" in scene.notes
    assert "initial points: random" in scene.notes
    assert "poses_bounds.npy: depths are not read; no distortion is stated" in scene.notes
    wrong = (["cam00"], "expected training"), (["cam03"], "cam03"), (CAMERAS[1:], "got all")
    for names, message in (*wrong, ("cam13", "leave_out: expected names such as cam13")):
        with pytest.raises(InputError, match=message):
            scenes.load(root, leave_out=names)
    (root / "cam00.mp4").unlink()
    with pytest.raises(InputError, match="a folder without a scene"):
        scenes.load(root)


def test_folders_of_frames_replace_films(root):
    """Catches frames in the order of their texts, and a folder that wins over the film it was made of."""
    first = scenes.load(root).fingerprint
    (root / "cam02.mp4").unlink()
    for frame in range(FRAMES):
        write_image(root / f"cam02/images/{frame + 8}.png", pixels_of(2, frame))
        write_image(root / f"cam04/{frame:04d}.png", pixels_of(0, 0))
        write_image(root / f"cam05/{frame:04d}.png", pixels_of(3, frame))
    (root / "cam01.mp4").rename(root / "cam01.MP4")
    np.save(root / "poses_bounds.npy", np.stack([row_of(camera) for camera in range(5)]))
    scene = scenes.load(root)
    views = {view.name: view for view in scene.train}
    for frame in range(FRAMES):
        assert np.array_equal(views[f"cam02/{frame:04d}"].pixels, pixels_of(2, frame))
    assert abs(float(views["cam04/0000"].image[0, 0, 0]) * 255 - 100) < 4
    assert abs(float(views["cam01/0004"].image[0, 0, 1]) * 255 - 180) < 4
    assert "cam04.mp4 is read, and not the folder cam04" in scene.notes
    firsts = "cam02/8.png, cam05/0000.png"
    assert f"the first frames have different numbers, and are taken to be of one time: {firsts}" in scene.notes
    assert scene.fingerprint != first


@pytest.mark.parametrize("kind", ["bin", "ply"])
def test_initial_points(root, kind):
    """Catches points of the first frame that are left out, not told, or not part of the fingerprint."""
    (root / "points3D_downsample2.ply").touch()
    assert "initial points: random; not read: points3D_downsample2.ply" in scenes.load(root).notes
    without = scenes.load(root).fingerprint
    means = np.array([(0.5, -0.25, 0.0), (0.25, 0.5, 1.0)])
    if kind == "bin":
        Capture("PINHOLE", WIDTH, HEIGHT, (1, 1, 1, 1), [], np.empty((0, 4, 4)), means).write(root, kind)
    else:
        write_points(root / "points3D.ply", means, COLOR)
    scene = scenes.load(root)
    assert scene.points is not None
    torch.testing.assert_close(scene.placement.to_user(scene.points.means).numpy(), means, rtol=0, atol=1e-6)
    assert f"initial points: those of {'sparse/0/points3D.bin' if kind == 'bin' else 'points3D.ply'}" in scene.notes
    assert scene.fingerprint != without


def anonymous_bytes() -> int:
    """Memory of this process that is not of files; mapped files that were read do not count."""
    return int(re.findall(r"RssAnon:\s*(\d+)", Path("/proc/self/status").read_text())[0]) << 10


def test_frames_stay_on_disk(root):
    """Catches frames that fill the memory when they are loaded or used, that are decoded anew, or are kept stale."""
    noise = np.random.default_rng(0).integers(0, 256, (6, 8, 3), np.uint8)
    frames = [cv2.resize(np.roll(noise, n, 1), (640, 480), interpolation=cv2.INTER_NEAREST) for n in range(20)]
    for name in CAMERAS:
        write_film(root / f"{name}.mp4", frames)
    before = anonymous_bytes()
    scene = scenes.load(root)
    total = sum(float(view.target[::8].float().mean()) for view in (*scene.train, *scene.test))
    size = sum(path.stat().st_size for path in (root / n3v.DECODED).iterdir())
    assert size == 4 * 20 * 640 * 480 * 3
    assert anonymous_bytes() - before < size / 3  # frames of the film, and libraries
    assert total > 0
    files = {path: path.stat().st_mtime_ns for path in (root / n3v.DECODED).iterdir()}
    again = scenes.load(root)
    assert {path: path.stat().st_mtime_ns for path in (root / n3v.DECODED).iterdir()} == files
    assert torch.equal(again.test[3].pixels, scene.test[3].pixels)
    write_film(root / "cam00.mp4", frames[::-1])
    assert not torch.equal(scenes.load(root).test[3].pixels, scene.test[3].pixels)


def test_a_device_gets_a_frame_when_it_is_used(root):
    """Catches films that are copied to a GPU as a whole, and frames that stay on the CPU."""
    view = scenes.load(root).to("meta").test[0]
    assert view.pixels.device.type == "cpu"
    assert (view.camera.K.device.type, view.target.device.type, view.image.device.type) == ("meta",) * 3


def test_a_scene_of_the_release_fits_into_8_gb():
    """Catches an estimate below what is used, or that counts all frames: 20 cameras of 300 frames at half size."""
    assert n3v.memory_needed((2704, 2028), (1352, 1014), 300) < 8e9
    still = Camera(torch.eye(4), torch.eye(3), 40, 960)
    views = [View(str(n), still, n / 60, torch.full((960, 40, 3), n, dtype=torch.uint8)) for n in range(61)]
    moving(views[:3])  # libraries take memory once
    tracemalloc.start()
    moving(views)
    used = tracemalloc.get_traced_memory()[1]  # NumPy's, which has the most
    tracemalloc.stop()
    assert 0.7 < used / n3v.memory_needed((40, 960), (40, 960), 61) < 1


def poses(change: Callable[[np.ndarray], object]) -> Callable[[Path], object]:
    return lambda root: np.save(root / "poses_bounds.npy", change(np.load(root / "poses_bounds.npy")))


def stretched(rows: np.ndarray) -> np.ndarray:
    rows[2, 0:11:5] *= 1.1
    return rows


def mirrored(rows: np.ndarray) -> np.ndarray:
    rows[2, 0:11:5] *= -1
    return rows


def film(name: str, count: int, width: int = WIDTH, rate: float = 30) -> Callable[[Path], object]:
    return lambda root: write_film(root / f"{name}.mp4", [np.zeros((HEIGHT, width, 3), np.uint8)] * count, rate)


FAULTS: list[tuple[Callable[[Path], object], str]] = [
    (poses(lambda rows: rows[:-1]), "a row for each of 4 films, cam00 to cam04, got 3: .*leave_out"),
    (poses(lambda rows: rows[:, :-1]), r"expected 17 numbers for each film, .* got an array \[4, 16\]: write it so"),
    (poses(lambda rows: rows * np.nan), "expected finite numbers, some are not: copy it again"),
    (poses(lambda rows: rows.astype(object)), "poses_bounds.npy: expected an array as numpy.save writes"),
    (poses(stretched), "poses_bounds.npy: cam02: expected a rigid world-to-camera matrix"),
    (poses(mirrored), "cam02: expected a rigid"),
    (poses(lambda rows: rows * np.where(np.arange(17) == 14, -1, 1)), "cam00: expected height, width and focal length"),
    (poses(lambda rows: rows * np.where(np.arange(17) == 9, 2, 1)), "cam00.mp4: expected 64x24 as poses_bounds.npy"),
    (lambda root: (root / "poses_bounds.npy").write_bytes(b"\x93NUMPY"), "expected an array"),
    (film("cam02", FRAMES - 1), r"cam02.mp4: expected 5 frames as cam00.mp4, got 4.*scene.frames=\[0,3\]"),
    (film("cam100", FRAMES), "expected films cam00.mp4 to cam99.mp4, .* got cam100.mp4 too: rename"),
    (lambda root: (root / "cam02.mp4").rename(root / "cam_02.mov"), "got cam_02.mov too: rename"),
    (film("cam02", FRAMES, rate=60), "cam02.mp4: expected 30 frames a second as cam00.mp4, got 60: .* to one rate"),
    (film("cam02", FRAMES, 2 * WIDTH), "cam02.mp4: expected 32x24 as cam00.mp4, got 64x24"),
    (lambda root: (root / "cam02.mp4").write_bytes(b"#EXTM3U\nhttp://localhost/"), "cam02.mp4: expected an MP4"),
    (lambda root: (root / "cam02.mp4").write_bytes((root / "cam02.mp4").read_bytes()[:60]), "OpenCV cannot decode"),
    (lambda root: [(root / "cam02.mp4").unlink(), (root / "cam02").mkdir()], "a PNG or JPEG for each frame"),
    (
        lambda root: [write_image(root / f"cam05/{n}.png", pixels_of(0, 0)) for n in (1, 2, 4)],
        "cam05: expected frame 3",
    ),
    (lambda root: [write_image(root / f"cam05/{n}.png", pixels_of(0, 0)) for n in ("1", "01")], "expected frame 2"),
    (lambda root: [(root / f"{name}.mp4").unlink() for name in CAMERAS[1:]], "cam00, the test camera, and others"),
    (lambda root: (root / n3v.DECODED).write_bytes(b""), "a scene's folder in which decoded can be written"),
]


@pytest.mark.parametrize(("apply", "message"), FAULTS)
def test_faulty_files_are_told(root, apply, message):
    """Catches rows of other films, films out of step or of another size, and playlists that name other files."""
    assert_refused(root, apply, message)


def test_damaged_points_are_told_before_frames_are_decoded(root):
    """Catches minutes of decoding, and gigabytes, before a message on another file."""
    (root / "points3d.ply").write_bytes(b"")
    with pytest.raises(InputError, match="expected a PLY"):
        scenes.load(root)
    assert not (root / n3v.DECODED).exists()


def test_a_film_that_ends_early_leaves_no_file(root, monkeypatch):
    """Catches a film with fewer frames than it says, whose first frames would pass for a whole one."""
    with pytest.raises(InputError, match="expected frame 5, got 5"):
        scenes.load(root, frames=(0, 5))
    for frame in range(FRAMES):
        write_image(root / f"cam05/{frame}.png", pixels_of(2, frame))
    write_image(root / "cam05/4.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    np.save(root / "poses_bounds.npy", np.stack([row_of(camera) for camera in range(5)]))
    with pytest.raises(InputError, match=r"cam05/4\.png"):
        scenes.load(root)
    assert sorted(path.name[:5] for path in (root / n3v.DECODED).iterdir()) == [*CAMERAS]
    write_image(root / "cam05/4.png", np.zeros((HEIGHT // 2, WIDTH, 3), np.uint8))
    with pytest.raises(
        InputError, match=r"cam05: frame 4: expected .* 32x24 as others, got 3 channels of 8 bits and 32x12"
    ):
        scenes.load(root)
    monkeypatch.setattr(cv2.VideoCapture, "grab", lambda _: False)
    with pytest.raises(InputError, match=r"the film ends before frame 1: copy it again, or choose other scene\.frames"):
        scenes.load(root, frames=(1, 2))
    assert len(list((root / n3v.DECODED).iterdir())) == len(CAMERAS)


@pytest.mark.parametrize("late", [True, False])
def test_frames_at_uneven_times_are_told(late, root, monkeypatch, capsys):
    """Catches a film that has lost a frame, after which all are of another time, and a film of 29.97 that is blamed."""
    write_film(root / "cam02.mp4", [pixels_of(2, frame) for frame in range(FRAMES)], 29.97)
    plain, shown = cv2.VideoCapture.get, []

    def get(video: cv2.VideoCapture, key: int) -> float:
        value = plain(video, key)
        if late and key == cv2.CAP_PROP_POS_MSEC:
            shown.append(value)
            value += 33 * (len(shown) == FRAMES)  # the last frame of cam00
        return value

    monkeypatch.setattr(cv2.VideoCapture, "get", get)
    scenes.load(root)
    error = capsys.readouterr().err
    message = f"{root}/cam00.mp4: frame 4 comes 66.33 ms after the one before, others 33.33 ms: are frames missing"
    assert (message in error) is late
    assert "cam02.mp4: frame 1 comes" not in error


def test_captures_with_llff_poses_stay_captures(taken):
    """Catches a COLMAP capture that is taken for films because poses_bounds.npy lies beside its model."""
    (taken / "poses_bounds.npy").touch()
    assert len(scenes.load(taken).test) == 1


def test_a_full_disk_is_told_before_frames_are_decoded(root, monkeypatch):
    """Catches films that fill the disk one after the other."""
    left = 3 * FRAMES * WIDTH * HEIGHT * len(CAMERAS) - 1
    monkeypatch.setattr(n3v.shutil, "disk_usage", lambda _: SimpleNamespace(free=left))
    with pytest.raises(InputError, match=r"expected .* GB for frames of 4 films, got .*: free some"):
        scenes.load(root)
    assert not list((root / n3v.DECODED).iterdir())
