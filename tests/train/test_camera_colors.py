"""Affine maps of the colours of training cameras: the sheet's numbers, what they learn, and that no result has them."""

from collections.abc import Sequence
from dataclasses import replace

import pytest
import torch
from interrupted import assert_resumes, assert_same_bits, without_times
from tiny_training import moving_square, train, trainer

from gsbench.scenes import Scene
from gsbench.train.hooks.camera_colors import CameraColors, in_colors_of
from gsbench.train.loop import Trainer

CAMERAS = 3
ON = ("train.camera_colors=true", "train.batch_size=3")
START = 10  # of 100 steps


def test_the_numbers_of_the_sheet():
    """Catches the matrix transposed, or without the identity (RIVALS.md, section 8)."""
    of_camera = torch.tensor([[0.02, 0, 0.01], [0, -0.03, 0], [0.01, 0, 0], [0.01, 0, -0.02]], dtype=torch.float64)
    image = torch.tensor([0.2, 0.5, 0.7], dtype=torch.float64).expand(1, 5, 7, 3)
    shown = in_colors_of(image, of_camera)
    torch.testing.assert_close(shown[0, 4, 6].tolist(), [0.221, 0.485, 0.682], atol=1e-12, rtol=0)
    assert shown.shape == image.shape


def test_the_gradient():
    """Catches a gradient that lacks a row of pixels, a channel, or the identity."""
    generator = torch.Generator().manual_seed(0)
    image, of_camera = (
        torch.rand(shape, generator=generator, dtype=torch.float64, requires_grad=True)
        for shape in ((1, 3, 4, 3), (4, 3))
    )
    assert torch.autograd.gradcheck(in_colors_of, (image, of_camera))


def array(offsets: Sequence[float]) -> Scene:
    """The moving square by cameras that see four times each, whose images are brighter by an offset."""
    square = moving_square()
    views = []
    for i, view in enumerate(square.train):
        pixels = (view.pixels * 0.8 + 0.1 + offsets[i % CAMERAS]).clamp(0, 1)
        views.append(replace(view, camera=square.train[i % CAMERAS].camera, pixels=pixels))
    return replace(square, train=views, test=views[:2])


def of_array(offsets: Sequence[float], *overrides: str) -> Trainer:
    return trainer("4dgs", *ON, *overrides, scene=array(offsets))


def test_cameras_learn_in_what_they_differ():
    """Catches a map of another camera, one of each view, one that is never updated, and a start before its step."""
    training = train(of_array((0.1, 0.0, -0.1)), until=START - 1)
    hook = training.hook(CameraColors)
    assert hook.maps.shape == (CAMERAS, 4, 3)
    assert not hook.maps.any()
    train(training)
    offset = hook.maps[:, 3].mean(1)
    assert offset[0] > offset[1] > offset[2]
    assert hook.results()["camera_colors"] == {"cameras": 3, "largest_change": float(hook.maps.data.abs().max())}


def test_images_are_measured_without():
    """Catches a measured image in the colours of a training camera."""
    training = train(of_array((0.1, 0.0, -0.1)), until=20)
    before = training.render(training.views[0])
    training.hook(CameraColors).maps.data += 0.5
    assert torch.equal(training.render(training.views[0]), before)


@pytest.mark.usefixtures("threads")
def test_a_training_resumes_with_equal_bits_for_any_threads():
    """Catches maps or moments that a checkpoint lacks, and sums whose order depends on the threads."""
    torch.set_num_threads(1)
    whole, _ = assert_resumes(lambda: of_array((0.1, 0.0, -0.1)), 50)
    torch.set_num_threads(3)
    ends = [without_times(each.state_dict()) for each in (whole, train(of_array((0.1, 0.0, -0.1))))]
    assert_same_bits(*ends)


@pytest.mark.usefixtures("threads")
def test_gradients_of_large_images_do_not_depend_on_threads():
    """Catches a sum over all pixels at once, which torch splits among threads."""
    image = torch.rand(1, 700, 900, 3, generator=torch.Generator().manual_seed(0))
    gradients = []
    for count in (1, 2, 3):
        torch.set_num_threads(count)
        of_camera = torch.zeros(4, 3, requires_grad=True)
        in_colors_of(image, of_camera).square().sum().backward()
        gradients.append(of_camera.grad)
    assert torch.equal(gradients[0], gradients[1])
    assert torch.equal(gradients[0], gradients[2])
