"""Models whose rows have different effects: static rows, rows that AGR does not move, colours of fewer harmonics."""

import pytest
import torch
from small import (
    CAMERA,
    EVERY,
    VARIANTS,
    Balls,
    N,
    active,
    covariances,
    fresh,
    lively,
    raw,
    seeded,
    started,
    with_effect_sets,
)
from torch import Tensor

from gsbench import models
from gsbench.errors import InputError
from gsbench.gates.hook import without_direction
from gsbench.kernels.headers import LOG_SIZE_MAX
from gsbench.models import CameraTime, GaussianModel, registry
from gsbench.models.base import Raw
from gsbench.models.cholesky import CholeskyModel
from gsbench.models.effect_sets import EffectSets
from gsbench.models.factors import partner, rotation, rotation4d, turn_of_space
from gsbench.models.gated import GatedModel, as_gated
from gsbench.models.gaussian_batch import Conditioned, tensors_of
from gsbench.models.gaussians3d import Gaussians3DModel
from gsbench.models.simplifications import shares_of, simplifications_of
from gsbench.scenes.scene import Points

GATED = [variant for variant, (name, _) in EVERY.items() if getattr(registry.find(name), "gates", False)]
OBSERVING = [name for name in VARIANTS if not name.startswith("3dgs") and "agr" not in name]
QUERY = CameraTime.at(CAMERA, 0.45)


@pytest.mark.parametrize("variant", GATED)
def test_rows_have_the_effects_of_their_class_only(variant):
    """Catches effect sets cut at another row: what is static is the same everywhere, what AGR leaves is as it was; and
    arithmetic that depends on whether a model has effect sets."""
    model, whole, refined = with_effect_sets(active(variant), 8, 15), active(variant), 8 if "agr" in variant else 0
    moved, everything, raw = model.refined(QUERY), whole.refined(QUERY), dict(whole.splats.items())
    for name in (*model.centers, *model.geometry):
        assert torch.equal(moved[name][refined:], raw[name][refined:])
        torch.testing.assert_close(moved[name][:refined], everything[name][:refined])
    other = CameraTime.at(torch.tensor([3.0, 1.0, 2.0], dtype=torch.float64), 0.9)
    here, there = model.slice(QUERY), model.slice(other)
    for x, y in zip(here[:3], there[:3], strict=True):
        assert torch.equal(x[15:], y[15:])
    assert bool(model.observes) != torch.equal(here.means[refined:15], there.means[refined:15])
    assert torch.equal(here.opacities[15:], torch.sigmoid(model.splats["opacities"])[15:])
    static = torch.arange(N) >= 15
    constant, varied = static & (model.effect_sets.orders == 0), static & (model.effect_sets.orders % 4 > 0)
    assert constant.any()
    assert torch.equal(here.colors[constant], there.colors[constant])
    assert not torch.equal(here.colors[varied], there.colors[varied])
    model.effect_sets = EffectSets(N, N, torch.full((N,), 31, dtype=torch.int32))
    for x, y in zip(tensors_of(model.slice(QUERY)), tensors_of(whole.slice(QUERY)), strict=True):
        assert torch.equal(x, y)


def test_agr_that_moves_nothing_is_not_called(monkeypatch):
    """Catches networks that are evaluated on no row, which on a GPU costs as much as on a few."""
    model = with_effect_sets(active("7dgs_agr"), 0, 10)
    monkeypatch.setattr(model.refinement, "forward", None)
    assert all(x is model.splats[name] for name, x in model.refined(QUERY).items())


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_agr_moves_a_row_within_its_span_alone(dtype):
    """Catches a Gaussian that AGR moves before its first time, or after its last one, by torch and by the kernel."""
    model = with_effect_sets(active("7dgs_agr"), 4, 10).to(dtype)
    query = CameraTime.at(CAMERA.to(dtype), 0.45)
    whole, intervals = model.refined(query), torch.tensor([[0.5, 0.9], [0.1, 0.4], [0.4, 0.5], [0.0, 1.0]])
    model.effect_sets = model.effect_sets._replace(intervals=intervals)
    moved = model.refined(query)["means"]
    assert torch.equal(moved[:2], model.splats["means"][:2])
    torch.testing.assert_close(moved[2:], whole["means"][2:])
    assert (moved[2:4] != model.splats["means"][2:4]).any(1).all()


@torch.no_grad()
def freeze(model: GaussianModel) -> None:
    """Make every row an ordinary one that hardly changes: endlessly long in all that is observed, and not moving."""
    splats = model.splats
    if isinstance(model, CholeskyModel):
        for kind in model.layout.kinds[1:]:
            splats[kind].zero_()
        splats["log_diagonal"][:, model.rows["t"] + model.rows["d"]] = LOG_SIZE_MAX
    else:
        splats["right_quats"].copy_(partner(splats["left_quats"]))
        splats["scales"][:, 3] = LOG_SIZE_MAX


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("variant", OBSERVING)
def test_a_static_row_is_a_frozen_one(variant, dtype):
    """Catches a static row that would look otherwise to whoever does not know of effect sets, by kernels or by torch.
    An exponent of f_dir or f_temp is (q - mu)^2 / (2 e^32) = 1e-14 (q - mu)^2 there."""
    model = lively(variant).to(dtype)
    freeze(model)
    query, raw = CameraTime.at(CAMERA.to(dtype), 0.45), dict(model.splats.items())
    frozen = model.slice_geometry(raw, query)
    model.effect_sets = EffectSets(0, 0, None)
    static = model.slice_geometry(raw, query)
    tolerance = {"rtol": 1e-11, "atol": 1e-11} if dtype == torch.float64 else {"rtol": 1e-5, "atol": 1e-5}
    torch.testing.assert_close(static.means, frozen.means, **tolerance)
    torch.testing.assert_close(covariances(static), covariances(frozen), **tolerance)
    torch.testing.assert_close(static.opacities, frozen.opacities, **tolerance)


def test_turn_of_space():
    """Catches a sign or a place in the rotation of space that a left quaternion makes with its partner."""
    left = torch.randn(20, 4, generator=seeded(0), dtype=torch.float64)
    both = rotation4d(left, partner(left))
    torch.testing.assert_close(both[:, :3, :3], rotation(turn_of_space(left)))
    torch.testing.assert_close(both[:, 3], torch.tensor([0.0, 0, 0, 1], dtype=torch.float64).expand(20, 4))
    assert torch.equal(turn_of_space(turn_of_space(left)), left)


@pytest.mark.parametrize("variant", ["3dgs", "4dgs"])
@torch.no_grad()
def test_fewer_harmonics_have_the_same_colour_on_average(variant):
    """Catches a constant colour that is not given what the cut harmonics were on average, weighted by opacities."""
    model, g = fresh(variant).double(), seeded(3)
    model.splats["shN"] += 0.02 * torch.randn(model.splats["shN"].shape, generator=g, dtype=torch.float64)
    model.splats["sh0"] *= 0.5  # away from black, below which a colour is cut
    if variant == "4dgs":
        model.splats["scales"][:, 3] = 2.0  # visible at all times, and more at some than at others
    centers = 4 * torch.randn(4, 3, generator=g, dtype=torch.float64)
    queries = [CameraTime.at(center, time) for center, time in zip(centers, (0.1, 0.4, 0.5, 0.9), strict=True)]
    slices = [model.slice(query) for query in queries]
    weights, colors = shares_of([x.opacities for x in slices]), torch.stack([x.colors for x in slices])
    assert colors.amin() > 0
    simplifications = [x for x in simplifications_of(model, queries, slices) if x.order is not None]
    assert [simplification.order for simplification in simplifications] == model.lower_orders()
    for simplification in simplifications:
        raw = dict(model.splats.items()) | simplification.raw
        shaded = [model.shade(raw, x.means, x.opacities, q) for q, x in zip(queries, slices, strict=True)]
        change = torch.stack(shaded) - colors
        assert change.abs().amax() > 1e-3
        torch.testing.assert_close((weights[..., None] * change).sum(0), torch.zeros_like(change[0]), atol=1e-6, rtol=0)


@pytest.mark.parametrize("variant", ["7dgs", "7dgs_paper"])
def test_time_goes_on_as_it_did_where_direction_is_frozen(variant):
    """Catches f_temp by the deviation that t has at a known direction: frozen, direction is known no more."""
    model = lively(variant)
    early, late = (CameraTime.at(CAMERA, time) for time in (0.35, 0.6))
    weights = torch.full((2, len(model)), 0.5, dtype=torch.float64)
    frozen = model.frozen(raw(model), [early, late], weights)["direction"]
    before, after = (
        model.slice_geometry(x, late)[2] / model.slice_geometry(x, early)[2] for x in (raw(model), raw(model) | frozen)
    )
    assert (before - 1).abs().amax() > 0.1
    torch.testing.assert_close(after, before, rtol=1e-6, atol=0)


class Half(GatedModel, Balls):
    """Says that it can be gated, and has one of the two methods."""

    def static(self, raw: Raw) -> Conditioned:
        return self.condition(raw, None)


class Breathing(Gaussians3DModel):
    """Gaussians whose size changes with time by a parameter of which the inherited methods know nothing."""

    geometry = (*Gaussians3DModel.geometry, "breath")
    observes = ("time",)

    def initial_geometry(self, points: Points, distances: Tensor, generator: torch.Generator) -> Raw:
        return super().initial_geometry(points, distances, generator) | {"breath": torch.ones(len(distances), 1)}

    def condition(self, raw: Raw, query: CameraTime | None) -> Conditioned:
        calm = super().condition(raw, query)
        return calm._replace(factors=calm.factors * (1 + query.time * raw["breath"])[:, :, None])


class Checked(Breathing, gates=True):
    """The same, with the methods that know of it."""

    def static(self, raw: Raw) -> Conditioned:
        return Gaussians3DModel.condition(self, raw, None)


def test_gates_are_not_inherited():
    """Catches a model of ours whose gates are refused, one without the methods whose gates are not, and a model that is
    gated by its base's methods, which drop what it adds without a word."""
    for name in GATED:
        assert as_gated(fresh(name)).gates
    with pytest.raises(InputError, match="Balls is no GatedModel"):
        as_gated(started(Balls()))
    with pytest.raises(InputError) as caught:
        as_gated(started(Breathing()))
    assert str(caught.value) == (
        "effects.gate: expected a model that gates can simplify, Breathing inherits its methods for gates: see that "
        "they know all of its parameters, and write class Breathing(.., gates=True), or use effects.gate=off "
        "(docs/adding_a_model.md)"
    )
    assert without_direction(started(Breathing()), []) is None
    assert as_gated(started(Checked())).gates
    with pytest.raises(InputError, match="More inherits"):
        as_gated(started(type("More", (Checked,), {})()))


def test_a_model_that_lacks_a_method(monkeypatch):
    """Catches a TypeError of Python for a class that is not finished."""
    monkeypatch.setattr(registry, "_REGISTRY", registry._REGISTRY | {"half": Half})
    with pytest.raises(InputError, match="model 'half': expected all methods that a model needs, Half lacks frozen"):
        models.build("half")


FAULTS = {
    "counts": lambda state: state["effect_sets.counts"][1:].add_(10_000),
    "orders": lambda state: state["effect_sets.orders"].fill_(77),
    "intervals": lambda state: state.update({"effect_sets.intervals": torch.zeros(10_000, 2)}),
    "short": lambda state: state.update({"splats.motion": state["splats.motion"][:-1]}),
    "extra": lambda state: state.update({"effect_sets.more": torch.zeros(1)}),
    "no_opacities": lambda state: state.pop("splats.opacities"),
    "missing": lambda state: state.pop("effect_sets.orders"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_effect_sets_of_a_checkpoint_are_checked(fault):
    """Catches a damaged checkpoint that reaches the kernels with rows that there are not."""
    model = with_effect_sets(active("7dgs_agr"), 3, 10)
    model.fill(model.effect_sets)
    state = {name: tensor.clone() for name, tensor in model.pack().items()}
    FAULTS[fault](state)
    with pytest.raises(InputError, match="checkpoint: "):
        active("7dgs_agr").load_state(state)


def test_a_checkpoint_with_gates_of_a_model_without_them():
    """Catches a checkpoint that loads and then fails at its first image."""
    model = started(Gaussians3DModel())
    model.effect_sets = EffectSets(0, 0, torch.full((N,), 3, dtype=torch.int32))
    started(Gaussians3DModel()).load_state(model.pack())
    with pytest.raises(InputError, match=r"not of this model: expected effect_sets\.counts of shape none"):
        started(Balls()).load_state(model.pack())
