"""The Blender loader on data that is right: cameras, pixels, sizes, fingerprints, the real scenes."""

import hashlib
import json
import math
import shutil

import cv2
import numpy as np
import pytest
import torch
from tiny_scene import edit, write_images

from gsbench import scenes
from gsbench.errors import InputError
from gsbench.scenes import images
from gsbench.scenes.sample import folder


def project(view: scenes.View, point: list[float]) -> tuple[float, float, float]:
    camera = view.camera
    x, y, depth = camera.viewmat[:3, :3] @ torch.tensor(point, dtype=torch.float32) + camera.viewmat[:3, 3]
    u, v, _ = camera.K @ torch.stack([x / depth, y / depth, torch.tensor(1.0)])
    return float(u), float(v), float(depth)


@pytest.mark.parametrize(
    ("name", "counts"), [("moving-matte", (120, 15, 15)), ("pendulum", (132, 10, 20)), ("suzanne", (120, 15, 15))]
)
def test_embedded_scenes_are_complete(name, counts):
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


def test_axes(tiny):
    """Catches a flipped or swapped axis: right is +u, up is -v, ahead is +depth; sides swapped on another device."""
    scene = scenes.load(tiny)
    f = 4 / math.tan(0.4)
    front, side = (view.to("cpu") for view in scene.train)
    assert (front.camera.width, front.camera.height) == (8, 6)
    assert project(front, [0, 0, 0]) == pytest.approx((4, 3, 4), abs=1e-5)
    assert project(front, [1, 0, 0]) == pytest.approx((4 + f / 4, 3, 4), abs=1e-5)
    assert project(front, [0, 1, 0]) == pytest.approx((4, 3 - f / 4, 4), abs=1e-5)
    assert project(front, [0, 0, 1]) == pytest.approx((4, 3, 3), abs=1e-5)
    assert project(side, [0, 0, -1]) == pytest.approx((4 + f / 4, 3, 4), abs=1e-5)
    assert project(side, [1, 1, 0]) == pytest.approx((4, 3 - f / 3, 3), abs=1e-5)


@pytest.mark.parametrize("background", [(0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (0.25, 0.5, 0.7)])
@pytest.mark.parametrize("channels", [3, 4])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_a_large_scene_stays_in_8_bits_and_looks_the_same(background, channels, dtype, tiny, monkeypatch):
    """Catches 500 views of 800 x 800 that take 4 GB, and 8 bits whose images differ by as much as one bit."""
    random = np.random.default_rng(1)
    rgba = random.integers(0, np.iinfo(dtype).max + 1, (240, 320, channels)).astype(dtype)
    rgba[:20, ..., 3:], rgba[-20:, ..., 3:] = 0, np.iinfo(dtype).max
    write_images(tiny, rgba)
    floats = scenes.load(tiny, background=background)
    monkeypatch.setattr(images, "_MOST_FLOATS", 0)
    small, reduced = scenes.load(tiny, background=background), scenes.load(tiny, background=background, downscale=2)
    for plain, other in zip(floats.train + floats.val + floats.test, small.train + small.val + small.test, strict=True):
        assert plain.pixels.dtype == torch.float32
        assert other.pixels.element_size() == (1 if dtype == np.uint8 else 4)
        assert torch.equal(plain.image, other.to("cpu").image)
    assert floats.fingerprint == small.fingerprint
    assert reduced.train[0].pixels.dtype == torch.float32  # a quarter of the pixels: fewer bytes than 8 bits of all


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [3, 4])
@pytest.mark.parametrize("downscale", [1, 2, 3])
def test_area_filter_is_the_mean_of_composited_blocks(tiny, dtype, channels, downscale):
    """Against a float64 mean: catches 8-bit rounding on the way, RGB/BGR, another filter, bleeding of clear pixels."""
    limit = np.iinfo(dtype).max
    rgba = np.random.default_rng(1).integers(0, limit + 1, (6, 12, channels)).astype(dtype)
    rgba[:3, :, 3:] = 0  # a silhouette: clear pixels carry random colours
    write_images(tiny, rgba)
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
def test_pillows_filter_reduces_the_8_bit_composite(tiny, background, monkeypatch):
    """Catches a mean, a cubic that is not widened, a composite that is rounded up or reduced before it is made, and
    the filter left out where images are composited at each access."""
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
    monkeypatch.setattr(images, "_MOST_FLOATS", 0)
    assert torch.equal(scenes.load(tiny, resize="pillow", background=background).train[0].image, whole.image)


def test_static_sets_and_sets_without_val(tiny):
    """NeRF-synthetic has no time, and some copies no val: catches an invented time and a refused scene."""
    edit(tiny, lambda c: [frame.pop("time") for frame in c["frames"]], "train", "test")
    (tiny / "transforms_val.json").unlink()
    scene = scenes.load(tiny)
    assert scene.val == []
    assert not scene.has_time
    assert all(view.time is None for view in scene.train + scene.test)


def test_val_is_held_out_of_train_where_there_is_none(tiny):
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


def test_extent_is_that_of_3dgs():
    """Against the stated centres: catches a diagonal, test cameras counted in, and poses the wrong way round."""
    frames = json.loads((folder() / "suzanne" / "transforms_train.json").read_text())["frames"]
    centers = np.array([frame["transform_matrix"] for frame in frames])[:, :3, 3]
    radius = np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()
    assert scenes.load(folder() / "suzanne").extent == pytest.approx(1.1 * radius, rel=1e-6)


def test_fingerprint_is_what_sha256sum_says(tiny):
    """The documented recipe, sha256 of sha256sum's lines, sorted by name. Catches a fingerprint that depends on where
    the data lies or on how it is loaded, or misses a file; and scene.json opened, whose effects are to be detected."""
    names = sorted(path.relative_to(tiny).as_posix() for path in tiny.rglob("*.*"))
    elsewhere = shutil.copytree(tiny, tiny.parent / "elsewhere" / "tiny")
    (elsewhere / "scene.json").write_text("{")
    fingerprints = {scenes.load(tiny).fingerprint}
    for name in names:
        lines = "".join(f"{hashlib.sha256((elsewhere / name).read_bytes()).hexdigest()}  {name}\n" for name in names)
        fingerprint = scenes.load(elsewhere, downscale=2, background=(1.0, 1.0, 1.0)).fingerprint
        assert fingerprint == hashlib.sha256(lines.encode()).hexdigest()
        fingerprints.add(fingerprint)
        if name.endswith(".png"):
            image = cv2.imread(str(elsewhere / name), cv2.IMREAD_UNCHANGED)
            image[0, 0, 0] ^= 1
            cv2.imwrite(str(elsewhere / name), image)
        else:
            (elsewhere / name).write_text((elsewhere / name).read_text() + "\n")
    assert len(fingerprints) == len(names)


def test_opencv_log_level_is_restored(tiny):
    """Catches a loader that leaves the whole process's OpenCV silent, after success and after failure."""
    before = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_INFO)
    scenes.load(tiny)
    (tiny / "test" / "r_0.png").unlink()
    with pytest.raises(InputError):
        scenes.load(tiny)
    assert cv2.utils.logging.setLogLevel(before) == cv2.utils.logging.LOG_LEVEL_INFO


def test_real_lego(shared_data):
    """D-NeRF's own files: 50/11/20 views, the origin in the middle. Catches a tolerance that their matrices fail."""
    root = shared_data / "dnerf_lego100" / "lego"
    if not root.is_dir():
        pytest.skip(f"needs D-NeRF's lego at 100x100 at {root}")
    scene = scenes.load(root)
    assert (len(scene.train), len(scene.val), len(scene.test)) == (50, 11, 20)
    for view in scene.train:
        assert project(view, [0, 0, 0])[:2] == pytest.approx((50, 50), abs=0.1)
