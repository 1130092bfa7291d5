"""What holds for every registered model: options, slices, gradients, checkpoints, gates and the export of a slice.

Models are found in the registry and their options in their constructors: a new one is tested without being listed.
"""

import copy
import inspect
import math
from pathlib import Path
from typing import Any

import pytest
import torch
from small import CAMERA, moved, seeded, started
from torch import Tensor

from gsbench.errors import InputError
from gsbench.models import CameraTime, GaussianModel, build, registry
from gsbench.models.effect_sets import EffectSets
from gsbench.models.gated import as_gated, has_gates
from gsbench.models.gaussian_batch import reach, tensors_of
from gsbench.models.simplifications import simplifications_of
from gsbench.scenes.gaussian_ply import ply_of, read_trained
from gsbench.schedule import ActiveComponents
from gsbench.train.regularisers import MeanOpacity, MeanSize, Penalty
from gsbench.view.slice_ply import has_harmonics, trained_of

N = 12
GIVEN: dict[Any, Any] = {float: 0.5, int: 1, bool: True}  # for an option without a default, by its type
WRONG: dict[Any, tuple[Any, ...]] = {
    float: ("1", True, math.nan, math.inf, -1.0),
    int: ("1", 1.0, True, -1, 10**30),
    bool: ("no", 1),
    str: ("nonsense", 1),
}
assert registry.is_registered("3dgs")  # all are
NAMES = sorted(registry._REGISTRY)
EVERY = pytest.mark.parametrize(("name", "agr"), [(name, agr) for name in NAMES for agr in (False, True)])
QUERY = CameraTime.at(CAMERA, 0.45)


def options_of(name: str) -> dict[str, inspect.Parameter]:
    """The options of a model's class and of its bases."""
    classes = [cls for cls in reversed(registry.find(name).__mro__) if issubclass(cls, GaussianModel)]
    return {p.name: p for cls in classes for p in inspect.signature(cls.__init__, eval_str=True).parameters.values()
            if p.kind is p.KEYWORD_ONLY}  # fmt: skip


def needed(name: str) -> dict[str, Any]:
    """Values of the options that have no default."""
    return {key: GIVEN[p.annotation] for key, p in options_of(name).items() if p.default is p.empty}


def awkward(name: str) -> dict[str, Any]:
    """Values of all options that are numbers, such as lambda, at 0.5: a default of 1 hides that it is forgotten."""
    return needed(name) | {key: 0.5 for key, p in options_of(name).items() if p.annotation is float}


def made(name: str, agr: bool, count: int = N, seed: int = 0) -> GaussianModel:
    """A model in the midst of a training, with everything switched on, in float64."""
    model = moved(started(build(name, agr=agr, **awkward(name)), count, seed), seed)
    model.set_active(ActiveComponents(3, agr, True))
    return model


def same(a: dict[str, Tensor], b: dict[str, Tensor]) -> bool:
    """Whether two states have the same bits."""
    return a.keys() == b.keys() and all(torch.equal(x, b[key]) and x.dtype == b[key].dtype for key, x in a.items())


@pytest.mark.parametrize("name", NAMES)
def test_wrong_options_are_refused(name: str) -> None:
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


@pytest.mark.parametrize("name", NAMES)
def test_every_number_among_the_options_matters(name: str) -> None:
    """Catches an option that is checked and then forgotten: neither the start nor a slice depends on it."""

    def numbers(options: dict[str, Any]) -> list[Tensor]:
        model = started(build(name, **options))
        start = [x.detach().clone() for x in model.splats.values()]
        return [*start, *tensors_of(moved(model).slice(QUERY))]

    options, static = awkward(name), "time" not in registry.find(name).observes
    known = numbers(options)
    for key in options:
        if static and "time" in key:  # of a model that derives from one with time
            continue
        both = name == "ndgs" and key in ("lambda_d", "lambda_t")  # which a joint gate needs equal
        changed = {"lambda_d": 0.25, "lambda_t": 0.25} if both else {key: 0.25}
        assert any(not torch.equal(x, y) for x, y in zip(known, numbers(options | changed), strict=True)), key


@EVERY
@pytest.mark.parametrize("count", [0, 1, N])
def test_a_slice_has_its_shapes(name: str, agr: bool, count: int) -> None:
    """Catches a model that needs a Gaussian, broadcasts a single one, or says otherwise by its kernels."""
    model = made(name, agr)
    model.select(torch.arange(count))
    seen = model.slice(QUERY)
    assert len(model) == count
    shapes = [] if seen.beta_exponents is None else [(count,)]
    assert [tuple(x.shape) for x in tensors_of(seen)] == [(count, 3), (count, 3, 3), (count,), (count, 3), *shapes]
    assert all(x.isfinite().all() for x in tensors_of(seen))
    assert ((seen.opacities >= 0) & (seen.opacities <= 1)).all()
    assert (seen.colors >= 0).all()
    by_kernels = copy.deepcopy(model).float().slice(CameraTime.at(CAMERA.float(), 0.45))
    drawn = (seen.opacities > 1 / 200)[:, None]  # kernels do not colour what cannot be seen
    for x, y in ((by_kernels.means, seen.means), (by_kernels.opacities, seen.opacities)):
        torch.testing.assert_close(x.double(), y, rtol=1e-3, atol=1e-4)
    covariances = [x.factors.double() @ x.factors.double().mT for x in (by_kernels, seen)]  # factors may be turned
    torch.testing.assert_close(*covariances, rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(by_kernels.colors.double() * drawn, seen.colors * drawn, rtol=1e-3, atol=1e-4)


@EVERY
def test_gradients_reach_every_group(name: str, agr: bool) -> None:
    """Catches a parameter that the optimizer has a rate for, and that learns nothing or turns NaN."""
    model = made(name, agr)
    sum(x.square().sum() for x in tensors_of(model.slice(QUERY))).backward()
    for group, parameters in model.groups().items():
        for x in parameters:
            assert x.grad is not None, group
            assert x.grad.isfinite().all(), group
            assert x.grad.any(), group
    grouped = [id(p) for parameters in model.groups().values() for p in parameters]
    assert sorted(grouped) == sorted(id(p) for p in model.parameters())  # each once


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("kind", [MeanOpacity, MeanSize])
def test_penalties_have_the_gradients_of_their_values(name: str, kind: type[Penalty]) -> None:
    """Catches a penalty whose gradient is lost or wrong, such as one of detached sizes: it is printed and acts on
    nothing."""
    model = made(name, False)
    penalty = kind(model, 0, 1)
    penalty(QUERY, 0).backward()
    learns = {key for key, x in model.splats.items() if x.grad is not None and x.grad.any()}
    assert learns == ({"opacities"} if kind is MeanOpacity else learns & set(model.geometry))
    assert learns
    for key in learns:
        x, step = model.splats[key], 1e-6 * torch.randn(model.splats[key].shape, generator=seeded(1)).double()
        ends = []
        for sign in (1, -1):
            x.data += sign * step
            ends.append(penalty(QUERY, 0).detach())
            x.data -= sign * step
        assert x.grad is not None
        torch.testing.assert_close((ends[0] - ends[1]) / 2, (x.grad * step).sum(), rtol=1e-6, atol=1e-15)


@EVERY
def test_a_checkpoint_is_the_model(name: str, agr: bool) -> None:
    """Catches state that is not saved: a model of another size that loads it is the same to the bit."""
    model, other = made(name, agr), made(name, agr, count=5, seed=3)
    objects = dict(other.splats.items())
    other.load_state(model.pack())
    assert same(model.pack(), other.pack())
    seen, again = tensors_of(model.slice(QUERY)), tensors_of(other.slice(QUERY))
    assert all(torch.equal(x, y) for x, y in zip(seen, again, strict=True))
    assert all(other.splats[key] is parameter for key, parameter in objects.items())
    state, means = model.pack(), model.pack()["splats.means"]
    others = (means[:-1], means[:, :2], means[0, 0], means.float(), means.to_sparse(), "means")
    changed = [state | {"splats.means": x} for x in others] + [state | {"splats.extra": means}, {}]
    for wrong in (*changed, {key: x for key, x in state.items() if key != "splats.means"}):
        with pytest.raises(InputError, match=r"^checkpoint: ") as error:
            other.load_state(wrong)
        assert "\n" not in str(error.value)
    with pytest.raises(InputError, match=r"^checkpoint: "):
        other.load_state(made(name, not agr).pack())
    assert same(model.pack(), other.pack())  # nothing of them was loaded


@EVERY
def test_gates_are_asked_for_or_refused(name: str, agr: bool) -> None:
    """Catches a model that gates take and cannot simplify, and a checkpoint of other rows than were gated."""
    model = made(name, agr).requires_grad_(False)
    if not has_gates(model):
        with pytest.raises(InputError, match=r"is no GatedModel|inherits its methods for gates"):
            as_gated(model)
        return
    queries = [QUERY, CameraTime.at(-CAMERA, 0.7)]
    found = simplifications_of(as_gated(model), queries, [model.slice(query) for query in queries])
    assert {"removed"} < {one.name for one in found}
    for one in found:
        for key, x in (one.raw or {}).items():
            assert x.shape == model.splats[key].shape
            assert x.isfinite().all(), (one.name, key)
    orders = torch.arange(N, dtype=torch.int32) % 4
    model.effect_sets = EffectSets(3 if agr else 0, 7, orders, torch.zeros(N, dtype=torch.uint8))
    model.fill(model.effect_sets)
    other = made(name, agr, count=5, seed=3)
    other.load_state(model.pack())
    assert same(model.pack(), other.pack())
    seen, again = tensors_of(model.slice(QUERY)), tensors_of(other.slice(QUERY))
    assert all(torch.equal(x, y) for x, y in zip(seen, again, strict=True))
    seen, later = (model.slice(query) for query in queries)
    assert all(torch.equal(x[7:], y[7:]) for x, y in zip(seen[:3], later[:3], strict=True))  # static rows


@EVERY
def test_a_slice_is_exported(name: str, agr: bool, tmp_path: Path) -> None:
    """Catches a PLY that has lost a Gaussian or moved one, and harmonics for a model whose slice has none."""
    model, query = made(name, agr).float(), CameraTime.at(CAMERA.float(), 0.45)
    (tmp_path / "slice.ply").write_bytes(ply_of(trained_of(model, query)))
    read, seen = read_trained(tmp_path / "slice.ply"), model.slice(query)
    drawn = seen.opacities >= 1 / 255
    torch.testing.assert_close(read.means, seen.means[drawn].detach())
    torch.testing.assert_close(torch.sigmoid(read.logits), seen.opacities[drawn].detach())
    factors = seen.factors if seen.beta_exponents is None else seen.factors / reach(seen.beta_exponents)[:, None, None]
    volumes = torch.linalg.det(factors[drawn].detach()).abs()
    torch.testing.assert_close(read.log_scales.sum(1).exp(), volumes, rtol=1e-3, atol=1e-6)
    if has_harmonics(model):
        assert len(trained_of(model, query, keep_harmonics=True)) == len(read)
    else:
        with pytest.raises(InputError, match="--direction"):
            trained_of(model, query, keep_harmonics=True)


@pytest.mark.parametrize("name", NAMES)
def test_before_it_has_gaussians(name: str) -> None:
    """Catches an error of Python for the length of a model that was only built, and for its start at no points."""
    model = build(name, **needed(name))
    assert len(model) == 0
    with pytest.raises(InputError, match="points: expected more than 3"):
        started(model, 0)


TIMED = [name for name in NAMES if "time" in registry.find(name).observes]
# The raw parameter and the column that hold the size in time, and a number that makes this size tiny.
IN_TIME = {"4dgs": ("scales", 3, -20.0), "dbs": ("precision", -1, 20.0), "dgs": ("precision", -1, 20.0),
           "freetime": ("durations", 0, -20.0), "ubs": ("scales", -1, -20.0)}  # fmt: skip
LEAST = 0.04


@pytest.mark.parametrize("name", TIMED)
def test_a_model_holds_it(name: str) -> None:
    """Catches a model that forgets lambda, its unit of time or the exponents, or that lengthens what is long enough."""
    model = started(build(name, **awkward(name)))
    raw = {key: value.data for key, value in model.splats.items()}
    if "times" not in raw:
        pytest.skip("its Gaussians have no times")
    bounded = getattr(model, "bounded_times", False) or name == "dgs"
    raw["times"].fill_(0.0 if bounded else 0.5)  # the sigmoid of 0 is 0.5
    parameter, column, tiny = IN_TIME.get(name) or ("log_diagonal", model.rows["t"][0], -20.0)  # type: ignore[index]
    raw[parameter][::2, column] = tiny
    before = {key: value.clone() for key, value in raw.items()}

    def shares() -> torch.Tensor:
        """The opacities LEAST after the mean time, divided by those at the mean time."""
        now, later = (model.slice(CameraTime.at(CAMERA.float(), 0.5 + dt)).opacities for dt in (0.0, LEAST))
        return (later / now)[now > 1e-3]

    assert (shares() < 0.01).any()
    with torch.no_grad():
        model.hold_lifetimes(LEAST)
    assert 0.5 < shares().min() < 0.65  # exp(-1/2) is 0.61, Beta profiles fall faster
    for key, value in raw.items():
        changed = value != before[key]
        assert key == parameter or not changed.any()
        assert not changed[1::2].any()
