"""Training views: which one is nearest to a camera, how a model is compared with it, and images made smaller."""

from dataclasses import replace

import pytest
import torch

from gsbench.gates.gate import most_cost
from gsbench.measure.images import error_image, to_bytes
from gsbench.measure.quality import psnr, quantise
from gsbench.models import cameras
from gsbench.models.render import render
from gsbench.run.load import load_run, scene_of
from gsbench.scenes import Camera, Scene, View
from gsbench.view.frame import FrameRenderer, FrameRequest
from gsbench.view.training_views import MOST_WIDTH, compare, nearest_view

EXTENT = 4.0


def camera(x: float, *, towards: float = 0.0) -> Camera:
    """At x on a line, looking along y and as far aside."""
    eye = torch.tensor([x, -5.0, 0.0])
    viewmat = cameras.look_at(eye, eye + torch.tensor([towards, 1.0, 0.0]), torch.tensor(cameras.UP))
    return Camera(viewmat, cameras.intrinsics(8, 8), 8, 8)


def scene(*cameras_and_times: tuple[Camera, float | None]) -> Scene:
    """A scene with these training views, called by their number."""
    views = [View(str(i), placed, time, torch.zeros(8, 8, 3)) for i, (placed, time) in enumerate(cameras_and_times)]
    return Scene("line", views, [], [], (0.0, 0.0, 0.0), EXTENT, None, "0")


def test_the_nearest_view_stands_and_looks_as_the_camera_does():
    """Catches a choice by place alone or by direction alone, a rotation that is inverted, and wrong distances."""
    views = scene((camera(0.0), 0.0), (camera(1.0), 0.0), (camera(0.0, towards=0.5), 0.0))
    assert nearest_view(views, camera(0.2), 0.0).view.name == "0"
    assert nearest_view(views, camera(0.9), 0.0).view.name == "1"
    nearest = nearest_view(views, camera(0.5, towards=0.6), 0.0)
    assert nearest.view.name == "2"
    assert nearest.distance == pytest.approx(0.5)
    assert nearest.degrees == pytest.approx(30.96 - 26.57, abs=0.02)


def test_the_nearest_view_in_a_rig_and_in_extents():
    """Catches metres added to radians, a rig whose first frame is always shown, and a time that outweighs the place."""
    views = scene((camera(1.0), 0.0), (camera(0.4, towards=0.3), 0.0))
    assert nearest_view(views, camera(0.4), 0.0).view.name == "0"  # 0.6 of an extent of 4 is less than 17 degrees
    views = scene(*[(camera(x), time) for time in (0.0, 0.5, 1.0) for x in (0.0, 1.0)])
    assert [nearest_view(views, camera(0.1), time).view.name for time in (0.0, 0.4, 0.9)] == ["0", "2", "4"]
    assert nearest_view(views, camera(0.9), 0.4).view.name == "3"
    assert nearest_view(scene((camera(0.0), None), (camera(1.0), None)), camera(0.9), None).view.name == "1"


def test_a_model_is_compared_as_it_is_measured(folder):
    """Catches another PSNR than the run's own measure, swapped images, and a protocol's rounding that is left out."""
    run = load_run(folder)
    view = scene_of(run).train[1]
    renderer = FrameRenderer(run, "7dgs", most_cost(run.model))
    image = render(run.model, view.camera, view.time, torch.tensor(run.scene.background))
    compared = compare(renderer, view, FrameRequest(view.time))
    assert compared.psnr == psnr(image, view.image)
    assert (compared.truth == to_bytes(view.image.cpu().numpy())).all()
    assert (compared.render == to_bytes(image.cpu().numpy())).all()
    assert (compared.error == error_image(image.numpy(), view.image.numpy())).all()
    run.config.protocol.quantise = True
    assert compare(renderer, view, FrameRequest(view.time)).psnr == psnr(quantise(image), view.image) != compared.psnr
    assert compare(renderer, view, FrameRequest(view.time, agr=False)).psnr != compared.psnr
    exact = replace(view, pixels=quantise(image))
    assert compare(renderer, exact, FrameRequest(view.time)).psnr == 100.0, "a mean over views would be infinite"


def test_large_images_are_made_smaller_after_they_are_measured(folder):
    """Catches megabytes for each movement of the camera, and a PSNR of images that were made smaller."""
    run = load_run(folder)
    small = scene_of(run).train[0]
    wide = Camera(small.camera.viewmat, cameras.intrinsics(960, 32), 960, 32)
    truth = torch.rand(32, 960, 3, generator=torch.Generator().manual_seed(0))
    view = replace(small, camera=wide, pixels=truth)
    compared = compare(FrameRenderer(run, "7dgs", most_cost(run.model)), view, FrameRequest(view.time))
    assert {image.shape for image in compared[1:4]} == {(16, MOST_WIDTH, 3)}
    assert compared.psnr == psnr(render(run.model, wide, view.time, torch.tensor(run.scene.background)), truth)
