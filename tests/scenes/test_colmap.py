"""Your own captures: cameras, times and undistorted images are right, and what is wrong is said in one line."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from capture import COLOR, COUNT, HEIGHT, NAMES, WIDTH, Capture, circle, has_estimated_up, small_model
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from scipy.spatial.transform import Rotation
from tiny_run import main_here
from tiny_scene import assert_refused, write_image

from gsbench import scenes
from gsbench.errors import InputError
from gsbench.measure import record
from gsbench.run.load import SceneDescription
from gsbench.scenes import colmap, images
from gsbench.scenes.sample import folder
from gsbench.scenes.scene import up_of


@pytest.fixture(scope="module")
def blender() -> scenes.Scene:
    return scenes.load(folder() / "moving-matte")


def write_embedded(root: Path, blender: scenes.Scene, kind: str) -> list[scenes.View]:
    """Write 24 training views of an embedded scene as a capture with times.csv; return the views."""
    views = blender.train[:48:2]
    K, names = views[0].camera.K, [f"shot {i}.png" for i in range(len(views))]
    (root / "images").mkdir(parents=True)
    for view, name in zip(views, names, strict=True):
        shutil.copy(folder() / "moving-matte" / f"{view.name}.png", root / "images" / name)
    rows = [f"{name},{10 + 5 * view.time}" for view, name in zip(views, names, strict=True) if view.time is not None]
    (root / "times.csv").write_text("\n".join(["name,time", *rows, "not in the model.png,99"]))
    viewmats = torch.stack([view.camera.viewmat for view in views]).double().numpy()
    points = np.random.default_rng(0).uniform(-1, 1, (1000, 3))
    lens = tuple(float(value) for value in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    Capture("PINHOLE", 160, 160, lens, names, viewmats, points).write(root, kind)
    return views


@pytest.mark.parametrize("kind", ["bin", "txt"])
def test_an_embedded_scene_comes_back(tmp_path, blender, kind):
    """Catches a transposed rotation, a wrong order of numbers, images of other cameras, times and a split askew."""
    views = write_embedded(tmp_path / "own", blender, kind)
    scene = scenes.load(tmp_path / "own")
    assert has_estimated_up(scene)
    first, last = views[0].time, views[-1].time
    assert scene.name == "own"
    assert [len(scene.train), len(scene.val), len(scene.test)] == [21, 0, 3]
    loaded = {view.name: view for view in (*scene.train, *scene.test)}
    assert [view.name for view in scene.test] == ["shot 7", "shot 15", "shot 23"]
    for i, view in enumerate(views):
        taken = loaded[f"shot {i}"]
        torch.testing.assert_close(taken.camera.viewmat, view.camera.viewmat, rtol=0, atol=1e-6)
        assert torch.equal(taken.camera.K, view.camera.K)
        assert torch.equal(taken.image, view.image)
        assert taken.time == pytest.approx((view.time - first) / (last - first))
    assert lean(scene.up, np.array([0, 0, 1])) < 1
    assert SceneDescription.of(scene).up == list(scene.up)  # which a checkpoint keeps
    means = np.random.default_rng(0).uniform(-1, 1, (1000, 3)).astype(np.float32)
    torch.testing.assert_close(scene.points.means, torch.from_numpy(means))
    torch.testing.assert_close(scene.points.colors, torch.tensor([COLOR]).div(255).expand(1000, 3))


def test_it_is_trained(tmp_path, blender):
    """Catches a scene that a run does not accept, cameras of other images, and a choice that is not recorded."""
    write_embedded(tmp_path / "own", blender, "bin")
    words = ["+exp=colmap", "model=4dgs", "scene=custom", "scene.name=own", "scene.downscale=4"]
    words += ["train.iterations=50", "train.curve_points=1"]
    assert not main_here(*words, f"data.root={tmp_path}", f"results={tmp_path / 'results'}")
    (loaded,) = map(record.read, record.find(tmp_path / "results"))
    assert loaded.dataset == "colmap"
    assert loaded.metrics["psnr"] > 12.6  # 13.4; 11.8 where cameras have the images of others
    assert loaded.provenance.data_notes == list(scenes.load(tmp_path / "own").notes) != []


def rays(K: np.ndarray) -> np.ndarray:  # [H, W, 2]
    """The rays through the pixel centres of an undistorted image."""
    x, y = np.meshgrid(np.arange(WIDTH * 4) + 0.5, np.arange(HEIGHT * 4) + 0.5)
    return np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1]], -1)


def ray_seen(points: np.ndarray, k1: float, k2: float, p1: float, p2: float) -> np.ndarray:
    """The ray that a distorted pixel sees, by the fixed point of Brown's formula (OpenCV, calib3d)."""
    loaded = points.copy()
    for _ in range(100):
        x, y = loaded[..., 0], loaded[..., 1]
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2 * r2
        moved = np.stack([2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], -1)
        loaded = (points - moved) / radial[..., None]
    return loaded


def picture(ray: np.ndarray) -> np.ndarray:
    """A smooth image as a function of the ray, RGB in [0, 1]."""
    return 0.5 + 0.4 * np.stack([np.sin(3 * ray[..., 0]), np.cos(4 * ray[..., 1]), np.sin(2 * ray.sum(-1))], -1)


@pytest.mark.parametrize(
    ("model", "lens", "distortion"),
    [
        ("SIMPLE_RADIAL", (50.0, 30.0, 25.5), (-0.2,)),
        ("SIMPLE_RADIAL", (50.0, 30.0, 25.5), (0.15,)),
        ("RADIAL", (50.0, 33.0, 22.0), (-0.25, 0.05)),
        ("OPENCV", (50.0, 54.0, 35.0, 20.0), (-0.2, 0.03, 0.01, -0.02)),
    ],
)
def test_distortion_is_undone(tmp_path, model, lens, distortion):
    """Catches coefficients in a wrong order, K that is not the image's, blank pixels, and half a pixel of an offset."""
    width, height = WIDTH * 4, HEIGHT * 4
    K = np.array([[lens[0], 0, lens[-2]], [0, lens[-3], lens[-1]], [0, 0, 1]])
    visible = ray_seen(rays(K), *distortion, *[0.0] * (4 - len(distortion)))
    for name in NAMES:
        write_image(tmp_path / "images" / name, np.rint(picture(visible) * 255).astype(np.uint8))
        write_image(tmp_path / "masks" / name, np.where(visible[..., 0] > 0.1, 9, 0).astype(np.uint8))
    Capture(model, width, height, (*lens, *distortion), NAMES, circle(COUNT)).write(tmp_path, "bin")
    view = scenes.load(tmp_path).train[0]
    expected = rays(view.camera.K.double().numpy())
    error = np.abs(view.image.numpy() - picture(expected))
    assert error.max() < 0.0045  # of 8 bits and interpolation; 0.0048 to 0.011 with an offset of half a pixel
    assert error.mean() < 0.0013
    assert view.regions is not None
    agree = (view.regions.numpy() == np.where(expected[..., 0] > 0.1, 9, 0)).mean()
    assert agree > 0.98
    assert set(view.regions.unique().tolist()) == {0, 9}
    half = scenes.load(tmp_path, downscale=2).train[0]
    torch.testing.assert_close(half.camera.K[:2] * 2, view.camera.K[:2])
    shutil.rmtree(tmp_path / "masks")
    for name in NAMES:  # the lens is that of the full size, the images are not
        reduced = cv2.resize(picture(visible), (width // 2, height // 2), interpolation=cv2.INTER_AREA)
        write_image(tmp_path / "images" / name, np.rint(reduced * 255).astype(np.uint8))
    half = scenes.load(tmp_path).train[0]
    torch.testing.assert_close(half.camera.K[:2] * 2, view.camera.K[:2], rtol=0.02, atol=0)
    expected = picture(rays(half.camera.K.double().numpy())[: height // 2, : width // 2])
    assert np.abs(half.image.numpy() - expected)[2:-2, 2:-2].max() < 0.02


def test_a_pinhole_stays_exact(taken, capsys):
    """Catches a principal point that is moved to the centre, pixels that are resampled without a reason, and images of
    half the size that are refused or read with the intrinsics of the full one."""
    view = scenes.load(taken).train[3]
    assert view.camera.K.tolist() == [[20, 0, 3.25], [0, 21, 9.5], [0, 0, 1]]
    assert (view.image * 255).unique().tolist() == [60]
    for path in (taken / "images").iterdir():
        write_image(path, np.zeros((HEIGHT // 2, WIDTH // 2, 3), np.uint8))
    view = scenes.load(taken).train[0]
    assert view.camera.K.tolist() == [[10, 0, 1.625], [0, 10.5, 4.75], [0, 0, 1]]
    assert "images of 8x6 are resized from those of their camera, 16x12" in capsys.readouterr().err


NAMINGS: dict[str, tuple[Callable[[int], str], Callable[[int], float], str]] = {  # names, their times, a note
    "JPEGs of a camera": (lambda i: f"cam9/take2_{100 - 10 * i}.jpg", lambda i: 1 - i / 8, "number 3 of 3 in"),
    "a rig, frames first": (lambda i: f"frame_{i // 3:04d}/cam{i % 3}.png", lambda i: i // 3 / 2, "number 1 of 2 in"),
    "with spaces": (lambda i: f"my shot {i}.png", lambda i: i / 8, "the number in each name, 0 to 8"),
}


@pytest.mark.parametrize("naming", NAMINGS)
def test_times_of_names(taken, naming, capsys):
    """Catches a number of the folder or the camera taken for the time, order by text, JPEGs that are not found, a name
    that is cut at its first space, and a choice that is not printed."""
    name_of, time_of, note = NAMINGS[naming]
    names = [name_of(i) for i in range(COUNT)]
    for old, new in zip(NAMES, names, strict=True):
        (taken / "images" / new).parent.mkdir(exist_ok=True)
        (taken / "images" / old).rename((taken / "images" / new).with_suffix(".png"))
    small_model(taken, names, np.tile(circle(3), (3, 1, 1)) if "rig" in naming else None)
    scene = scenes.load(taken)
    times = {view.name: view.time for view in (*scene.train, *scene.test)}
    assert times == {name_of(i)[:-4]: time_of(i) for i in range(COUNT)}
    assert f"{taken.name}: times: {note}" in capsys.readouterr().err


def test_images_that_colmap_did_not_register_are_told(taken):
    """Catches a capture of which a part is left out in silence."""
    assert len(scenes.load(taken).notes) == 1
    (taken / "images" / NAMES[3]).with_name("more.JPG").write_bytes(b"")
    note = "1 images are not in the COLMAP model and are left out, such as 'images/more.JPG'"
    assert scenes.load(taken).notes[1:] == (note,)


@pytest.mark.parametrize("kind", ["JPEG", "PNG"])
def test_an_exif_orientation_is_told(taken, kind):
    """Catches pixels that other programs turn, and gsbench does not, in silence."""
    exif = Image.Exif()
    for i, path in enumerate(sorted((taken / "images").rglob("*.png"))):
        with Image.open(path) as image:
            pixels = image.convert("RGB")
        exif[274] = 6 if i < 3 else i % 2  # 1: as stored, 0: unknown
        pixels.save(path, kind, **({"exif": exif} if i < 6 else {}))
    assert any(f"3 of {COUNT} images have an EXIF orientation" in note for note in scenes.load(taken).notes)


JPEG = ["jpg", "jpeg", "JPG", "JPEG"]


def write_jpegs(taken: Path) -> list[str]:
    """Write the images of a capture as JPEGs of every suffix, beside PNGs of another picture; return their names."""
    names = [f"frame_{i:03d}.{JPEG[i % len(JPEG)]}" for i in range(COUNT)]
    across, down = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    for i, name in enumerate(names):
        write_image(taken / "images" / name, np.stack([10 * across, 20 * down, 0 * down + 20 * i], -1).astype(np.uint8))
    small_model(taken, names)
    return names


def test_jpegs_are_read(taken, monkeypatch):
    """Catches a suffix that is not known, blue in place of red, the PNG of that name, and a scene kept in 8 bits."""
    write_jpegs(taken)
    for most in (images._MOST_FLOATS, 0):  # as floats, and in 8 bits
        monkeypatch.setattr(images, "_MOST_FLOATS", most)
        scene = scenes.load(taken)
        assert len(scene.train) + len(scene.test) == COUNT
        for view in (*scene.train, *scene.test):
            red, green, blue = (view.image * 255).unbind(-1)
            error = [
                (red - 10 * torch.arange(WIDTH)).abs(),
                (green - 20 * torch.arange(HEIGHT)[:, None]).abs(),
                (blue - 20 * int(view.name[-3:])).abs(),
            ]
            assert torch.stack(error).mean() < 6  # JPEG halves the resolution of colours; measured: 3.3
        assert [view.name for view in scene.test] == ["frame_007"]
    scene = scenes.load(taken, downscale=2)
    assert scene.train[0].image.shape == (HEIGHT // 2, WIDTH // 2, 3)


@given(at=st.integers(0, 10_000), value=st.binary(min_size=1, max_size=8))
def test_changed_bytes_of_a_jpeg_are_an_input_error_or_an_image(at, value):
    """Catches any other exception of the decoder, and an image of another shape than its header says."""
    data = bytearray(cv2.imencode(".jpg", np.arange(WIDTH * HEIGHT * 3, dtype=np.uint8).reshape(HEIGHT, WIDTH, 3))[1])
    start = 3 + at % (len(data) - 3)
    data[start : start + len(value)] = value[: len(data) - start]
    try:
        size = images.photo_size(bytes(data), "x.jpg")
        assert images.decode_photo(bytes(data), "x.jpg").shape == (size[1], size[0], 3)
    except InputError:
        return


def arc(degrees: float, pitch: float, roll: float = 0.0, count: int = 24) -> np.ndarray:  # [count, 4, 4]
    """Cameras on an arc around the z axis that look down by `pitch` degrees; `roll`: their deviation, in degrees."""
    yaw, rolls = np.linspace(0, degrees, count), roll * np.random.default_rng(0).standard_normal(count)
    level = Rotation.from_euler("x", -90, degrees=True)  # x right, z down to x right, z forward along y
    stand = Rotation.from_euler("zxz", np.stack([-yaw, 0 * yaw, 0 * yaw], 1), degrees=True)
    look = Rotation.from_euler("zx", np.stack([rolls, pitch + 0 * yaw], 1), degrees=True)
    viewmats = np.tile(np.eye(4), (count, 1, 1))
    viewmats[:, :3, :3] = (look * level.inv() * stand).as_matrix()
    viewmats[:, 2, 3] = 4
    return viewmats


def lean(up: tuple[float, float, float], true: np.ndarray) -> float:
    """The angle between two unit vectors, in degrees."""
    return float(np.degrees(np.arccos(np.clip(np.dot(up, true), -1, 1))))


@pytest.mark.parametrize("turn", [np.eye(3), *(Rotation.random(random_state=seed).as_matrix() for seed in range(3))])
def test_up_is_level_to_the_cameras_and_turns_with_the_world(turn):
    """Catches the mean of up vectors, which leans by 25 degrees on an arc of 120 from which cameras look down, z taken
    for up in a world whose axes are arbitrary, down for up, and a division by zero where cameras stand every way."""
    for degrees, pitch, roll, most in (
        (360, 30, 0, 0.1),
        (120, 30, 0, 1),
        (60, 40, 0, 6),
        (120, 30, 2, 2),
        (360, 30, 5, 4),
        (0, 0, 0, 0.1),
    ):
        viewmats = arc(degrees, pitch, roll)
        viewmats[:, :3, :3] = viewmats[:, :3, :3] @ turn.T
        assert lean(up_of(torch.from_numpy(viewmats)), turn @ [0, 0, 1]) < most
    viewmats = arc(360, 0)
    viewmats[::2, :2] *= -1
    assert up_of(torch.from_numpy(viewmats)) == (0, 0, 1)


def text(part: str, old: str, new: str, count: int = 1) -> Callable[[Path], object]:
    """Replace words of a file of the model."""

    def change(taken: Path) -> None:
        path = taken / "sparse" / "0" / f"{part}.txt"
        assert old in path.read_text()
        path.write_text(path.read_text().replace(old, new, count))

    return change


def table(content: str) -> Callable[[Path], object]:
    return lambda taken: (taken / "times.csv").write_text(content)


def image(change: Callable[[Path], object]) -> Callable[[Path], object]:
    return lambda taken: change(taken / "images/frame_001.png")


def jpeg(change: Callable[[Path], object]) -> Callable[[Path], object]:
    """Make all images JPEGs and change the second, frame_001.jpeg."""
    return lambda taken: change(taken / "images" / write_jpegs(taken)[1])


def paint(*shape: int) -> Callable[[Path], None]:
    return lambda path: write_image(path, np.zeros(shape, np.uint8))


def link(target: str) -> Callable[[Path], object]:
    return lambda path: [path.unlink(), path.symlink_to(target)]


ROWS = "".join(f"{name},{i}\n" for i, name in enumerate(NAMES))
FAULTS: dict[str, tuple[Callable[[Path], object], str]] = {
    "no cameras": (lambda taken: (taken / "sparse/0/cameras.txt").unlink(), r"cameras\.bin or cameras\.txt"),
    "no points": (
        lambda taken: (taken / "sparse/0/points3D.txt").write_text("# none\n"),
        "at least one point.*triangulator",
    ),
    "fisheye": (text("cameras", "PINHOLE", "OPENCV_FISHEYE"), "OPENCV_FISHEYE.*colmap image_undistorter"),
    "unknown model": (text("cameras", "PINHOLE", "LENS\t"), "got 'LENS'"),
    "too few parameters": (text("cameras", " 9.5", ""), "PINHOLE with fx fy cx cy"),
    "focal negative": (text("cameras", "20.0", "-20"), "positive focal lengths"),
    "camera twice": (text("cameras", "# comment", "7 SIMPLE_PINHOLE 16 12 20 8 6"), "camera 7 appears twice"),
    "camera cut": (text("cameras", "16 12", "16"), "expected a camera's id"),
    "size of the camera": (text("cameras", "16 12", "32 20"), "frame_000.*expected 32x20 as its camera"),
    "pose NaN": (text("images", "1 1.0", "1 nan"), "unit quaternion"),
    "quaternion": (text("images", "1 1.0", "1 3.0"), "unit quaternion"),
    "no such camera": (text("images", "7 frame_000", "8 frame_000"), "a camera of the model, got number 8"),
    "line cut": (text("images", " 7 frame_000.png", ""), "line 2: expected an image's id"),
    "name twice": (text("images", "frame_001", "frame_000"), "frame_000.png' appears twice"),
    "two names of one file": (
        text("images", "frame_001.png", "frame_000.JPG"),
        "'frame_000.JPG': .* a file of its own",
    ),
    "two files of one name": (
        lambda taken: [
            (taken / "images/frame_000.jpg").touch(),
            text("images", "frame_001.png", "frame_000.jpg")(taken),
        ],
        "in more than its suffix, got 'images/frame_000.jpg', and 'frame_000.png' is there too: rename",
    ),
    "name leaves": (text("images", "frame_001", "../../../etc/1"), "expected a path inside"),
    "no number": (text("images", "frame_001.png", "x.png"), "expected a number in its name"),
    "fewer images than the split needs": (lambda taken: small_model(taken, NAMES[:7]), "at least 8 images"),
    "image missing": (image(Path.unlink), "frame_001.png.*found none"),
    "image is a link to a device": (image(link("/dev/zero")), "expected a file, found a device"),
    "image truncated": (image(lambda path: os.truncate(path, 40)), "damaged PNG"),
    "another size": (image(paint(9, 9, 3)), "expected 16x12 as its camera, or both sides resized by one .*got 9x9"),
    "jpeg cut": (jpeg(lambda path: os.truncate(path, path.stat().st_size - 40)), "damaged JPEG.*truncated"),
    "jpeg is a gif": (jpeg(lambda path: path.write_bytes(b"GIF89a")), "frame_001.jpeg.*expected a PNG"),
    "jpeg is grey": (jpeg(paint(HEIGHT, WIDTH)), "expected a JPEG of RGB, got one of L"),
    "jpeg is a link to text": (jpeg(link("/etc/passwd")), "expected a PNG or a JPEG"),
    "folded": (text("cameras", "PINHOLE 16 12 20.0 21.0", "RADIAL 16 12 5 5 5 -9 9"), "PINHOLE|RADIAL with"),
    "too distorted": (
        text("cameras", "PINHOLE 16 12 20.0 21.0 3.25 9.5", "RADIAL 16 12 5.0 8 6 -9.0 1.0"),
        "cannot undo the distortion",
    ),
    "mask missing": (lambda taken: (taken / "masks").mkdir(), "the mask of frame_00"),
    "table without header": (table(ROWS), "first line name,time"),
    "table empty": (table(""), "first line name,time"),
    "name in the table twice": (table(f"name,time\n{ROWS}frame_000.png,1\n"), "line 11: expected a name, once"),
    "time missing": (table("name,time\nframe_000.png,1\n"), "got none of 'frame_001.png'"),
    "table is binary": (lambda taken: (taken / "times.csv").write_bytes(b"\xff\x00"), "expected a table"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_fault_is_one_line_that_says_what_is_wrong(taken, fault):
    """Catches a fault let through, missing rows that are read as grey, and a stack trace from the depths."""
    apply, message = FAULTS[fault]
    assert_refused(taken, apply, message)


@pytest.mark.parametrize(
    ("models", "words"),
    [
        ({"sparse/0": 8, "sparse/1": 9}, "sparse/1 with the most images, 9, is read; sparse/0 has 8"),
        ({"sparse/0": 8, "sparse/2": 9, "sparse/10": 8}, "sparse/2 with the most images, 9, is read; sparse/0 has 8"),
        ({"sparse/0": 8, "sparse": 9}, "sparse with the most images, 9, is read; sparse/0 has 8"),
        ({"sparse/0": 9, "sparse": 9}, "sparse/0 with the most images, 9, is read; sparse has 9"),
        ({"sparse/1": 9}, "times: "),
        ({"sparse": 9}, "times: "),
    ],
)
def test_the_largest_model_is_read(taken, models, words):
    """Catches sparse/0 read silently where another is larger, a lone folder refused, and a line for every capture."""
    shutil.rmtree(taken / "sparse")
    for where, count in models.items():
        small_model(taken, NAMES[:count], where=where)
    scene = scenes.load(taken)
    assert len(scene.train) + len(scene.test) == max(models.values())
    assert len(scene.notes) == 1 + (len(models) > 1)
    assert words in scene.notes[-1]


def test_a_text_file_beside_a_binary_one_is_told(taken):
    """Catches an edited images.txt that images.bin hides, and a list of test images that is not followed."""
    (taken / "sparse/0/test.txt").touch()
    Capture("PINHOLE", WIDTH, HEIGHT, (20.0, 21.0, 3.25, 9.5), NAMES, circle(COUNT)).write(taken, "bin")
    (taken / "sparse/0/cameras.txt").unlink()
    notes = scenes.load(taken).notes
    assert "images.txt, points3D.txt in sparse/0 are not read, as there are .bin files" in notes
    assert "test.txt in sparse/0 is not read: every 8th image is a test view" in notes


def test_a_principal_point_that_hides_all_points_is_asked_for(taken):
    """Catches a message that asks for other points where the principal point is in the wrong place."""
    (taken / "sparse/0/cameras.txt").write_text(f"7 PINHOLE {WIDTH} {HEIGHT} 20 20 8000 6\n")
    with pytest.raises(InputError, match=r"they see none .* principal points in pixels of the images"):
        scenes.load(taken)


LINES: dict[str, Callable[[str], str]] = {
    "carriage returns": lambda text: text.replace("\n", "\r\n"),
    "byte order mark": lambda text: "\ufeff" + text,
    "comments": lambda text: text.replace("\n4 ", "\n# four\n  # and more\n4 "),
    "blank lines before an image": lambda text: text.replace("\n5 ", "\n\n\n5 "),
    "no last line": lambda text: text.rstrip("\n"),
}


@pytest.mark.parametrize("change", LINES)
def test_images_txt_as_programs_write_it(taken, change):
    """Catches what an editor on Windows adds, which changes no number."""
    expected = scenes.load(taken)
    for part in ("images", "cameras", "points3D"):
        path = taken / "sparse/0" / f"{part}.txt"
        if part == "images" or change in ("carriage returns", "byte order mark"):
            path.write_bytes(LINES[change](path.read_text()).encode())
    scene = scenes.load(taken)
    assert [view.name for view in scene.train] == [view.name for view in expected.train]
    assert all((a.camera.viewmat == b.camera.viewmat).all() for a, b in zip(scene.train, expected.train, strict=True))


@pytest.mark.parametrize("which", ["all", "second", "last but one", "numbers for a name", "name with spaces"])
def test_images_txt_without_second_lines_is_refused(taken, which):
    """Catches every second image dropped in silence."""
    path = taken / "sparse/0/images.txt"
    head, *lines = path.read_text().split("\n")
    pairs = [[lines[2 * i], lines[2 * i + 1]] for i in range(COUNT)]
    if which == "numbers for a name":
        pairs = [[line.replace("frame_", "").replace(".png", ""), ""] for line, _ in pairs]
    if which == "name with spaces":
        pairs = [[line.replace("frame_", "a frame "), ""] for line, _ in pairs]
    for i in {"second": [1], "last but one": [COUNT - 2]}.get(which, range(COUNT - 1)):
        pairs[i].pop()
    path.write_text("\n".join([head, *(line for pair in pairs for line in pair)]))
    with pytest.raises(InputError, match=r"expected the keypoints .* or an empty line, got .*after each image"):
        scenes.load(taken)


READERS = {"cameras": colmap.read_cameras, "images": colmap.read_images, "points3D": colmap.read_points}
BINARY = Capture("OPENCV", WIDTH, HEIGHT, (20.0, 21.0, 8.0, 6.0, 0.1, 0, 0, 0), NAMES, circle(COUNT)).binary()


@pytest.mark.parametrize("part", READERS)
@given(cut=st.integers(1, 10_000), more=st.binary(min_size=1, max_size=60))
def test_a_binary_file_of_another_length_is_refused(part, cut, more):
    """Catches a truncated file that is read as a smaller model, and bytes after its end."""
    whole = BINARY[part]
    for data in (whole[: -1 - cut % len(whole)], whole + more, b"\xff" * 8 + whole[8:]):
        with pytest.raises(InputError):
            READERS[part](colmap.ModelFile(Path(f"{part}.bin"), data))


@pytest.mark.parametrize("number", [-1, 99])
def test_a_number_that_is_no_model_is_refused(number):
    """Catches a number that counts from the end of the list of models, as -1 does in Python."""
    data = bytearray(BINARY["cameras"])
    data[12:16] = number.to_bytes(4, "little", signed=True)  # after the count and the camera's number
    with pytest.raises(InputError, match=f"model {number}"):
        colmap.read_cameras(colmap.ModelFile(Path("cameras.bin"), bytes(data)))


@pytest.mark.parametrize("part", READERS)
@given(at=st.integers(0, 10_000), value=st.binary(min_size=1, max_size=8))
def test_changed_bytes_are_an_input_error_or_finite(part, at, value):
    """Catches any other exception, an endless loop over a huge count, and numbers that are not finite."""
    data = bytearray(BINARY[part])
    start = at % len(data)
    data[start : start + len(value)] = value[: len(data) - start]
    try:
        loaded = READERS[part](colmap.ModelFile(Path(f"{part}.bin"), bytes(data)))
    except InputError:
        return
    values = [loaded.means, loaded.colors] if part == "points3D" else []
    values += [torch.tensor(lens.K) for lens in loaded.values()] if part == "cameras" else []
    values += [torch.tensor(image.viewmat) for image in loaded] if part == "images" else []
    assert values
    assert all(value.isfinite().all() for value in values)
