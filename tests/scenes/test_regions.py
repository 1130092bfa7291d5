"""The alpha and the regions of views: kept from RGBA images, read from a folder of masks, refused where damaged."""

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from tiny_scene import COUNTS, check_message, write_image, write_images

from gsbench import scenes
from gsbench.errors import InputError
from gsbench.scenes import images
from gsbench.train.batches import reduced

NUMBERS = np.arange(48, dtype=np.uint8).reshape(6, 8)  # of the tiny scene's size


def write_masks(root: Path) -> None:
    """Give every image of the tiny scene a mask: NUMBERS, and the image's index more."""
    for split, count in COUNTS.items():
        for index in range(count):
            write_image(root / split / "masks" / f"r_{index}.png", NUMBERS + np.uint8(index))


@pytest.mark.parametrize("in_8_bits", [False, True])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_alpha_is_kept_as_stored(dtype, in_8_bits, tiny, monkeypatch):
    """Catches an alpha lost to the composite, taken from a colour, or rounded down from 16 bits."""
    limit = np.iinfo(dtype).max
    rgba = np.random.default_rng(1).integers(0, limit + 1, (6, 8, 4)).astype(dtype)
    write_images(tiny, rgba)
    if in_8_bits:
        monkeypatch.setattr(images, "_MOST_FLOATS", 0)
    for view in scenes.load(tiny).to("cpu").train:
        assert view.alpha.dtype == torch.uint8
        np.testing.assert_array_equal(view.alpha, np.rint(rgba[..., 3] * (255 / limit)))


def test_alpha_is_averaged_with_the_image(tiny):
    """Catches an alpha of the full size beside a reduced image, one that is cut out of it, and one of opaque images."""
    alpha = cv2.imread(str(tiny / "train/r_1.png"), cv2.IMREAD_UNCHANGED)[..., 3].astype(float)
    view = scenes.load(tiny, downscale=2).train[1]
    np.testing.assert_allclose(view.alpha, alpha.reshape(3, 2, 4, 2).mean(axis=(1, 3)), atol=0.51)
    write_images(tiny, np.zeros((6, 8, 3), np.uint8))
    scene = scenes.load(tiny)
    assert all(view.alpha is None for view in scene.train + scene.val + scene.test)


def test_regions_are_the_masks_beside_the_images(tiny):
    """Catches the mask of another view, changed numbers, another fingerprint, and images without masks refused."""
    before = scenes.load(tiny)
    assert all(view.regions is None for view in before.train + before.val + before.test)
    write_masks(tiny)
    scene = scenes.load(tiny).to("cpu")
    for views in (scene.train, scene.val, scene.test):
        for index, view in enumerate(views):
            assert view.regions.dtype == torch.uint8
            np.testing.assert_array_equal(view.regions, NUMBERS + index)
    assert scene.fingerprint == before.fingerprint
    shutil.rmtree(tiny / "test" / "masks")
    assert scenes.load(tiny).test[0].regions is None


@pytest.mark.parametrize("downscale", [2, 3])
def test_regions_are_not_averaged(tiny, downscale):
    """Catches the mean of two object numbers, which is a third object, and regions of another size than the image."""
    numbers = np.arange(72, dtype=np.uint8).reshape(6, 12)
    write_masks(tiny)
    for path in tiny.glob("*/r_*.png"):
        write_image(path, np.zeros((6, 12, 4), np.uint8))
        write_image(path.parent / "masks" / path.name, numbers)
    view = scenes.load(tiny, downscale=downscale).train[0]
    assert view.regions.shape == view.image.shape[:2]
    np.testing.assert_array_equal(view.regions, numbers[1::downscale, 1::downscale])


def test_a_coarse_view_drops_both(tiny):
    """Catches the full-size alpha and regions of a view whose image was reduced for an early step."""
    write_masks(tiny)
    coarse = reduced(scenes.load(tiny).train[0], 2)
    assert coarse.alpha is coarse.regions is None


DAMAGES: list[tuple[Callable[[Path], object], str]] = [
    (Path.unlink, "r_1.png"),
    (lambda path: write_image(path, NUMBERS[:, :7]), "expected 8x6 as the image of this mask, got 7x6"),
    (lambda path: write_image(path, np.zeros((6, 8, 3), np.uint8)), "expected 8-bit grey"),
    (lambda path: write_image(path, NUMBERS.astype(np.uint16)), "expected 8-bit grey"),
    (lambda path: path.write_bytes(path.read_bytes()[:-20]), "damaged PNG"),
    (lambda path: path.write_bytes(b"no PNG"), "expected a PNG"),
]


@pytest.mark.parametrize(("damage", "words"), DAMAGES)
def test_a_damaged_mask_is_refused(damage, words, tiny, tmp_path):
    """Catches a mask that is left out, of another size, of colours or cut off; and a link of the user refused."""
    write_masks(tiny)
    mask = tiny / "train" / "masks" / "r_1.png"
    mask.rename(tmp_path / "elsewhere.png")
    mask.symlink_to(tmp_path / "elsewhere.png")
    assert scenes.load(tiny).train[1].regions is not None
    damage(mask)
    with pytest.raises(InputError) as caught:
        scenes.load(tiny)
    check_message(caught.value, words, "the mask of train/r_1.png")
