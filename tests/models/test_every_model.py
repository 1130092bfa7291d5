"""What holds for every model: options, start, slices, gradients, AGR, checkpoints, gates and the export of a slice.

Models are found in the registry and their options in their constructors: a new one is tested without being listed.
"""

import copy
import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from small import (
    CAMERA,
    EVERY,
    EXTENT,
    MODELS,
    NAMES,
    NARROW,
    N,
    active,
    covariances,
    fresh,
    halves,
    last_layer,
    lively,
    moved,
    options_of,
    pinhole,
    raw,
    same,
    seeded,
    started,
    with_effect_sets,
)
from torch import Tensor, nn

from gsbench.errors import InputError
from gsbench.models import CameraTime, build, registry
from gsbench.models.appearance import sh_colors, sh_time_colors
from gsbench.models.beta import BetaModel
from gsbench.models.camera_time import unit
from gsbench.models.gated import as_gated, has_gates
from gsbench.models.gaussian_batch import reach, tensors_of
from gsbench.models.refinement import DeepRefinement
from gsbench.models.simplifications import simplifications_of
from gsbench.scenes.gaussian_ply import ply_of, read_trained
from gsbench.scenes.points import SH_C0, nearest_distances
from gsbench.scenes.scene import Points
from gsbench.schedule import ActiveComponents
from gsbench.train.hooks.penalties import PENALTIES
from gsbench.view.slice_ply import has_harmonics, trained_of

WRONG: dict[Any, tuple[Any, ...]] = {
    float: ("1", True, math.nan, math.inf, -1.0),
    int: ("1", 1.0, True, -1, 10**30),
    bool: ("no", 1),
    str: ("nonsense", 1),
}
REGISTERED = pytest.mark.parametrize("name", NAMES)
VARIANT = pytest.mark.parametrize("variant", EVERY)
REFINED = pytest.mark.parametrize("variant", [variant for variant in EVERY if variant.endswith("_agr")])
QUERY, LATER = CameraTime.at(CAMERA, 0.45), CameraTime.at(-CAMERA, 0.7)


def needed(name: str) -> dict[str, Any]:
    """Values of the options that have no default."""
    return {key: 0.5 for key, p in options_of(name).items() if p.default is p.empty}


# ---- options


@REGISTERED
def test_wrong_options_are_refused(name):
    """Catches an option that is misspelt, missing or of another type and met only in mid-training."""
    good = needed(name)
    with pytest.raises(InputError, match="has no option 'nonsense'"):
        build(name, nonsense=1, **good)
    for key in good:
        with pytest.raises(InputError, match=key):
            build(name, **{other: x for other, x in good.items() if other != key})
    for key, parameter in options_of(name).items():
        for wrong in WRONG.get(parameter.annotation, ("nonsense",)):
            with pytest.raises(InputError) as error:
                build(name, **good | {key: wrong})
            assert key in str(error.value)
            assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("7gds", {}, "Did you mean '7dgs'?"),
        ("7dgs", {"factor_oder": "paper"}, "Did you mean 'factor_order'?"),
        ("7dgs", {"factor_order": "papr"}, "Did you mean 'paper'?"),
        ("7dgs", {"scheme": "shur"}, "Did you mean 'schur'?"),
        ("4dgs", {"scheme": "shur"}, "Did you mean 'schur'?"),
        ("6dgs", {"lambda_t": 0.5}, "has no option 'lambda_t'"),
        ("3dgs", {"sh_degree": 4}, "sh_degree: expected 0, 1, 2 or 3, got 4"),
        ("4dgs", {"lambda_t": 0.0}, "lambda_t"),
        ("ndgs", {"lambda_d": 0.2}, r"joint_gate: expected lambda_d equal to lambda_t, got 0.2 and 0.5"),
        ("dgs", {"coupling": "texts"}, "coupling 'texts'"),
        ("freetime", {"duration": 0.0}, "duration"),
        ("7dgs", {"agr_width": 32}, "expected agr_depth too"),
        ("7dgs", {"agr_mean_octaves": 10}, "expected agr_depth too"),
        ("7dgs", {"agr_depth": 4}, "agr_depth: expected agr=true too"),
        ("ubs", {"modulation": "white"}, "modulation 'white'"),
    ],
)
def test_a_refusal_says_what_is_meant(name, options, message):
    """Catches an option that is misspelt, out of range or of another model, without a word about what is meant."""
    with pytest.raises(InputError) as error:
        build(name, **(halves(name) if name in NAMES else {}) | options)
    assert message in str(error.value)


@REGISTERED
def test_every_number_among_the_options_matters(name):
    """Catches an option that is checked and then forgotten: neither start, slice nor loss depends on it."""

    def numbers(options: dict[str, Any]) -> list[Tensor]:
        model = moved(started(build(name, **options)))
        penalty = model.penalty()
        return [*raw(model).values(), *tensors_of(model.slice(QUERY)), *([] if penalty is None else [penalty])]

    options = halves(name) | NARROW.get(name, {})
    static, before = "time" not in registry.find(name).observes, numbers(options)
    for key in halves(name):
        if static and "time" in key:  # of a model that derives from one with time
            continue
        both = name == "ndgs" and key in ("lambda_d", "lambda_t")  # which a joint gate needs equal
        changed = {"lambda_d": 0.25, "lambda_t": 0.25} if both else {key: 0.25}
        after = numbers(options | changed)
        assert any(not torch.equal(x, y) for x, y in zip(before, after, strict=True)), key


# ---- the start


@REGISTERED
def test_before_it_has_gaussians(name):
    """Catches an error of Python for the length of a model that was only built, and for its start at no points."""
    model = build(name, **needed(name))
    assert len(model) == 0
    with pytest.raises(InputError, match="points: expected more than 3"):
        started(model, 0)


@VARIANT
def test_start(variant):
    """Catches a start other than METHODS': spheres at the neighbours' distance, opacity 0.1 (of Beta profiles 0.5), the
    points' colours; and a draw from torch's global generator."""
    torch.manual_seed(1)
    model, g = fresh(variant), seeded(0)
    torch.manual_seed(2)
    again, other = fresh(variant), fresh(variant, seed=5)
    assert all(torch.equal(x, y) for x, y in zip(model.parameters(), again.parameters(), strict=True))
    assert not torch.equal(model.splats["means"], other.splats["means"])
    assert {p.dtype for p in model.parameters()} == {torch.float32}
    points = Points(torch.rand(N, 3, generator=g) * 2 - 1, torch.rand(N, 3, generator=g))
    assert len(model) == N
    assert model.extent == EXTENT
    torch.testing.assert_close(model.splats["means"].data, points.means)
    opacity = 0.5 if isinstance(model, BetaModel) else 0.1
    torch.testing.assert_close(torch.sigmoid(model.splats["opacities"]).data, torch.full((N,), opacity))
    model.set_active(replace(model.active, warms_up=True))  # a field of random weights acts only after it
    size, sliced = nearest_distances(points.means), model.slice(CameraTime.at(CAMERA.float(), 0.4))
    torch.testing.assert_close(covariances(sliced), size.square()[:, None, None] * torch.eye(3), rtol=1e-4, atol=1e-6)
    deviation = size if sliced.beta_exponents is None else size / math.sqrt(8)  # profiles start with exponents of 4
    torch.testing.assert_close(model.scales(), deviation, rtol=1e-4, atol=0)
    if "precision" not in model.splats:  # whose couplings start as small random numbers
        noise = 1e-3 if "lower" in model.splats else 1e-6  # UBS starts with random entries below the diagonal
        torch.testing.assert_close(sliced.means.data, points.means, rtol=0, atol=noise)
    drawn = sliced.opacities > 1 / 255
    torch.testing.assert_close(sliced.colors.data[drawn, :3], points.colors[drawn])


@REGISTERED
def test_gaussians_start_at_the_times_of_their_points(name):
    """Catches a model that draws the mean times that points bring, or that takes them for logits."""
    model, times = build(name, **needed(name)), torch.linspace(0, 1, N)
    means = torch.rand(N, 3, generator=seeded(0))
    model.initialise(Points(means, means, times), EXTENT, seeded(0))
    if "times" in model.splats:
        begun = model.splats["times"].data[:, 0]
        is_logit = getattr(model, "bounded_times", False) or name == "dgs"
        torch.testing.assert_close(torch.sigmoid(begun) if is_logit else begun, times, rtol=0, atol=2e-6)


# ---- a slice


@VARIANT
@pytest.mark.parametrize("count", [0, 1, N])
def test_a_slice_has_its_shapes(variant, count):
    """Catches a model that needs a Gaussian, broadcasts a single one, or says otherwise by its kernels, in the
    harmonics' schedule too; and NaN, opacities above 1 or negative colours beyond the clip."""
    model = active(variant)
    model.select(torch.arange(count))
    assert len(model) == count
    single = copy.deepcopy(model).float()
    for degree, time in ((3, 0.45), (0, 0.2), (1, 0.7), (3, -1.0), (3, 2.0)):
        for either in (model, single):
            either.set_active(ActiveComponents(degree, model.agr, True))
        query = CameraTime.at(CAMERA, time)
        sliced = model.slice(query)
        D = sliced.colors.shape[1] if model.decodes else 3
        shapes = [(count, 3), (count, 3, 3), (count,), (count, D)] + [(count,)] * (sliced.beta_exponents is not None)
        assert [tuple(x.shape) for x in tensors_of(sliced)] == shapes
        assert all(x.isfinite().all() for x in tensors_of(sliced))
        assert ((sliced.opacities >= 0) & (sliced.opacities <= 1)).all()
        assert model.decodes or (sliced.colors >= 0).all()
        if not 0 <= time <= 1:
            continue
        by_kernels = single.slice(CameraTime.at(CAMERA.float(), time))
        drawn = (sliced.opacities > 1 / 200)[:, None]  # kernels do not colour what cannot be seen
        for x, y in (
            (by_kernels.means, sliced.means),
            (by_kernels.opacities, sliced.opacities),
            (covariances(by_kernels), covariances(sliced)),
            (by_kernels.colors * drawn, sliced.colors * drawn),
        ):
            torch.testing.assert_close(x.double(), y, rtol=1e-3, atol=1e-4)


@VARIANT
def test_slice_at_its_own_mean_is_the_gaussian(variant):
    """Catches a query in other coordinates than the mean: at t = mu_t, d = mu_d nothing moves, nothing fades."""
    model = lively(variant)
    model.set_active(ActiveComponents(3, False, False, warms_up=True))
    values = raw(model)
    if "directions" in values:
        model.splats["directions"].data = unit(values["directions"])
    times = values.get("times", torch.full((N, 1), 0.5))[:, 0]
    if getattr(model, "bounded_times", False) or variant.startswith("dgs"):
        times = torch.sigmoid(times)
    if "velocities" in values and "times" not in values:  # static Gaussians of Ex4DGS, which leave their means at once
        model.select(torch.arange(N // 2, N))
        values, times = raw(model), torch.zeros(N // 2)
    directions = unit(values.get("directions", torch.tensor([0, 0.6, 0.8]).double().expand(N, 3)))
    for i in range(4):
        mean = values["means"][i]
        sliced = model.slice(CameraTime.at(mean - 3 * directions[i], times[i].item()))
        torch.testing.assert_close(sliced.means[i], mean)
        torch.testing.assert_close(sliced.opacities[i], torch.sigmoid(values["opacities"][i]))


@VARIANT
def test_colors_are_seen_from_the_camera(variant):
    """Catches a colour looked up in the direction to the camera, or to where the Gaussian is not at that time."""
    model = lively(variant)
    sliced, values = model.slice(QUERY), model.refined(QUERY)
    directions = nn.functional.normalize(sliced.means - CAMERA, dim=-1)
    coefficients = torch.cat([values["sh0"].flatten(1, -2), values["shN"]], 1)
    if variant.startswith("4dgs"):
        offset = 0.45 - values["times"][:, 0]
        expected = sh_time_colors(coefficients.unflatten(1, (-1, 16)), directions, 3, offset)
    else:
        expected = sh_colors(coefficients, directions, 3)
    torch.testing.assert_close(sliced.colors[:, :3].clamp(min=0), expected)  # features may be negative


def test_sh_degree_grows_with_the_phase():
    """Catches colours that use coefficients of a degree not yet on."""
    model = lively("3dgs")
    model.set_active(ActiveComponents(0, False, False))
    flat = model.slice(QUERY).colors
    torch.testing.assert_close(flat, (SH_C0 * model.splats["sh0"][:, 0] + 0.5).clamp(min=0))
    model.set_active(ActiveComponents(1, False, False))
    assert not torch.allclose(model.slice(QUERY).colors, flat)


@VARIANT
def test_time_is_asked_for_where_it_is_needed(variant):
    """Catches a static scene given to a model of time, and a static model that demands one."""
    model, timeless = fresh(variant), CameraTime.at(CAMERA.float(), None)
    if "time" in model.observes or model.agr:
        with pytest.raises(InputError, match="expected a time"):
            model.slice(timeless)
    else:
        assert model.slice(timeless).means.shape == (N, 3)


# ---- gradients


@VARIANT
def test_gradients_reach_every_group(variant):
    """Catches a parameter that the optimizer has a rate for, and that learns nothing or turns NaN; a camera on a mean,
    where the direction is 0/0, is taken for no direction."""
    model = active(variant)
    assert all(x.isfinite().all() for x in tensors_of(model.slice(CameraTime.at(model.splats["means"].data[0], 0.5))))
    for center in (model.splats["means"].data[0].clone(), CAMERA):
        model.zero_grad(set_to_none=True)
        sliced = model.slice(CameraTime.at(center, 0.45))
        pixels = sliced.colors.reshape(1, 4, N // 4, -1)  # as if each Gaussian were one
        image = model.decode(pixels, pinhole(N // 4, 4))
        sum(x.square().sum() for x in (*tensors_of(sliced), image)).backward()
        for group, parameters in model.groups().items():
            for x in parameters:
                assert x.grad is not None, group
                assert x.grad.isfinite().all(), group
                assert x.grad.any(), group
    grouped = [id(p) for parameters in model.groups().values() for p in parameters]
    assert sorted(grouped) == sorted(id(p) for p in model.parameters())  # each once


@VARIANT
def test_a_slice_has_the_gradients_of_its_values(variant):
    """Catches a wrong or lost derivative on the way from any raw parameter to the slice (central differences), where a
    row is refined and conditioned, only conditioned, or static."""
    degree = 3 if variant == "3dgs" else 1  # every coefficient is one more central difference
    model = active(variant, 4, sh_degree=degree)
    model.select(torch.arange(3))
    with_effect_sets(model, 1, 2)
    held = set()  # through which no gradient flows ..
    if "precision" in model.splats:  # .. to the direction of dGS and dBS,
        model.set_active(ActiveComponents(degree, False, True))
        held = {"means"}
    held |= {"means"} if "field" in model.groups() else set()  # the positions that a field reads,
    held |= set(model.centers) if isinstance(model.refinement, DeepRefinement) else set()
    if "path" in model.splats:  # and the times of a path, which AGR moves by the means
        held = {"means", "times"} if model.agr else {"times"}
    splats, names = raw(model), sorted(set(model.splats) - held)
    values = [splats[name].requires_grad_() for name in names]
    del model.splats

    def sliced(*values: Tensor) -> tuple[Tensor, ...]:
        model.splats = splats | dict(zip(names, values, strict=True))
        gaussians = model.slice(QUERY)
        return tuple(tensors_of(gaussians._replace(factors=gaussians.factors @ gaussians.factors.mT)))

    assert (sliced(*values)[2] > 0).any()
    assert torch.autograd.gradcheck(sliced, values, atol=1e-6)


@REGISTERED
@pytest.mark.parametrize("kind", PENALTIES)
def test_penalties_have_the_gradients_of_their_values(name, kind):
    """Catches a penalty whose gradient is lost or wrong, such as one of detached sizes, which acts on nothing."""
    model = active(name)
    PENALTIES[kind](model).backward()
    learns = {key for key, x in model.splats.items() if x.grad is not None and x.grad.any()}
    assert learns == ({"opacities"} if kind == "opacity" else learns & set(model.geometry))
    assert learns
    for key in learns:
        x, step = model.splats[key], 1e-6 * torch.randn(model.splats[key].shape, generator=seeded(1)).double()
        ends = []
        for sign in (1, -1):
            x.data += sign * step
            ends.append(PENALTIES[kind](model).detach())
            x.data -= sign * step
        torch.testing.assert_close((ends[0] - ends[1]) / 2, (x.grad * step).sum(), rtol=1e-6, atol=1e-15)


# ---- AGR and active components


@REFINED
def test_agr_moves_what_it_should(variant):
    """Catches residuals added to the wrong parameter, after the exp, or to colours and opacity; and a refinement whose
    switching on in mid-training is a jump."""
    model = lively(variant)
    model.set_active(replace(model.active, warms_up=True))  # after which a field may change raw parameters too
    before, after = raw(model), model.refined(QUERY)
    names = [*model.centers, *model.geometry]
    expected = model.refinement([before[k] for k in names], torch.tensor(0.45, dtype=torch.float64))
    torch.testing.assert_close([after[k] for k in names], expected)
    assert not any(torch.equal(after[k], before[k]) for k in names)
    for untouched in set(before) - set(names):
        assert torch.equal(after[untouched], before[untouched])
    for p in last_layer(model.refinement):
        p.data.zero_()
    on = tensors_of(model.slice(QUERY))
    model.set_active(replace(model.active, refine=False))
    assert all(torch.equal(a, b) for a, b in zip(on, tensors_of(model.slice(QUERY)), strict=True))


@REFINED
def test_what_is_off_does_not_learn(variant):
    """Catches a switch that does not reach the networks or the lambdas, or lambdas that can turn negative."""
    model, (_, options) = lively(variant), EVERY[variant]
    for key in model.log_lambda:
        assert model.lambda_of(key).item() == pytest.approx(options.get(f"lambda_{key[0]}", 1.0))
    for refine, tune in [(False, False), (True, False), (False, True), (True, True)]:
        model.set_active(ActiveComponents(3, refine, tune))
        model.zero_grad(set_to_none=True)
        sum(x.square().sum() for x in tensors_of(model.slice(QUERY))).backward()
        learnt = last_layer(model.refinement)[0].grad
        assert (learnt is not None and learnt.any(1).all().item()) == refine
        assert all((p.grad is not None and p.grad.any().item()) == tune for p in model.log_lambda.parameters())
    for p in model.log_lambda.parameters():
        p.data -= 50
    assert all(model.lambda_of(key) > 0 for key in model.log_lambda)


# ---- checkpoints, gates, export


@VARIANT
@pytest.mark.parametrize("split", [False, True])
def test_a_checkpoint_is_the_model(variant, split):
    """Catches state that is not saved: a model of another size that loads it is the same to the bit, and the same
    parameters to the optimizer. States of something else, or damaged ones, are refused and change nothing."""
    model, other = active(variant), active(variant, count=5, seed=3)
    if split:
        model.fill(with_effect_sets(model, 3, 7).effect_sets) if has_gates(model) else pytest.skip("has no gates")
    objects = dict(other.splats.items())
    other.load_state(model.pack())
    assert same(model.pack(), other.pack())
    for x, y in zip(tensors_of(model.slice(QUERY)), tensors_of(other.slice(QUERY)), strict=True):
        assert torch.equal(x, y)
    assert all(other.splats[key] is parameter for key, parameter in objects.items())
    state, means = model.pack(), model.pack()["splats.means"]
    damaged = (means[:-1], means[:, :2], means[0, 0], means.float(), means.to_sparse(), "means")
    foreign = [lively(name).pack() for name in MODELS if name != EVERY[variant][0]]
    shape = dict.fromkeys(key for key in EVERY[variant][1] if key.startswith("agr_"))  # is refused without AGR
    foreign += [lively(variant, sh_degree=2).pack(), lively(variant, agr=not model.agr, **shape).pack()]
    foreign += [lively(variant, time_degree=1).pack()] if variant.startswith("4dgs") else []
    foreign += [state | {"splats.means": x} for x in damaged] + [state | {"splats.extra": means}, {}]
    for wrong in (*foreign, {key: x for key, x in state.items() if key != "splats.means"}):
        with pytest.raises(InputError, match=r"^checkpoint: ") as error:
            other.load_state(wrong)
        assert "\n" not in str(error.value)
    assert same(model.pack(), other.pack())  # nothing of them was loaded


@VARIANT
def test_gates_are_asked_for_or_refused(variant):
    """Catches a model that gates take and cannot simplify."""
    model = active(variant).requires_grad_(False)
    if not has_gates(model):
        with pytest.raises(InputError, match=r"is no GatedModel|inherits its methods|decodes what is blended"):
            as_gated(model)
        return
    queries = [QUERY, LATER]
    simplifications = simplifications_of(as_gated(model), queries, [model.slice(query) for query in queries])
    assert {"removed"} < {simplification.name for simplification in simplifications}
    for simplification in simplifications:
        for key, x in (simplification.raw or {}).items():
            assert x.shape == model.splats[key].shape
            assert x.isfinite().all(), (simplification.name, key)


@VARIANT
def test_a_slice_is_exported(variant, tmp_path):
    """Catches a PLY that has lost a Gaussian or moved one, and harmonics for a model whose slice has none."""
    model, query = active(variant).float(), CameraTime.at(CAMERA.float(), 0.45)
    if model.decodes:
        with pytest.raises(InputError, match="--images or --video"):
            trained_of(model, query)
        return
    (tmp_path / "slice.ply").write_bytes(ply_of(trained_of(model, query)))
    trained, sliced = read_trained(tmp_path / "slice.ply"), model.slice(query)
    drawn = sliced.opacities >= 1 / 255
    torch.testing.assert_close(trained.means, sliced.means[drawn].detach())
    torch.testing.assert_close(torch.sigmoid(trained.logits), sliced.opacities[drawn].detach())
    b = sliced.beta_exponents
    factors = sliced.factors if b is None else sliced.factors / reach(b)[:, None, None]
    volumes = torch.linalg.det(factors[drawn].detach()).abs()
    torch.testing.assert_close(trained.log_scales.sum(1).exp(), volumes, rtol=1e-3, atol=1e-6)
    if has_harmonics(model):
        assert len(trained_of(model, query, keep_harmonics=True)) == len(trained)
    else:
        with pytest.raises(InputError, match="--direction"):
            trained_of(model, query, keep_harmonics=True)
