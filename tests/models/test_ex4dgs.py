"""Ex4DGS: its equations by vectors of an independent numpy program, its penalty, and how Gaussians become dynamic."""

import math
from typing import Any

import pytest
import torch
from small import CAMERA, DIGITS, active, covariances, fresh, lively, raw, row, with_effect_sets
from tiny_training import trainer
from torch import Tensor

from gsbench.kernels.headers import ALPHA_MIN
from gsbench.models import CameraTime
from gsbench.models.ex4dgs import is_dynamic, slerp
from gsbench.models.factors import rotation

KEYS = [0.0, 0, 0, 0.1, 0.2, 0, 0.3, 0.1, 0.4, 0.2, -0.1, 0.5, 0.6, 0, 0.3]
QUATS = [1.0, 0, 0, 0, 1, 0.1, 0, 0, 0.6, 0, 0.8, 0.1]


def gaussian(*, tau: float = 2.9, rise: str = "text", **raw: Tensor) -> Any:
    """The slice of the Gaussian of the vectors, with 2 intervals; keyword arguments replace its raw parameters."""
    model = lively("ex4dgs", 4, intervals=2, rise=rise)
    model.select(torch.arange(1))
    parameters = {
        "means": row(0.3, -0.7, 1.1),
        "key_means": row(*KEYS),
        "quats": row(0, 0, 0, 0),
        "key_quats": row(*QUATS),
        "velocities": row(0.3, 0, -0.6),
        "windows": row(1.4, 2.6),
        "fades": row(-0.5, 0.1),
    } | raw
    for name, value in parameters.items():
        model.splats[name].data = value
    return model.slice(CameraTime.at(CAMERA, (tau - 1) / 2)), model


def test_positions_and_rotations_of_a_dynamic_gaussian():
    """Catches other keyframes, tangents of another interval, and a path that is not relative to the mean."""
    sliced, model = gaussian()
    expected = row(0.3, -0.7, 1.1) + row(0.19110000, -0.09170000, 0.50350000)
    torch.testing.assert_close(sliced.means, expected, **DIGITS)
    R = rotation(row(0.66871603, 0.01154505, 0.73768742, 0.09221093))
    S = model.splats["scales"].detach().exp()
    torch.testing.assert_close(covariances(sliced), R * S.square()[:, None] @ R.mT, rtol=0, atol=4e-8)


def test_slerp():
    """Catches an interpolation that is not normalised, and one that takes the shorter way, as the authors' does not."""
    first, last = (torch.nn.functional.normalize(row(*q)) for q in ((1, 0.1, 0, 0), (0.6, 0, 0.8, 0.1)))
    for sign, expected in (
        (1, (0.66871603, 0.01154505, 0.73768742, 0.09221093)),
        (-1, (-0.40828255, 0.02707733, -0.90540785, -0.11317598)),
    ):
        torch.testing.assert_close(slerp(first, sign * last, row(0.9)), row(*expected), **DIGITS)


@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize(
    ("rise", "tau", "factor"),
    [
        ("code", 1.0, 0.00859795),
        ("text", 1.0, 0.74284755),
        ("code", 2.0, 1.0),
        ("text", 2.0, 1.0),
        ("code", 3.5, 0.58660245),
        ("text", 3.5, 0.58660245),
    ],
)
def test_opacities_fade_outside_of_the_window(rise, tau, factor, backwards):
    """Catches a half in the exponent, a fade of the other side, one without its least value, and the distance of the
    text in the place of that of the code; windows may be stored in either order."""
    windows = row(2.6, 1.4) if backwards else row(1.4, 2.6)
    _, model = gaussian(rise=rise, windows=windows)
    values = {name: x.detach() for name, x in model.splats.items()}
    visibility = model.visibility(values, torch.tensor(tau, dtype=torch.float64))
    torch.testing.assert_close(visibility, row(factor)[0], **DIGITS)


def test_a_static_gaussian_has_a_velocity_alone():
    """Catches a static Gaussian that follows keyframes, turns or fades, and a velocity of another unit or start."""
    static = {"windows": row(-1e6, 1e6), "quats": row(1, 0, 0, 0)}
    sliced, model = gaussian(tau=1.2, **static)  # frame 30 of 300
    torch.testing.assert_close(sliced.means, row(0.33, -0.7, 1.04), **DIGITS)
    torch.testing.assert_close(sliced.opacities, torch.sigmoid(model.splats["opacities"]))
    torch.testing.assert_close(covariances(sliced)[0], model.splats["scales"].detach()[0].exp().square().diag())


@pytest.mark.parametrize("static", [False, True])
@pytest.mark.parametrize("rise", ["text", "code"])
def test_both_kinds_have_the_gradients_of_their_values(rise, static):
    """Catches a wrong or lost derivative, as of an arc cosine, and parameters of one kind that learn by the other."""
    windows = {"windows": row(-1e6, 1e6)} if static else {}
    _, model = gaussian(rise=rise, quats=row(0.5, -0.2, 0.1, 0.3), **windows)
    names = [name for name in model.splats if name not in ("sh0", "shN")]
    values = [model.splats[name].detach().clone().requires_grad_() for name in names]
    other = raw(model)
    del model.splats

    def sliced(*values: Tensor) -> tuple[Tensor, ...]:
        model.splats = other | dict(zip(names, values, strict=True))
        slices = [model.slice(CameraTime.at(CAMERA, time)) for time in (0.1, 0.85)]  # before and after the window
        return tuple(x for s in slices for x in (s.means, s.factors @ s.factors.mT, s.opacities))

    assert torch.autograd.gradcheck(sliced, values, atol=1e-6)
    gradients = torch.autograd.grad(sum(x.square().sum() for x in sliced(*values)), values)
    learns = {name for name, x in zip(names, gradients, strict=True) if x.any()}
    of_kind = {"velocities"} if static else {"key_means", "key_quats", "windows", "fades"}
    assert learns == {"means", "quats", "scales", "opacities"} | of_kind


def test_the_penalty():
    """Catches a penalty of the other kind's parameters, in world units, or of neighbouring keyframes as in the text;
    its gradient, also at rest, and the mean over Gaussians that a gate left."""
    _, model = gaussian()
    model.splats["velocities"].data.fill_(9)
    keys = row(*KEYS).view(5, 3)
    expected = 0.5 * (keys[0] - keys).abs().mean() / 2.0  # the extent
    torch.testing.assert_close(model.penalty(), expected)
    _, model = gaussian(windows=row(-1e6, 1e6), velocities=row(0.02, 0, -0.03))
    speed = math.hypot(0.02, 0.03) / 2.0
    assert model.penalty().item() == pytest.approx(0.5 * math.log(speed + 1e-3))
    model.penalty().backward()
    gradient = 0.5 / (speed + 1e-3) * row(0.02, 0, -0.03) / math.hypot(0.02, 0.03) / 2.0
    torch.testing.assert_close(model.splats["velocities"].grad, gradient)
    assert not model.splats["key_means"].grad.any()
    model = fresh("ex4dgs")
    model.penalty().backward()
    assert not model.splats["velocities"].grad.any()
    first = active("ex4dgs")
    first.select(torch.arange(14))
    torch.testing.assert_close(with_effect_sets(active("ex4dgs"), 0, 14).penalty(), first.penalty())


def test_what_moves_most_becomes_dynamic():
    """Catches far or unseen Gaussians that come first, a share of all, a jump, and one that becomes dynamic twice."""
    model = fresh("ex4dgs", 12, intervals=4, dynamic_share=0.25).double()
    with torch.no_grad():
        model.splats["means"][:] = torch.arange(1.0, 13)[:, None] * torch.tensor([0.0, 0, 1])
        model.splats["velocities"][:, 0] = 1e-3
        model.splats["velocities"][[0, 8, 9, 11], 0] = row(0.1, 0.7, 0.8, 9.0)[0]
    centers = torch.zeros(2, 3, dtype=torch.float64)
    centers[1, 2] = 100.0  # from which all are as far away
    drawn = torch.tensor([True] * 11 + [False]).repeat(2, 1)
    before = [model.slice(CameraTime.at(CAMERA, time)) for time in (0.3, 0.5, 0.6)]
    for rows in ({0, 8}, {0, 1, 8, 9}):  # 2 of 11, then 2 of 9
        model.before_density(centers, drawn)
        assert {*is_dynamic(raw(model))[:, 0].nonzero()[:, 0].tolist()} == rows
        assert not model.splats["velocities"][sorted(rows)].any()
        for time, expected in zip((0.3, 0.5, 0.6), before, strict=True):
            sliced = model.slice(CameraTime.at(CAMERA, time))
            torch.testing.assert_close(sliced.means, expected.means)
            torch.testing.assert_close(sliced.opacities, expected.opacities)
    assert (model.slice(CameraTime.at(CAMERA, 0.0)).opacities < before[0].opacities).sum() == len(rows)


def test_children_of_dynamic_gaussians_lie_further_apart():
    """Catches children that leave the path, and another distance than two standard deviations."""
    model = active("ex4dgs")
    values = raw(model)
    kinds = is_dynamic(values)
    offsets = [
        model.split(values | {"windows": windows}, torch.Generator().manual_seed(3))["means"] - values["means"]
        for windows in (values["windows"], row(-1e6, 1e6).expand(len(kinds), 2))
    ]
    torch.testing.assert_close(offsets[0], torch.where(kinds, 2.0, 1.0) * offsets[1])
    assert 0 < kinds.sum() < len(kinds)


@pytest.mark.parametrize("rise", ["text", "code"])
def test_outside_its_interval_a_gaussian_is_culled(rise):
    """Catches an interval in key intervals, one of the shorter fade, and one with an end for a static Gaussian."""
    model = lively("ex4dgs", 200, intervals=8, rise=rise)
    kinds = is_dynamic(raw(model))[:, 0]
    model.splats["fades"].data -= 3.0
    intervals = model.visible_intervals()
    assert torch.equal(intervals[~kinds], torch.tensor([0.0, 1.0]).double().expand(int((~kinds).sum()), 2))
    for time in torch.linspace(0, 1, 41, dtype=torch.float64):
        outside = (time < intervals[:, 0]) | (time > intervals[:, 1])
        assert (model.slice(CameraTime.at(CAMERA, time)).opacities[outside] < ALPHA_MIN).all()
    assert (intervals[kinds, 1] - intervals[kinds, 0] < 0.9).any()
    middle, reach = model.lifetimes()
    at_reach = model.visibility(raw(model), 1 + 8 * (middle + reach)[kinds.nonzero()[0]])[kinds.nonzero()[0]]
    longer = raw(model)["fades"].argmax(1)[kinds.nonzero()[0]]
    assert longer != 1 or at_reach.item() == pytest.approx(math.exp(-0.5))


def test_a_training_makes_gaussians_dynamic():
    """Catches a round that does not ask the model, and a dynamic Gaussian whose keyframes do not learn."""
    fitted = trainer("ex4dgs", "model.options.dynamic_share=0.1")
    fitted.run(lambda _: None, "ex4dgs")
    values = raw(fitted.model)
    kinds = is_dynamic(values)[:, 0]
    assert 0.05 * len(kinds) < kinds.sum() < len(kinds)
    assert (values["key_quats"][kinds].abs().amax(1) > 0).any()
    assert not values["key_quats"][~kinds].any()
