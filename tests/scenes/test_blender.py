"""The Blender loader on data that is right: cameras, pixels, sizes, fingerprints, the real scenes."""

import hashlib
import json
import math
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from tiny_scene import edit, write_png, write_tiny

from gsbench import scenes
from gsbench.errors import InputError
from gsbench.scenes import images
from gsbench.scenes.sample import folder


def project(view: scenes.View, point: list[float]) -> tuple[float, float, float]:
    """Pixel coordinates and depth of a world point."""
    camera = view.camera
    x, y, depth = camera.viewmat[:3, :3] @ torch.tensor(point, dtype=torch.float32) + camera.viewmat[:3, 3]
    u, v, _ = camera.K @ torch.stack([x / depth, y / depth, torch.tensor(1.0)])
    return float(u), float(v), float(depth)


@pytest.mark.parametrize(
    ("name", "counts"), [("moving-matte", (120, 15, 15)), ("pendulum", (132, 10, 20)), ("suzanne", (120, 15, 15))]
)
def test_embedded_scenes_are_complete(name: str, counts: tuple[int, int, int]) -> None:
    """Catches package data that lacks a file, a wrong split, and an image out of its contract."""
    scene = scenes.load(folder() / name)
    assert (len(scene.train), len(scene.val), len(scene.test)) == counts
    assert scene.name == name
    assert scene.has_time
    assert scene.points is None
    for view in scene.train + scene.val + scene.test:
        assert view.image.shape == (view.camera.height, view.camera.width, 3) == (160, 160, 3)
        assert view.image.dtype == view.camera.viewmat.dtype == view.camera.K.dtype == torch.float32
        assert view.image.is_contiguous()
        assert 0 <= view.image.min() <= view.image.max() <= 1
        assert view.time is not None
        assert 0 <= view.time <= 1


def test_camera_of_a_known_frame() -> None:
    """Golden: centre, K and name of suzanne's train/r_003, worked out by hand from its JSON."""
    view = scenes.load(folder() / "suzanne").train[3]
    assert view.name == "train/r_003"
    assert view.time == 4 / 149
    torch.testing.assert_close(view.camera.center, torch.tensor([2.0429485, 3.2756876, 2.5012462]), atol=1e-6, rtol=0)
    focal = 80 / math.tan(0.6911 / 2)
    expected = torch.tensor([[focal, 0, 80], [0, focal, 80], [0, 0, 1]])
    torch.testing.assert_close(view.camera.K, expected)


def test_intrinsics_follow_the_downscale() -> None:
    """Catches intrinsics left in pixels of the full image, and a centre scaled as if pixel centres were integers."""
    camera = scenes.load(folder() / "suzanne", downscale=2).train[3].camera
    focal = 40 / math.tan(0.6911 / 2)
    assert (camera.width, camera.height) == (80, 80)
    torch.testing.assert_close(camera.K, torch.tensor([[focal, 0, 40], [0, focal, 40], [0, 0, 1]]))


@pytest.mark.parametrize("background", [(0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (0.25, 0.5, 0.75)])
def test_straight_alpha_is_composited_once(background: tuple[float, float, float]) -> None:
    """Golden: suzanne's train/r_003 stores RGBA 177 204 194 173 at row 29, column 82; catches a second alpha."""
    pixel = scenes.load(folder() / "suzanne", background=background).train[3].image[29, 82]
    alpha = 173 / 255
    expected = [c / 255 * alpha + b * (1 - alpha) for c, b in zip((177, 204, 194), background, strict=True)]
    torch.testing.assert_close(pixel, torch.tensor(expected), atol=1e-6, rtol=0)


def test_axes(tiny: Path) -> None:
    """Catches a flipped or swapped axis: right is +u, up is -v, ahead is +depth, for two cameras by hand."""
    scene = scenes.load(tiny)
    f = 4 / math.tan(0.4)
    front, side = scene.train
    assert project(front, [0, 0, 0]) == pytest.approx((4, 3, 4), abs=1e-5)
    assert project(front, [1, 0, 0]) == pytest.approx((4 + f / 4, 3, 4), abs=1e-5)
    assert project(front, [0, 1, 0]) == pytest.approx((4, 3 - f / 4, 4), abs=1e-5)
    assert project(front, [0, 0, 1]) == pytest.approx((4, 3, 3), abs=1e-5)
    assert project(side, [0, 0, -1]) == pytest.approx((4 + f / 4, 3, 4), abs=1e-5)
    assert project(side, [1, 1, 0]) == pytest.approx((4, 3 - f / 3, 3), abs=1e-5)


def test_embedded_cameras_look_at_the_scene() -> None:
    """The rendered scenes aim every camera at the origin: catches axes that only happen to fit a hand-made camera."""
    scene = scenes.load(folder() / "moving-matte")
    for view in scene.train + scene.test:
        u, v, depth = project(view, [0, 0, 0])
        assert (u, v) == pytest.approx((80, 80), abs=0.1)
        assert depth > 1
        assert project(view, [0, 0, 0.5])[1] < v  # the world's +z is up in these pictures


@pytest.mark.parametrize("background", [(0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (0.25, 0.5, 0.7)])
@pytest.mark.parametrize("channels", [3, 4])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_a_large_scene_stays_in_8_bits_and_looks_the_same(
    background: tuple[float, float, float], channels: int, dtype: type[np.generic], tiny: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """Catches 500 views of 800 x 800 that take 4 GB, and 8 bits whose images differ by as much as one bit."""
    random = np.random.default_rng(1)
    for name in ("train/r_0", "train/r_1", "val/r_0", "test/r_0"):
        rgba = random.integers(0, np.iinfo(dtype).max + 1, (240, 320, channels)).astype(dtype)
        rgba[:20, ..., 3:], rgba[-20:, ..., 3:] = 0, np.iinfo(dtype).max
        write_png(tiny / f"{name}.png", rgba)
    floats = scenes.load(tiny, background=background)
    monkeypatch.setattr(images, "_MOST_FLOATS", 0)
    small, reduced = scenes.load(tiny, background=background), scenes.load(tiny, background=background, downscale=2)
    for plain, other in zip(floats.train + floats.val + floats.test, small.train + small.val + small.test, strict=True):
        assert plain.pixels.dtype == torch.float32
        assert other.pixels.element_size() == (1 if dtype == np.uint8 else 4)
        assert torch.equal(plain.image, other.to("cpu").image)
    assert floats.fingerprint == small.fingerprint
    assert reduced.train[0].pixels.dtype == torch.float32  # a quarter of the pixels: fewer bytes than 8 bits of all


@pytest.mark.slow
def test_500_views_take_a_third_of_the_memory(tmp_path: Path) -> None:
    """Catches floats that are made of all images at once: 500 views of 800 x 800 have 3.8 GB of them."""
    write_tiny(tmp_path)
    image = np.random.default_rng(0).integers(0, 256, (800, 800, 4), np.uint8)
    image[:, 100:] = 0  # it compresses well
    write_png(tmp_path / "train" / "r_0.png", image)
    for name in ("val/r_0", "test/r_0"):
        write_png(tmp_path / f"{name}.png", image)
    edit(
        tmp_path, lambda content: content.update(frames=[{**content["frames"][0], "time": i / 499} for i in range(500)])
    )
    code = (
        "import resource\n"
        "from gsbench import scenes\n"
        "peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024\n"
        "before = peak()\n"
        f"scene = scenes.load({str(tmp_path)!r}, background=(1.0, 1.0, 1.0))\n"
        "for view in scene.train: view.image\n"
        "print(peak() - before)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(done.stdout) < 1.45e9  # 1.29 GB of 8 bits, and what a few readers need meanwhile


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [3, 4])
@pytest.mark.parametrize("downscale", [1, 2, 3])
def test_area_filter_is_the_mean_of_composited_blocks(
    tiny: Path, dtype: type[np.generic], channels: int, downscale: int
) -> None:
    """Against a float64 mean: catches 8-bit rounding on the way, RGB/BGR, another filter, bleeding of clear pixels."""
    limit = np.iinfo(dtype).max
    rgba = np.random.default_rng(1).integers(0, limit + 1, (6, 12, channels)).astype(dtype)
    rgba[:3, :, 3:] = 0  # a silhouette: clear pixels carry random colours
    for name in ("train/r_0", "train/r_1", "val/r_0", "test/r_0"):
        write_png(tiny / f"{name}.png", rgba)
    background = (0.2, 0.4, 0.9)
    image = scenes.load(tiny, downscale=downscale, background=background).train[0].image
    values = rgba / limit
    alpha = values[..., 3:] if channels == 4 else 1.0
    full = values[..., :3] * alpha + np.array(background) * (1 - alpha)
    blocks = full.reshape(6 // downscale, downscale, 12 // downscale, downscale, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(image.numpy(), blocks, atol=1e-6)


def bicubic(image: np.ndarray, axis: int) -> np.ndarray:
    """Halve an axis of an 8-bit image by the cubic of Keys (a = -1/2) at twice its width, rounded to 8 bits."""
    count = image.shape[axis]
    distance = np.abs((np.arange(count)[None] + 0.5 - 2 * np.arange(count // 2)[:, None] - 1) / 2)
    near = (1.5 * distance - 2.5) * distance**2 + 1
    far = ((-0.5 * distance + 2.5) * distance - 4) * distance + 2
    weights = np.where(distance < 1, near, np.where(distance < 2, far, 0))
    weights /= weights.sum(1, keepdims=True)
    return np.clip(np.rint(np.moveaxis(np.tensordot(weights, image, (1, axis)), 0, axis)), 0, 255)


@pytest.mark.parametrize("background", [(0.0, 0.0, 0.0), (1.0, 1.0, 1.0)])
def test_pillows_filter_reduces_the_8_bit_composite(tiny: Path, background: tuple[float, float, float]) -> None:
    """Catches a mean, a cubic that is not widened, a composite that is rounded up or reduced before it is made."""
    rgba = cv2.cvtColor(cv2.imread(str(tiny / "train/r_0.png"), cv2.IMREAD_UNCHANGED), cv2.COLOR_BGRA2RGBA) / 255.0
    alpha = rgba[..., 3:]
    composite = np.floor((rgba[..., :3] * alpha + np.array(background) * (1 - alpha)) * 255)
    whole = scenes.load(tiny, resize="pillow", background=background).train[0]
    np.testing.assert_array_equal(whole.image.numpy(), (composite / 255).astype(np.float32))
    half = scenes.load(tiny, resize="pillow", downscale=2, background=background).train[0]
    expected = bicubic(bicubic(composite, 1), 0)
    np.testing.assert_allclose(half.image.numpy() * 255, expected, atol=1e-3)
    area = scenes.load(tiny, downscale=2, background=background).train[0]
    assert (half.image - area.image).abs().max() > 0.02
    assert torch.equal(half.camera.K, area.camera.K)


def test_a_large_scene_is_not_kept_in_8_bits_of_alpha(tiny: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches the filter left out where images are composited at each access."""
    small = scenes.load(tiny, resize="pillow").train[0].image
    monkeypatch.setattr(images, "_MOST_FLOATS", 0)
    assert torch.equal(scenes.load(tiny, resize="pillow").train[0].image, small)


def test_an_unknown_filter_is_told(tiny: Path) -> None:
    """Catches a misspelt filter that loads the images of another protocol."""
    with pytest.raises(InputError, match=r"resize 'pilow' is not known\. Did you mean 'pillow'"):
        scenes.load(tiny, resize="pilow")


def test_focal_length_and_principal_point_from_the_file(tiny: Path) -> None:
    """Catches fl_x and its companions ignored, swapped or not scaled, and a fl_y that does not fall back to fl_x."""
    for split in ("train", "test"):
        edit(tiny, lambda c: c.pop("camera_angle_x"), split)
    edit(tiny, lambda c: c.update(fl_x=10.0, fl_y=12.0, cx=3.0, cy=5.0, w=8, h=6))
    edit(tiny, lambda c: c.update(fl_x=10.0), "test")
    scene = scenes.load(tiny, downscale=2)
    expected = torch.tensor([[5.0, 0, 1.5], [0, 6.0, 2.5], [0, 0, 1]])
    torch.testing.assert_close(scene.train[0].camera.K, expected)
    torch.testing.assert_close(scene.test[0].camera.K, torch.tensor([[5.0, 0, 2], [0, 5.0, 1.5], [0, 0, 1]]))
    torch.testing.assert_close(scene.val[0].camera.K[0, 0], torch.tensor(2 / math.tan(0.4)))


def test_static_sets_and_sets_without_val(tiny: Path) -> None:
    """NeRF-synthetic has no time, and some copies no val: catches an invented time and a refused scene."""
    for split in ("train", "test"):
        edit(tiny, lambda c: [frame.pop("time") for frame in c["frames"]], split)
    (tiny / "transforms_val.json").unlink()
    scene = scenes.load(tiny)
    assert scene.val == []
    assert not scene.has_time
    assert all(view.time is None for view in scene.train + scene.test)


def test_val_is_held_out_of_train_where_there_is_none(tiny: Path) -> None:
    """Catches views that are in train and val, an extent that changes the rates, and a val that is overwritten."""
    with pytest.raises(InputError, match=r"expected no views of val, tiny has 1"):
        scenes.load(tiny).with_val(2)
    (tiny / "transforms_val.json").unlink()
    scene = scenes.load(tiny)
    held = scene.with_val(2)
    assert [view.name for view in held.train] == [view.name for view in scene.train[::2]]
    assert [view.name for view in held.val] == [view.name for view in scene.train[1::2]]
    assert (held.extent, held.test) == (scene.extent, scene.test)
    with pytest.raises(InputError, match=rf"got every 9 of {len(scene.train)} training views"):
        scene.with_val(9)


def test_suffixes_duplicates_and_paths_that_stay_inside(tiny: Path) -> None:
    """A path may carry its suffix, wander within the folder, and be named twice: catches r_0.png.png."""
    edit(tiny, lambda c: c["frames"][0].update(file_path="val/../train/r_0.png"))
    edit(tiny, lambda c: c["frames"][1].update(file_path="./train/r_0"))
    first, second = scenes.load(tiny).train
    assert first.name == second.name == "train/r_0"
    assert torch.equal(first.image, second.image)


def test_extent_is_that_of_3dgs(tiny: Path) -> None:
    """Cameras at (0,0,4) and (4,0,0): half their distance x 1.1; catches a diagonal, and test cameras counted in."""
    assert scenes.load(tiny).extent == pytest.approx(1.1 * math.sqrt(8))


def test_extent_of_turned_cameras() -> None:
    """Against the centres the JSON states: catches translations, or a rotation the wrong way round, for centres."""
    frames = json.loads((folder() / "suzanne" / "transforms_train.json").read_text())["frames"]
    centers = np.array([frame["transform_matrix"] for frame in frames])[:, :3, 3]
    radius = np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()
    assert scenes.load(folder() / "suzanne").extent == pytest.approx(1.1 * radius, rel=1e-6)


def test_fingerprint_says_which_data(tiny: Path) -> None:
    """Catches a fingerprint that depends on where the data lies or on how it is loaded, or misses a file read."""
    before = scenes.load(tiny).fingerprint
    elsewhere = shutil.copytree(tiny, tiny.parent / "elsewhere" / "tiny")
    assert scenes.load(elsewhere, downscale=2, background=(1.0, 1.0, 1.0)).fingerprint == before
    for path in sorted(elsewhere.rglob("*.*")):
        content = path.read_bytes()
        if path.suffix == ".png":
            image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            image[0, 0, 0] ^= 1
            cv2.imwrite(str(path), image)
        else:
            path.write_bytes(content + b"\n")
        assert scenes.load(elsewhere).fingerprint != before, path
        path.write_bytes(content)
    assert scenes.load(elsewhere).fingerprint == before


def test_fingerprint_is_what_sha256sum_says(tiny: Path) -> None:
    """The documented recipe: sha256 of sha256sum's lines, sorted by name; catches a silent change of the definition."""
    names = sorted(path.relative_to(tiny).as_posix() for path in tiny.rglob("*.*"))
    lines = "".join(f"{hashlib.sha256((tiny / name).read_bytes()).hexdigest()}  {name}\n" for name in names)
    assert scenes.load(tiny).fingerprint == hashlib.sha256(lines.encode()).hexdigest()


def test_the_truth_about_effects_is_not_read(tmp_path: Path) -> None:
    """scene.json holds what the effect detection is to find out: catches a loader that opens it."""
    known = scenes.load(folder() / "moving-matte")
    blind = shutil.copytree(folder() / "moving-matte", tmp_path / "moving-matte")
    (blind / "scene.json").write_text("{")
    assert scenes.load(blind).fingerprint == known.fingerprint


def test_opencv_log_level_is_restored(tiny: Path) -> None:
    """Catches a loader that leaves the whole process's OpenCV silent, after success and after failure."""
    before = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_INFO)
    scenes.load(tiny)
    (tiny / "test" / "r_0.png").unlink()
    with pytest.raises(InputError):
        scenes.load(tiny)
    assert cv2.utils.logging.setLogLevel(before) == cv2.utils.logging.LOG_LEVEL_INFO


def test_real_trex(shared_data: Path) -> None:
    """D-NeRF's own files pass every check: catches a tolerance its single-precision matrices fail."""
    root = shared_data / "dnerf" / "trex"
    if not root.is_dir():
        pytest.skip(f"needs D-NeRF's trex at {root}")
    scene = scenes.load(root, downscale=8)
    assert (len(scene.train), len(scene.val), len(scene.test)) == (200, 20, 20)
    assert scene.train[0].image.shape == (100, 100, 3)
    assert scene.has_time
    centers = torch.stack([view.camera.center for view in scene.train])
    matrices = [
        frame["transform_matrix"] for frame in json.loads((root / "transforms_train.json").read_text())["frames"]
    ]
    torch.testing.assert_close(centers, torch.tensor(matrices)[:, :3, 3], atol=3e-5, rtol=0)


def test_real_lego(shared_data: Path) -> None:
    """The 100x100 lego: 50/11/20 and the world's origin in the middle of every picture."""
    root = shared_data / "dnerf_lego100" / "lego"
    if not root.is_dir():
        pytest.skip(f"needs D-NeRF's lego at 100x100 at {root}")
    scene = scenes.load(root)
    assert (len(scene.train), len(scene.val), len(scene.test)) == (50, 11, 20)
    for view in scene.train:
        assert project(view, [0, 0, 0])[:2] == pytest.approx((50, 50), abs=0.1)
