"""Spacetime Gaussians: their equations by a vector of an independent numpy program, their gradients and new times."""

import math
from typing import Any

import pytest
import torch
from small import CAMERA, covariances, fresh, lively, raw, seeded
from tiny_training import trainer
from torch import Tensor

from gsbench.models import CameraTime
from gsbench.models.factors import rotation

QUERY = CameraTime.at(CAMERA, 0.62)
DIGITS = {"rtol": 0, "atol": 5.001e-9}  # of the vector, which has eight digits


def doubles(*numbers: float) -> Tensor:
    return torch.tensor([numbers], dtype=torch.float64)


def gaussian(**raw: Tensor) -> Any:
    """The Gaussian of the vector; keyword arguments replace its raw parameters."""
    model = lively("stg", 4)
    model.select(torch.arange(1))
    parameters = {
        "means": doubles(0.3, -0.7, 1.1),
        "times": doubles(0.4),
        "durations": doubles(-1.0),
        "opacities": doubles(0.5)[0],
        "path": doubles(0.2, -0.1, 0.05, 0.4, 0.3, -0.2, -0.6, 0.1, 0.8),
        "quats": doubles(1, 0.1, 0, -0.2),
        "turns": doubles(0.3, -0.4, 0.5, 0.1),
    } | raw
    for name, value in parameters.items():
        model.splats[name].data = value
    return model


def test_the_vector() -> None:
    """Catches a half in the exponent, coefficients by axis or in reversed order, and a turn before the mean time."""
    model = gaussian()
    sliced = model.slice(QUERY)
    torch.testing.assert_close(sliced.opacities, doubles(0.43530545)[0], **DIGITS)
    torch.testing.assert_close(sliced.means, doubles(0.35697120, -0.70641520, 1.10983840), **DIGITS)
    R = rotation(doubles(0.98121447, 0.01104557, 0.10125102, -0.16384257))
    S = model.splats["scales"].detach().exp()
    torch.testing.assert_close(covariances(sliced), R * S.square()[:, None] @ R.mT, rtol=0, atol=2e-8)


def test_a_mean_time_learns_from_the_opacity_alone() -> None:
    """Catches a gradient of mu through path or turn, which the authors' code has not, and a lost one of the opacity."""
    model = gaussian()
    sliced = model.slice(QUERY)
    assert torch.autograd.grad(
        sliced.means.sum() + sliced.factors.sum(), model.splats["times"], retain_graph=True, allow_unused=True
    ) == (None,)
    (gradient,) = torch.autograd.grad(sliced.opacities.sum(), model.splats["times"])
    before, after = (gaussian(times=doubles(0.4 + step)).slice(QUERY).opacities for step in (-1e-6, 1e-6))
    torch.testing.assert_close(gradient[0], (after - before).detach() / 2e-6, rtol=1e-8, atol=0)


def test_the_start() -> None:
    """Catches times outside [0, 1], a duration that is taken for a logarithm, and Gaussians that move or turn."""
    model = fresh("stg", 4000, duration=math.exp(-2))
    values = raw(model)
    assert 0 <= values["times"].min() < 0.01
    assert 0.99 < values["times"].max() <= 1
    torch.testing.assert_close(values["durations"], torch.full((4000, 1), -2.0))
    assert not values["path"].any()
    assert not values["turns"].any()


def test_a_frozen_gaussian_has_the_mean_quaternion() -> None:
    """Catches a frozen Gaussian that keeps the quaternion of its mean time."""
    model, queries = gaussian(), [CameraTime.at(CAMERA, time) for time in (0.2, 0.7)]
    weights = torch.tensor([[0.25], [0.75]])
    frozen = model.frozen(raw(model), queries, weights)["static"]
    torch.testing.assert_close(frozen["quats"], doubles(1, 0.1, 0, -0.2) + (0.575 - 0.4) * doubles(0.3, -0.4, 0.5, 0.1))


@pytest.mark.parametrize("kind", ["clone", "split"])
def test_clones_and_children_have_new_times(kind: str) -> None:
    """Catches a copy with its parent's time, an original that loses its time, and draws from elsewhere."""
    fitted = trainer("stg", f"train.densify.clone_below={1e3 if kind == 'clone' else 1e-9}")
    rule, model = fitted.density.rule, fitted.model
    before = raw(model)
    rule.gradient.fill_(1.0)
    rule.times_visible.fill_(1.0)
    rule.densify(seeded(0), False, 2 * len(model))
    after, N = raw(model), len(before["times"])
    copies = after["times"][N if kind == "clone" else 0 :]
    assert len(after["times"]) == 2 * N
    assert len({*copies.flatten().tolist()} - {*before["times"].flatten().tolist()}) == len(copies)
    assert 0 <= copies.min() < 0.2
    assert 0.8 < copies.max() <= 1
    if kind == "clone":
        assert all(torch.equal(after[name][:N], x) for name, x in before.items())
        assert all(torch.equal(after[name][N:], x) for name, x in before.items() if name != "times")
