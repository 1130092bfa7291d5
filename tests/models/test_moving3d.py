"""dGS and FreeTimeGS: their equations by hand, what a gate makes of them, and when they are visible."""

import math

import pytest
import torch
from small import CAMERA, assert_culled_outside_its_intervals, moved, started
from torch import Tensor

from gsbench.errors import InputError
from gsbench.models import CameraTime, GaussianModel, build
from gsbench.models.moving import DirectModel, MovingGaussians3D, precision_factor

DIRECTION = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
QUERY = CameraTime(-DIRECTION, torch.tensor(0.7, dtype=torch.float64))  # seen from there, the origin lies in DIRECTION


def direct(**options: object) -> tuple[DirectModel, dict[str, Tensor]]:
    """One Gaussian of dGS at the origin, with numbers for which the equations were evaluated by hand."""
    model = build("dgs", **options)
    assert isinstance(model, DirectModel)
    view, time = math.log(0.4), math.log(math.sqrt(10))
    raw = {
        "means": torch.zeros(1, 3),
        "scales": torch.tensor([[0.01, 0.02, 0.03]]).log(),
        "quats": torch.tensor([[1.0, 0, 0, 0]]),
        "directions": torch.tensor([[0.0, 0, 2]]),
        "times": torch.zeros(1, 1),
        "precision": torch.tensor([[view, 0.1, view, 0, 0, view, time]]),
        "coupling": torch.full((1, 12), 0.3),
        "shares": torch.full((1, 2), -1.2),
    }
    return model, {name: value.double() for name, value in raw.items()}


def test_the_equations_of_dgs() -> None:
    """Catches L for its transpose, a half in the exponent, Lam of another column, a mean direction that is not unit."""
    model, raw = direct()
    shift, opacity_factor = model.change(raw, QUERY)
    torch.testing.assert_close(shift, torch.full((1, 3), 0.00279045, dtype=torch.float64), rtol=1e-5, atol=0)
    torch.testing.assert_close(opacity_factor, torch.tensor([0.850101], dtype=torch.float64), rtol=1e-6, atol=0)


def test_the_three_couplings() -> None:
    """Catches a choice that is ignored: by hand, with V_pq delta of every axis and no move at all."""
    moves = {name: direct(coupling=name)[0].change(direct()[1], QUERY)[0][0, 0] for name in ("interpolated", "none")}
    share, V_pq = 1 / (1 + math.exp(1.2)), 0.02 / math.sqrt(12)
    delta, through = 0.6 - 0.2 + 0.2, 0.096 + 0.024 - 0.032 + 2.0
    assert float(moves["interpolated"]) == pytest.approx(V_pq * ((1 - share) * delta + share * through))
    assert moves["none"] == 0
    with pytest.raises(InputError, match="coupling 'texts'"):
        build("dgs", coupling="texts")


def test_a_query_of_dgs_has_no_gradient() -> None:
    """Catches a gradient of the mean by way of the direction from the camera."""
    model, raw = direct()
    raw["means"].requires_grad_()
    shift, opacity_factor = model.change(raw, QUERY)
    assert not shift.requires_grad
    assert not opacity_factor.requires_grad


def test_precision_is_positive_and_couples_no_time() -> None:
    """Catches a transposed or shifted triangle: direction and time stay apart."""
    L = precision_factor(torch.arange(7.0)[None])[0]
    assert L.tolist()[1] == pytest.approx([1, math.exp(2), 0, 0])
    assert L.tolist()[2] == pytest.approx([3, 4, math.exp(5), 0])
    assert L.tolist()[3] == pytest.approx([0, 0, 0, math.exp(6)])


def test_the_equations_of_freetime() -> None:
    """Catches a velocity from t = 0, a duration without its square, a gate that moves with the camera."""
    model = build("freetime")
    assert isinstance(model, MovingGaussians3D)
    raw = {"times": torch.tensor([[0.2]]), "durations": torch.tensor([[0.5]]).log(),
           "velocities": torch.tensor([[1.0, 0, -2]])}  # fmt: skip
    shift, opacity_factor = model.change(raw, CameraTime(torch.zeros(3), torch.tensor(0.7)))
    torch.testing.assert_close(shift, torch.tensor([[0.5, 0, -1.0]]))
    torch.testing.assert_close(opacity_factor, torch.tensor([math.exp(-0.5)]))
    with pytest.raises(InputError, match="duration"):
        build("freetime", duration=0.0)


def lively(name: str, count: int = 100) -> GaussianModel:
    return moved(started(build(name), count))


@pytest.mark.parametrize("name", ["dgs", "freetime"])
def test_a_frozen_gaussian_is_the_mean_over_views(name: str) -> None:
    """Catches weights that are forgotten, and an opacity or a mean that is the one of a single view."""
    model = lively(name)
    assert isinstance(model, MovingGaussians3D)
    raw = {key: value.detach() for key, value in model.splats.items()}
    queries = [CameraTime.at(CAMERA, 0.2), CameraTime.at(-CAMERA, 0.7)]
    weights = torch.tensor([0.25, 0.75], dtype=torch.float64)[:, None].expand(2, len(model))
    static = raw | model.frozen(raw, queries, weights)["static"]
    slices = [model.slice(query) for query in queries]
    for key in ("means", "opacities"):
        expected = 0.25 * getattr(slices[0], key) + 0.75 * getattr(slices[1], key)
        found = static[key] if key == "means" else torch.sigmoid(static[key])
        torch.testing.assert_close(found, expected.clamp(1e-6) if key == "opacities" else expected)


@pytest.mark.parametrize("name", ["dgs", "freetime"])
def test_outside_its_interval_a_gaussian_is_culled(name: str) -> None:
    """Catches a lifetime in other units, by which rows would be sorted into an order that saves nothing."""
    assert_culled_outside_its_intervals(
        lively(name), torch.linspace(0, 1, 21, dtype=torch.float64), exact=name == "freetime"
    )
