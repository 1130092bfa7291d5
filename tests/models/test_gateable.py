"""Which models gates can simplify: a `GatedModel` with its methods, whatever a checkpoint says."""

from typing import Any

import pytest
import torch
from torch import Tensor

from gsbench import models
from gsbench.errors import InputError
from gsbench.gates.hook import without_direction
from gsbench.models import registry
from gsbench.models.base import SHRINK, GaussianModel, Raw
from gsbench.models.effect_sets import EffectSets
from gsbench.models.gated import GatedModel, as_gated
from gsbench.models.gaussian_batch import Conditioned
from gsbench.models.gaussians3d import Gaussians3DModel
from gsbench.scenes.scene import Points


class Balls(GaussianModel):
    """Balls, as docs/adding_a_model.md has them, without gates."""

    geometry = ("radii",)

    def initial_geometry(self, points: Points, distances: Tensor, generator: torch.Generator) -> Raw:
        return {"radii": distances.log()[:, None]}

    def condition(self, raw: Raw, query: Any) -> Conditioned:
        return Conditioned(raw["means"], raw["radii"].exp()[:, :, None] * torch.eye(3), torch.ones(len(raw["means"])))

    def spatial_scales(self) -> Tensor:
        return self.splats["radii"].exp()

    def split(self, raw: Raw, generator: torch.Generator) -> Raw:
        return {"means": raw["means"], "radii": raw["radii"] / SHRINK}


class Half(GatedModel, Balls):
    """Says that it can be gated, and has one of the two methods."""

    def static(self, raw: Raw) -> Conditioned:
        return self.condition(raw, None)


def made(kind: type[GaussianModel]) -> GaussianModel:
    model, points = kind(), torch.rand(6, 3, generator=torch.Generator().manual_seed(0))
    model.initialise(Points(points, points), 1.0, torch.Generator().manual_seed(0))
    return model


def test_models_that_can_be_gated() -> None:
    """Catches a model of ours whose gates are refused, and one without the methods whose gates are not."""
    for name in ("3dgs", "4dgs", "6dgs", "7dgs", "7dgs_nodir", "ndgs", "dgs", "freetime", "dbs", "dbs_static"):
        kind = models.find(name)
        assert issubclass(kind, GatedModel)
        assert kind.gates
    with pytest.raises(InputError, match="Balls is no GatedModel"):
        as_gated(made(Balls))


class Breathing(Gaussians3DModel):
    """Gaussians whose size changes with time by a parameter of which the inherited methods know nothing."""

    geometry = (*Gaussians3DModel.geometry, "breath")
    observes = ("time",)
    slice_geometry = GatedModel.slice_geometry

    def initial_geometry(self, points: Points, distances: Tensor, generator: torch.Generator) -> Raw:
        return super().initial_geometry(points, distances, generator) | {"breath": torch.ones(len(distances), 1)}

    def condition(self, raw: Raw, query: Any) -> Conditioned:
        calm = super().condition(raw, query)
        return calm._replace(factors=calm.factors * (1 + query.time * raw["breath"])[:, :, None])


class Checked(Breathing, gates=True):
    """The same, with the methods that know of it."""

    def static(self, raw: Raw) -> Conditioned:
        return Gaussians3DModel.condition(self, raw, None)


def test_gates_are_not_inherited() -> None:
    """Catches a model that is gated by its base's methods, which drop what it adds without a word."""
    with pytest.raises(InputError) as caught:
        as_gated(made(Breathing))
    assert str(caught.value) == (
        "effects.gate: expected a model that gates can simplify, Breathing inherits its methods for gates: see that "
        "they know all of its parameters, and write class Breathing(.., gates=True), or use effects.gate=off "
        "(docs/adding_a_model.md)"
    )
    assert without_direction(made(Breathing), []) is None
    assert as_gated(made(Checked)).gates
    with pytest.raises(InputError, match="More inherits"):
        as_gated(made(type("More", (Checked,), {})))


def test_a_model_that_lacks_a_method(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a TypeError of Python for a class that is not finished."""
    monkeypatch.setattr(registry, "_REGISTRY", registry._REGISTRY | {"half": Half})
    with pytest.raises(InputError, match="model 'half': expected all methods that a model needs, Half lacks frozen"):
        models.build("half")


def test_a_checkpoint_with_gates_of_a_model_without_them() -> None:
    """Catches a checkpoint that loads and then fails at its first image."""
    model = made(Gaussians3DModel)
    model.effect_sets = EffectSets(0, 0, torch.full((6,), 3, dtype=torch.int32), torch.zeros(6, dtype=torch.uint8))
    state = model.pack()
    made(Gaussians3DModel).load_state(dict(state))
    with pytest.raises(InputError, match=r"not of this model: expected effect_sets\.counts of shape none"):
        made(Balls).load_state(dict(state))
