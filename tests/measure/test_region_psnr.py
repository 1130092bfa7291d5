"""PSNR where a scene moves and where its objects are: which pixels, which views, and reasons where there are none."""

import math

import numpy as np
import pytest
import torch

from gsbench.measure.record import ViewScore
from gsbench.measure.regions import RegionScores, find_regions, moving, of_objects, region_psnr
from gsbench.scenes import Camera, View

HEIGHT, WIDTH = 270, 540  # a region is dilated by a pixel for each 270 rows, by two for each 540


def view(name: str, square: tuple[int, int] | None, *, turned: float = 0.0, alpha: bool = False) -> View:
    """A grey image with a bright square of 12 pixels, by its corner."""
    viewmat = torch.eye(4)
    viewmat[0, 3] = turned
    image = torch.full((HEIGHT, WIDTH, 3), 0.4)
    covered = torch.zeros(HEIGHT, WIDTH, dtype=torch.uint8)
    if square is not None:
        x, y = square
        image[y : y + 12, x : x + 12] = torch.tensor([0.4, 0.4, 0.9])
        covered[y : y + 12, x : x + 12] = 255
    return View(
        name, Camera(viewmat, torch.eye(3), WIDTH, HEIGHT), 0.0, image, composited_alpha=covered if alpha else None
    )


def test_what_moves_is_found_at_one_camera():
    """Catches a region of the median, a lost opening or dilation, one by the width, and blue that is ignored."""
    views = [view(str(i), (5 + 25 * i, 30)) for i in range(3)]
    measured = moving(views)
    assert measured.source == "images of one camera"
    for i in range(3):
        rows, columns = measured.masks[str(i)].nonzero()
        assert (columns.min(), columns.max()) == (3 + 25 * i, 18 + 25 * i)  # the 3 x 3 mean reaches a pixel out
        assert (rows.min(), rows.max()) == (28, 43)
    assert measured.share == pytest.approx(16 * 16 / (HEIGHT * WIDTH), rel=0.05)


def test_single_pixels_do_not_move():
    """Catches noise that counts as movement: differences of 16 and less, and a bright pixel alone."""
    views = [view(str(i), None) for i in range(3)]
    views[0].pixels[10:20, 10:20] += 15 / 255
    views[1].pixels[50, 50] = 1.0
    measured = moving(views)
    assert not measured.masks
    assert "64 pixels" in measured.missing


def test_views_of_other_cameras_are_not_compared():
    """Catches a median over views that differ because the camera moved, and two views that are no group."""
    views = [view(str(i), (5 + 25 * i, 30), turned=0.1 * i) for i in range(3)]
    assert "same camera" in moving(views).missing
    assert "same camera" in moving(views[:1] * 2).missing
    mixed = [*views, *(view(f"a{i}", (5 + 25 * i, 30), turned=0.2) for i in range(2))]
    assert set(moving(mixed).masks) == {"2", "a0", "a1"}


def test_objects_are_those_of_masks_or_of_alpha():
    """Catches alpha that is used beside masks, and its threshold on the wrong side."""
    views = [view("0", (10, 10), alpha=True)]
    assert of_objects(views).masks["0"].sum() == 144
    numbered = torch.zeros(HEIGHT, WIDTH, dtype=torch.uint8)
    numbered[:9] = 3
    masked = [
        View(v.name, v.camera, v.time, v.pixels, composited_alpha=v.composited_alpha, regions=numbered) for v in views
    ]
    assert of_objects(masked).source == "masks"
    assert of_objects(masked).masks["0"].sum() == 9 * WIDTH
    assert "masks" in of_objects([view("0", (10, 10))]).missing
    assert of_objects(views).digest != of_objects(masked).digest
    assert len(bytes.fromhex(of_objects(views).digest)) == 32  # SHA-256


def test_psnr_is_of_the_region_alone():
    """Catches pixels outside, and a mean over the image instead of the region."""
    truth = torch.zeros(HEIGHT, WIDTH, 3)
    render = torch.zeros(HEIGHT, WIDTH, 3)
    render[:10] = 0.1
    render[20:] = 1.0
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[:10] = True
    assert region_psnr(render, truth, mask) == pytest.approx(20.0, abs=1e-4)


def test_a_region_is_capped_and_rounded_as_the_image_is():
    """Catches an infinite mean, as one region is exact, and a region measured on another render than the image."""
    views = [view("0", (10, 10), alpha=True), view("1", (30, 30), alpha=True)]
    scores = RegionScores(views, quantised=False)
    assert list(scores.measured([("0", views[0].image, views[0].image), ("1", views[1].image + 0.1, views[1].image)]))
    assert scores.metrics()["psnr_object"] == pytest.approx(60.0, abs=1e-3)
    exact, other = scores.with_scores([ViewScore("0", 30.0), ViewScore("1", 31.0)])
    assert (exact.exact, other.exact) == (["0 (object)"], [])
    for quantised in (False, True):
        scores = RegionScores(views[:1], quantised=quantised)
        assert list(scores.measured([("0", views[0].image + 0.001, views[0].image)]))
        assert (scores.metrics()["psnr_object"] == pytest.approx(60.0, abs=1e-2)) != quantised


def test_scores_are_means_over_the_views_that_have_a_region():
    """Catches a view without a region that counts, a metric without a value or a reason, and another view's score."""
    views = [view("0", (10, 10), alpha=True), view("1", None, alpha=True)]
    scores = RegionScores(views, quantised=False)
    images = [(v.name, v.image + 0.1, v.image) for v in views]
    assert [name for name, _, _ in scores.measured(images)] == ["0", "1"]
    metrics = scores.metrics()
    assert metrics["psnr_object"] == pytest.approx(20.0, abs=1e-3)
    assert metrics["psnr_moving"] is None
    assert set(scores.missing()) == {"psnr_moving"}
    measured = scores.of_record()
    assert set(measured) == {"object"}
    assert (measured["object"].views, measured["object"].source) == (1, "alpha")
    assert math.isclose(measured["object"].share, 144 / (HEIGHT * WIDTH))
    assert set(find_regions(views)) == {"moving", "object"}
    region, other = scores.with_scores([ViewScore("0", 30.0), ViewScore("1", 31.0)])
    assert (region.name, region.psnr, region.psnr_moving) == ("0", 30.0, None)
    assert region.psnr_object == pytest.approx(20.0, abs=1e-3)
    assert other == ViewScore("1", 31.0)
