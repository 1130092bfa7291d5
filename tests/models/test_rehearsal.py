"""A mistake in the code of a model is named before a training begins."""

import math
from typing import Any

import pytest
import torch
from models.small import EVERY
from torch import Tensor

from gsbench.errors import InputError
from gsbench.models import build, registry
from gsbench.models.base import SHRINK, GaussianModel
from gsbench.models.gated import GatedModel
from gsbench.models.gaussian_batch import Conditioned
from gsbench.models.rehearsal import rehearse


class Balls(GatedModel, gates=True):
    """Round Gaussians, as in docs/adding_a_model.md."""

    geometry = ("radii",)

    def initial_geometry(self, points: Any, distances: Tensor, generator: torch.Generator) -> Any:
        return {"radii": distances.log()[:, None]}

    def condition(self, raw: Any, query: Any) -> Any:
        return Conditioned(raw["means"], factors(raw), torch.ones_like(raw["opacities"]))

    def spatial_scales(self) -> Tensor:
        return self.splats["radii"].exp()

    def split(self, raw: Any, generator: torch.Generator) -> Any:
        return {"radii": raw["radii"] - math.log(SHRINK)}

    def static(self, raw: Any) -> Any:
        return self.condition(raw, None)

    def frozen(self, raw: Any, queries: Any, weights: Tensor) -> Any:
        return {}


def factors(raw: Any) -> Tensor:
    return raw["radii"].exp()[:, :, None] * torch.eye(3)


def grown(raw: Any) -> Tensor:
    raw["radii"].data += 0.1
    return factors(raw)


def sliced(**fields: Any) -> dict[str, Any]:
    """A `condition` of which some fields are those that these functions return."""
    return {
        "condition": lambda self, raw, query: Balls.condition(self, raw, query)._replace(
            **{name: value(raw) for name, value in fields.items()}
        )
    }


@pytest.mark.parametrize("variant", EVERY)
def test_no_mistake_is_seen_in_a_right_model(variant):
    """Catches a check that a model of gsbench does not pass."""
    name, options = EVERY[variant]
    rehearse(build(name, **options), name)


@pytest.mark.parametrize(
    ("members", "message"),
    [
        ({"geometry": ("radius",)}, "initial_geometry: expected all parameters of .*, radius is missing"),
        ({"centers": ("means", "times")}, "initial_geometry: .*, times is missing"),
        ({"initial_geometry": lambda *_: torch.ones(4, 1)}, "initial_geometry: .* by name, got a Tensor"),
        ({"initial_geometry": lambda *_: {"radii": 3}}, "initial_geometry: expected a tensor radii, got 3"),
        ({"initial_geometry": lambda *_: {"radii": torch.ones(3, 1)}}, r"radii with 4 rows, .*, got \[3, 1\]"),
        ({"initial_geometry": lambda *_: {"radii": torch.full((4, 1), -math.inf)}}, "expected finite radii, got .-inf"),
        ({"spatial_scales": lambda _: None}, "spatial_scales: AttributeError"),
        ({"spatial_scales": lambda self: self.splats["radii"][:, 0]}, r"spatial_scales: .* \[4, 1\], got \[4\]"),
        ({"condition": lambda _, raw, __: (raw["means"], factors(raw))}, "a Conditioned, got a tuple"),
        ({"condition": lambda *_: 1 / 0}, r"condition: test_rehearsal.py, line \d+: ZeroDivisionError"),
        (sliced(factors=lambda raw: factors(raw)[:, :1]), r"condition: expected factors of shape .*, got \[4, 1, 3\]"),
        (sliced(means=lambda raw: raw["means"].double()), "expected means of torch.float32, got torch.float64"),
        (sliced(means=lambda raw: raw["means"] / 0), "expected finite means, got"),
        (sliced(opacity_factor=lambda raw: 2 + 0 * raw["opacities"]), "opacity_factor from 0 to 1, got 2 to 2"),
        (sliced(means=lambda raw: raw["means"] + torch.rand(1)), "expected the same means for the same query"),
        (sliced(factors=grown), "expected the same factors for the same query"),
        (sliced(factors=lambda raw: factors(raw).detach()), "expected a gradient of each of .*, radii has none"),
        ({"shade": lambda *_: 1 / 0}, "slice: test_rehearsal.py, line"),
        ({"split": lambda *_: {"radiii": torch.ones(4, 1)}}, "split: expected raw parameters, got 'radiii'"),
        ({"split": lambda *_: {"radii": torch.ones(2, 1)}}, r"split: expected radii with 4 rows, .*, got \[2, 1\]"),
        ({"split": lambda *_: {"radii": torch.ones(4, 3)}}, r"split: expected radii of shape \[4, 1\], got \[4, 3\]"),
        ({"static": lambda _, raw: raw}, "static: expected a Conditioned, got a dict"),
        ({"frozen": lambda *_: {"static": {}}}, r"frozen: .* of \[\], got \['static'\]"),
        ({"observes": ("time",)}, r"frozen: expected static, and .*, 'time'\], got \[\]"),
        ({"observes": ("time",), "frozen": lambda *_: {"static": {"times": torch.ones(4)}}}, "frozen: .* got 'times'"),
    ],
)
def test_a_mistake_is_named(members, message):
    """Catches a mistake that ends a training in its midst, or that makes its result another model's, in silence."""
    model = type("Mine", (Balls,), {"__module__": __name__} | members, gates=True)()
    with pytest.raises(InputError, match=f"^model 'mine': .*{message}"):
        rehearse(model, "mine")


@pytest.mark.parametrize(
    ("base", "members", "message"),
    [
        (object, {}, "expected a subclass of GaussianModel"),
        (Balls, {"geometry": "radii"}, "geometry: expected a tuple of names, got 'radii'"),
        (GaussianModel, {}, "geometry: expected a tuple of names, got None"),
        (Balls, {"observes": "time"}, "observes: expected a tuple of names, got 'time'"),
        (Balls, {"observes": ("tme",)}, "observes: 'tme' is not known. Did you mean 'time'"),
    ],
)
def test_a_class_that_is_no_model_is_not_registered(base, members, message):
    """Catches a typing error by which a model would not get the time, or AGR not change what it should."""
    with pytest.raises(InputError, match=f"model 'mine': {message}"):
        registry.register("mine")(type("Mine", (base,), members))
    assert not registry.is_registered("mine")
