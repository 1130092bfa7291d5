"""What holds for every model: how it starts, what it needs, how its active components act, what `build` refuses."""

from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from small import CAMERA, EXTENT, MODELS, VARIANTS, N, fresh, lively, raw, seeded
from torch import Tensor, nn

from gsbench.errors import InputError
from gsbench.models import CameraTime, build
from gsbench.models.appearance import sh_colors, sh_time_colors
from gsbench.models.camera_time import unit
from gsbench.models.factors import KINDS
from gsbench.models.gaussian_batch import tensors_of
from gsbench.scenes.points import SH_C0, nearest_distances
from gsbench.scenes.scene import Points
from gsbench.schedule import ActiveComponents

# ---- the start


@pytest.mark.parametrize("variant", VARIANTS)
def test_start(variant: str) -> None:
    """Catches a start other than METHODS': spheres at the neighbours' distance, opacity 0.1, the points' colours."""
    model = fresh(variant)
    g = seeded(0)
    points = Points(torch.rand(N, 3, generator=g) * 2 - 1, torch.rand(N, 3, generator=g))
    assert len(model) == N
    assert model.extent == EXTENT
    torch.testing.assert_close(model.splats["means"].data, points.means)
    torch.testing.assert_close(torch.sigmoid(model.splats["opacities"]).data, torch.full((N,), 0.1))
    size = nearest_distances(points.means)
    torch.testing.assert_close(model.scales(), size)
    sliced = model.slice(CameraTime.at(CAMERA.float(), 0.4))
    torch.testing.assert_close(sliced.means.data, points.means)
    covariance = (sliced.factors @ sliced.factors.mT).data
    torch.testing.assert_close(covariance, size.square()[:, None, None] * torch.eye(3))
    torch.testing.assert_close(sliced.colors.data, points.colors)
    assert {p.dtype for p in model.parameters()} == {torch.float32}


@pytest.mark.parametrize("variant", ["4dgs", "7dgs", "7dgs_paper", "7dgs_nodir"])
def test_start_in_time(variant: str) -> None:
    """Catches times outside [-0.1, 1.1], or not uniform, and a time scale other than sqrt(T/5) or sqrt(T/10)."""
    model = fresh(variant, 4000)
    times = model.splats["times"].data
    assert -0.1 <= times.min() < -0.09
    assert 1.09 < times.max() <= 1.1
    assert abs(times.mean() - 0.5) < 0.02
    factor = model.factors(raw(model))
    S_t = factor[:, -1].square().sum(-1)
    torch.testing.assert_close(S_t, torch.full((4000,), 0.2 if variant == "4dgs" else 0.1))


@pytest.mark.parametrize("variant", ["6dgs", "7dgs", "7dgs_paper"])
def test_start_in_direction(variant: str) -> None:
    """Catches directions that are not uniform on the sphere and a direction scale other than 1."""
    model = fresh(variant, 4000)
    d = model.splats["directions"].data
    torch.testing.assert_close(d.norm(dim=-1), torch.ones(4000))
    assert d.mean(0).abs().max() < 0.03
    torch.testing.assert_close((d.mT @ d) / 4000, torch.eye(3) / 3, rtol=0, atol=0.02)
    torch.testing.assert_close(model.factors(raw(model))[:, 3:6].square().sum(-1), torch.ones(4000, 3))
    assert not any(raw(model)[kind].any() for kind in KINDS)


@pytest.mark.parametrize("variant", VARIANTS)
def test_same_seed_same_model(variant: str) -> None:
    """Catches a draw from torch's global generator: the seed alone decides."""
    torch.manual_seed(1)
    a = fresh(variant)
    torch.manual_seed(2)
    b, c = fresh(variant), fresh(variant, seed=5)
    assert all(torch.equal(x, y) for x, y in zip(a.parameters(), b.parameters(), strict=True))
    assert not torch.equal(a.splats["means"], c.splats["means"])


# ---- a slice


@pytest.mark.parametrize("variant", VARIANTS)
def test_slice_has_gradients(variant: str) -> None:
    """Catches a wrong or lost derivative on the way from any raw parameter to the slice (central differences)."""
    degree = 3 if variant == "3dgs" else 1  # every coefficient is one more central difference
    model = lively(variant, 4, sh_degree=degree)
    model.set_active(ActiveComponents(degree, True, True))
    names = sorted(model.splats)

    values = [model.splats[name].detach()[:2].requires_grad_() for name in names]
    del model.splats

    def sliced(*values: Tensor) -> tuple[Tensor, ...]:
        model.splats = dict(zip(names, values, strict=True))
        return tuple(tensors_of(model.slice(CameraTime.at(CAMERA, 0.45))))

    output = sliced(*values)
    assert (output[2] > 0).any()
    gradients = torch.autograd.grad(sum(x.sum() for x in output), values)
    assert all(g.any() for g in gradients)
    assert torch.autograd.gradcheck(sliced, values)


@settings(max_examples=10, deadline=None)
@given(st.sampled_from(sorted(VARIANTS)), st.integers(0, 2**31), st.floats(-1, 2))
def test_slices_can_be_drawn(variant: str, seed: int, time: float) -> None:
    """Catches NaN, opacities outside [0, 1] and negative colours at any time, also beyond the clip."""
    sliced = lively(variant, seed=seed).slice(CameraTime.at(CAMERA, time))
    assert [tuple(x.shape) for x in tensors_of(sliced)] == [(N, 3), (N, 3, 3), (N,), (N, 3)]
    assert all(x.isfinite().all() for x in tensors_of(sliced))
    assert (sliced.opacities >= 0).all()
    assert (sliced.opacities <= 1).all()
    assert (sliced.colors >= 0).all()


@pytest.mark.parametrize("variant", VARIANTS)
def test_slice_at_its_own_mean_is_the_gaussian(variant: str) -> None:
    """Catches a query in other coordinates than the mean: at t = mu_t, d = mu_d nothing moves, nothing fades."""
    model = lively(variant)
    model.set_active(ActiveComponents(3, False, False))
    if "directions" in model.splats:
        model.splats["directions"].data = unit(model.splats["directions"].data)
    for i in range(4):
        at = {name: value[i] for name, value in raw(model).items()}
        mean, direction = at["means"], at.get("directions", torch.tensor([0, 0.6, 0.8]).double())
        time = at["times"].item() if "times" in at else 0.5
        sliced = model.slice(CameraTime.at(mean - 3 * direction, time))
        torch.testing.assert_close(sliced.means[i], mean)
        torch.testing.assert_close(sliced.opacities[i], torch.sigmoid(model.splats["opacities"][i]))


@pytest.mark.parametrize("variant", VARIANTS)
def test_colors_are_seen_from_the_camera(variant: str) -> None:
    """Catches a colour looked up in the direction to the camera, or to where the Gaussian is not at that time."""
    model = lively(variant)
    sliced = model.slice(CameraTime.at(CAMERA, 0.5))
    d = nn.functional.normalize(sliced.means - CAMERA, dim=-1)
    values = model.refined(CameraTime.at(CAMERA, 0.5))
    coefficients = torch.cat([values["sh0"].flatten(1, -2), values["shN"]], 1)
    if variant.startswith("4dgs"):
        expected = sh_time_colors(coefficients.unflatten(1, (-1, 16)), d, 3, 0.5 - values["times"][:, 0])
    else:
        expected = sh_colors(coefficients, d, 3)
    torch.testing.assert_close(sliced.colors, expected)


@pytest.mark.parametrize("variant", VARIANTS)
def test_camera_on_a_mean(variant: str) -> None:
    """Catches 0/0: d is undefined there and taken as zero, and its gradient too."""
    model = lively(variant)
    sliced = model.slice(CameraTime.at(model.splats["means"].data[0], 0.5))
    sum(x.sum() for x in tensors_of(sliced)).backward()
    assert all(x.isfinite().all() for x in tensors_of(sliced))
    assert all(p.grad.isfinite().all() for p in model.splats.values())


@pytest.mark.parametrize("variant", VARIANTS)
def test_time_is_asked_for_where_it_is_needed(variant: str) -> None:
    """Catches a static scene given to a model of time, and a static model that demands one."""
    model = fresh(variant)
    if "time" in model.observes or model.agr:
        with pytest.raises(InputError, match="expected a time"):
            model.slice(CameraTime.at(CAMERA.float(), None))
    else:
        assert model.slice(CameraTime.at(CAMERA.float(), None)).means.shape == (N, 3)


# ---- AGR and active components


@pytest.mark.parametrize("name", MODELS)
def test_agr_changes_nothing_at_first(name: str) -> None:
    """Catches a refinement whose switching on in mid-training is a jump."""
    model = lively(f"{name}_agr")
    for p in (model.refinement.weight_out, model.refinement.bias_out):
        p.data.zero_()
    model.set_active(ActiveComponents(3, False, False))
    off = tensors_of(model.slice(CameraTime.at(CAMERA, 0.3)))
    model.set_active(ActiveComponents(3, True, False))
    on = tensors_of(model.slice(CameraTime.at(CAMERA, 0.3)))
    assert all(torch.equal(a, b) for a, b in zip(off, on, strict=True))


@pytest.mark.parametrize("name", MODELS)
def test_agr_moves_what_it_should(name: str) -> None:
    """Catches residuals added to the wrong parameter, after the exp, or to colours and opacity."""
    model = lively(f"{name}_agr")
    model.set_active(ActiveComponents(3, True, False))
    before, after = raw(model), model.refined(CameraTime.at(CAMERA, 0.3))
    names = [*model.centers, *model.geometry]
    moved = model.refinement([before[k] for k in names], torch.tensor(0.3, dtype=torch.float64))
    torch.testing.assert_close([after[k] for k in names], moved)
    assert not any(torch.equal(after[k], before[k]) for k in names)
    for untouched in set(before) - set(names):
        assert torch.equal(after[untouched], before[untouched])


@pytest.mark.parametrize("name", MODELS)
def test_what_is_off_does_not_learn(name: str) -> None:
    """Catches a switch that does not reach the networks or the lambdas, or lambdas that can turn negative."""
    model = lively(f"{name}_agr")
    lambdas = {"direction": MODELS[name].get("lambda_d"), "time": MODELS[name].get("lambda_t", 1.0)}
    for key in model.log_lambda:
        torch.testing.assert_close(model.lambda_of(key).item(), lambdas[key], rtol=1e-6, atol=0)
    for refine, tune in [(False, False), (True, False), (False, True), (True, True)]:
        model.set_active(ActiveComponents(3, refine, tune))
        model.zero_grad(set_to_none=True)
        sum(x.square().sum() for x in tensors_of(model.slice(CameraTime.at(CAMERA, 0.3)))).backward()
        learnt = model.refinement.weight_out.grad
        assert (learnt is not None and learnt.any(1).all().item()) == refine
        assert all((p.grad is not None and p.grad.any().item()) == tune for p in model.log_lambda.parameters())
    for p in model.log_lambda.parameters():
        p.data -= 50
    assert all(model.lambda_of(key) > 0 for key in model.log_lambda)


def test_sh_degree_grows_with_the_phase() -> None:
    """Catches colours that use coefficients of a degree not yet on."""
    model = lively("3dgs")
    model.set_active(ActiveComponents(0, False, False))
    flat = model.slice(CameraTime.at(CAMERA, None)).colors
    torch.testing.assert_close(flat, (SH_C0 * model.splats["sh0"][:, 0] + 0.5).clamp(min=0))
    model.set_active(ActiveComponents(1, False, False))
    assert not torch.allclose(model.slice(CameraTime.at(CAMERA, None)).colors, flat)


# ---- build


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("7gds", {}, "Did you mean '7dgs'?"),
        ("7dgs", MODELS["7dgs"] | {"factor_oder": "paper"}, "Did you mean 'factor_order'?"),
        ("3dgs", {"lambda_t": 0.5}, "has no option 'lambda_t'"),
        ("7dgs", MODELS["7dgs"] | {"factor_order": "papr"}, "Did you mean 'paper'?"),
        ("7dgs", MODELS["7dgs"] | {"scheme": "shur"}, "Did you mean 'schur'?"),
        ("4dgs", {"scheme": "shur"}, "Did you mean 'schur'?"),
        ("3dgs", {"sh_degree": 4}, "sh_degree: expected 0, 1, 2 or 3, got 4"),
        ("4dgs", {"lambda_t": 0.0}, "lambda_t"),
        ("6dgs", {"lambda_d": 0.5, "lambda_t": 0.5}, "lambda_t"),
    ],
)
def test_build_refuses(name: str, options: dict[str, Any], message: str) -> None:
    """Catches an option that is misspelt, out of range or of another model, without a word about what is meant."""
    with pytest.raises(InputError) as error:
        build(name, **options)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("variant", VARIANTS)
def test_build_takes_every_option_of_the_bases(variant: str) -> None:
    """Catches an option of `GaussianModel` that a subclass does not pass on."""
    model = fresh(variant, agr=True, sh_degree=1)
    assert model.sh_degree == 1
    assert model.refinement is not None
    assert model.slice(CameraTime.at(CAMERA.float(), 0.2)).colors.isfinite().all()
