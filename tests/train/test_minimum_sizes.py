"""The minimum scale of a Gaussian, which no camera resolves, and its minimum lifetime, half the gap between times."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tiny_training import moving_square, trainer

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


def training_of(model: GaussianModel, views: list[Any]) -> Any:
    return SimpleNamespace(model=model, scene=SimpleNamespace(train=views))


def scale_of(model: GaussianModel, cameras: list[Camera]) -> MinimumScale:
    return MinimumScale(training_of(model, [SimpleNamespace(camera=camera) for camera in cameras]))


def flat(name: str) -> GaussianModel:
    """A model whose Gaussians are flatter than 1e6 : 1 along one axis."""
    model = build(name, **OPTIONS[name])
    generator = torch.Generator().manual_seed(0)
    model.initialise(random_points(200, 1.0, generator), 4.0, generator)
    column = model.rows["p"][2] if name in ("6dgs", "7dgs") else 2
    model.splats["log_diagonal" if name in ("6dgs", "7dgs") else "scales"].data[:, column] = math.log(1e-7)
    return model


@pytest.mark.parametrize(
    ("cameras", "pixel"),
    [
        ([camera(4.0), camera(2.0), camera(2.5, focal=(100.0, 100.0))], 2.5 / 100),
        ([camera(2.0, focal=(80.0, 50.0))], 2.0 / 80),
        ([camera(2.0, focal=(50.0, 80.0))], 2.0 / 80),
    ],
)
def test_the_floor_is_a_part_of_a_pixel_where_it_is_finest(cameras: list[Camera], pixel: float) -> None:
    """Catches the farthest camera, a mean over cameras, and a focal length that is left out, or the smaller of two."""
    model = flat("3dgs")
    model.splats["means"].data.zero_()
    torch.testing.assert_close(scale_of(model, cameras).least, torch.full((200,), LEAST_PIXELS * pixel))


@pytest.mark.parametrize("name", OPTIONS)
def test_no_camera_sees_the_floor(name: str) -> None:
    """Catches a bound that touches the image, one on another axis or on time, and one that is not held."""
    model, eye = flat(name), camera(4.0)
    background = torch.zeros(3)
    before = render(model, eye, 0.5, background)
    others = {n: p.detach().clone() for n, p in model.splats.items() if n not in ("scales", "log_diagonal")}
    minimum_scale = scale_of(model, [eye])
    with torch.no_grad():
        minimum_scale.after_update(0)
    after = render(model, eye, 0.5, background)
    assert 0 < (after - before).abs().max() < 1 / 255
    factors = model.slice(CameraTime.at(eye.center, 0.5)).factors
    assert (torch.linalg.svdvals(factors)[:, 2] >= 0.99 * minimum_scale.least).all()
    assert all(torch.equal(model.splats[n], p) for n, p in others.items())


@pytest.mark.parametrize("name", OPTIONS)
def test_only_sizes_in_space_are_held(name: str) -> None:
    """Catches a minimum scale that lengthens what is short in time, or widens what is narrow in direction."""
    model = flat(name)
    space = model.rows["p"] if name in ("6dgs", "7dgs") else [0, 1, 2]
    sizes = model.splats["log_diagonal" if name in ("6dgs", "7dgs") else "scales"].data
    sizes.fill_(math.log(1e-7))
    minimum_scale = scale_of(model, [camera(4.0)])
    with torch.no_grad():
        minimum_scale.after_update(0)
    for column in range(sizes.shape[1]):
        expected = minimum_scale.least if column in space else torch.full((200,), 1e-7)
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
def test_it_is_half_the_gap_between_the_times_of_training(times: tuple[Any, ...], least: float | None) -> None:
    """Catches the gap between views of the same time, the mean or longest gap, and a static scene or model with one."""
    views = [SimpleNamespace(time=time) for time in times]
    assert MinimumLifetime(training_of(build("4dgs"), views)).least == (least and pytest.approx(least))
    for name in ("3dgs", "dbs_static", "ubs_static"):
        assert MinimumLifetime(training_of(build(name), views)).least is None


def test_every_step_of_a_training_holds_it() -> None:
    """Catches a training that never calls it, or computes the gap from views of val or test."""
    square = moving_square()
    scene = replace(square, train=[replace(v, time=t) for v, t in zip(square.train, (0.0, 1.0) * 50, strict=False)])
    fitted = trainer("freetime", "effects.gate=off", scene=scene)
    fitted.model.splats["durations"].data.fill_(-9.0)
    fitted.train_step()
    assert fitted.model.splats["durations"].detach().exp().min() == pytest.approx(0.5)
