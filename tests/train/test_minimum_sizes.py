"""The minimum scale of a Gaussian, which no camera resolves, and its minimum lifetime, half the gap between times."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tiny_training import moving_square, trainer
from torch import Tensor

from gsbench.models import CameraTime, GaussianModel, build
from gsbench.models.render import render
from gsbench.scenes import Camera
from gsbench.scenes.points import random_points
from gsbench.train.hooks.minimum_sizes import LEAST_PIXELS, MinimumLifetime, MinimumScale

OPTIONS = {"3dgs": {}, "4dgs": {}, "6dgs": {"lambda_d": 0.35}, "7dgs": {"lambda_d": 0.05, "lambda_t": 0.05}}


def camera(distance: float, focal: tuple[float, float] = (50.0, 50.0)) -> Camera:
    viewmat = torch.eye(4)
    viewmat[2, 3] = distance
    return Camera(viewmat, torch.tensor([[focal[0], 0, 24], [0, focal[1], 24], [0, 0, 1]]), 48, 48)


def training_of(model: GaussianModel, **of_views: list[Any]) -> Any:
    """What the hooks read of a training: its model, and views that have the attributes given."""
    views = [
        SimpleNamespace(**dict(zip(of_views, values, strict=True))) for values in zip(*of_views.values(), strict=True)
    ]
    return SimpleNamespace(model=model, scene=SimpleNamespace(train=views))


def flat(name: str) -> tuple[GaussianModel, Tensor, list[int]]:
    """A model whose Gaussians are flatter than 1e6 : 1 along one axis, its sizes, and their columns in space."""
    model, random = build(name, **OPTIONS[name]), torch.Generator().manual_seed(0)
    model.initialise(random_points(200, 1.0, random), 4.0, random)
    sizes, space = ("log_diagonal", model.rows["p"]) if name in ("6dgs", "7dgs") else ("scales", [0, 1, 2])
    model.splats[sizes].data[:, space[2]] = math.log(1e-7)
    return model, model.splats[sizes].data, [*space]


@pytest.mark.parametrize(
    ("cameras", "pixel"),
    [
        ([camera(4.0), camera(2.0), camera(2.5, focal=(100.0, 100.0))], 3.5 / 100),
        ([camera(2.0, focal=(80.0, 50.0))], 3.0 / 80),
        ([camera(2.0, focal=(50.0, 80.0))], 3.0 / 80),
    ],
)
def test_the_floor_is_a_part_of_a_pixel_where_it_is_finest(cameras, pixel):
    """Catches the farthest camera, a mean, one on the other side, and a focal length left out, or the smaller one."""
    model = flat("3dgs")[0]
    model.splats["means"].data[:] = torch.tensor([0.0, 0.0, 1.0])  # behind what the cameras are `distance` away from
    least = MinimumScale(training_of(model, camera=cameras)).least
    torch.testing.assert_close(least, torch.full((200,), LEAST_PIXELS * pixel))


@pytest.mark.parametrize("name", OPTIONS)
def test_no_camera_sees_the_floor_and_only_sizes_in_space_are_held(name):
    """Catches a bound that touches the image, one on another axis, and one that is not held, that lengthens what is
    short in time, or that widens what is narrow in direction."""
    (model, sizes, space), eye = flat(name), camera(4.0)
    before, others = render(model, eye, 0.5, torch.zeros(3)), sizes.clone()
    hook = MinimumScale(training_of(model, camera=[eye]))
    with torch.no_grad():
        hook.after_update(0)
    after = render(model, eye, 0.5, torch.zeros(3))
    assert 0 < (after - before).abs().max() < 1 / 255
    assert torch.equal(sizes != others, torch.arange(sizes.shape[1]).expand_as(sizes) == space[2])
    factors = model.slice(CameraTime.at(eye.center, 0.5)).factors
    assert (torch.linalg.svdvals(factors)[:, 2] >= 0.99 * hook.least).all()
    sizes.fill_(math.log(1e-7))
    with torch.no_grad():
        hook.after_update(0)
    for column in range(sizes.shape[1]):
        expected = hook.least if column in space else torch.full((200,), 1e-7)
        torch.testing.assert_close(sizes[:, column].exp(), expected, rtol=1e-4, atol=0)


@pytest.mark.parametrize(
    ("times", "least"),
    [
        ((0.0, 0.1, 0.2, 0.0, 0.1, 0.2), 0.05),  # two cameras that see the same times
        ((0.7, 0.0, 0.1, 0.2), 0.05),  # a pause between the recordings
        ((0.5, 0.5), None),
        ((None, None), None),
    ],
)
def test_it_is_half_the_gap_between_the_times_of_training(times, least):
    """Catches the gap between views of the same time, the mean or longest gap, and a static scene or model with one."""
    assert MinimumLifetime(training_of(build("4dgs"), time=[*times])).least == (least and pytest.approx(least))
    for name in ("3dgs", "dbs_static", "ubs_static"):
        assert MinimumLifetime(training_of(build(name), time=[*times])).least is None


def test_every_step_of_a_training_holds_them():
    """Catches a training that holds no minimum, a gap from val or test, and the scale of Gaussians before a move."""
    square = moving_square()
    scene = replace(square, train=[replace(v, time=t) for v, t in zip(square.train, (0.0, 1.0) * 50, strict=False)])
    fitted = trainer("freetime", "effects.gate=off", "train.densify.every=1", scene=scene)
    splats, hook = fitted.model.splats, fitted.hook(MinimumScale)
    for fitted.step in (0, 60):
        splats["durations"].data.fill_(-9.0)
        splats["scales"].data.fill_(-20.0)
        least = hook.least
        fitted.train_step()
        assert splats["durations"].detach().exp().min() == pytest.approx(0.5)
        assert len(hook.least) == len(fitted.model)
        if fitted.step == 0:
            torch.testing.assert_close(splats["scales"].detach()[:, 0], least.log(), rtol=1e-2, atol=0)
    before = hook.least
    fitted.rows.select(torch.tensor([5, 3]))
    assert torch.equal(hook.least, before[[5, 3]])
