"""Small models for the tests: every registered one and its variants, fresh or in the midst of a training."""

import inspect
import math
from typing import Any

import torch
from torch import Tensor, nn

from gsbench.models import CameraTime, GaussianModel, build, registry
from gsbench.models.base import SHRINK, Raw
from gsbench.models.effect_sets import EffectSets
from gsbench.models.gated import has_gates
from gsbench.models.gaussian_batch import Conditioned, Gaussians3D, Geometry
from gsbench.models.refinement import Changes, DeepRefinement
from gsbench.scenes.scene import Camera, Points
from gsbench.schedule import ActiveComponents

N = 24
EXTENT = 2.0
DIGITS = {"rtol": 0, "atol": 5.001e-9}  # of vectors of other programs, which have eight digits
CAMERA = torch.tensor([0.3, -0.2, -4.0], dtype=torch.float64)
MODELS: dict[str, dict[str, Any]] = {
    "3dgs": {},
    "4dgs": {"lambda_t": 0.5},
    "6dgs": {"lambda_d": 0.35, "directional_half": False},
    "7dgs": {"lambda_t": 0.5, "lambda_d": 0.3},
    "7dgs_nodir": {"lambda_t": 0.5},
}
CHOLESKY = ("6dgs", "7dgs", "7dgs_nodir")
DEEP = {"agr": True, "agr_depth": 4, "agr_width": 6, "agr_mean_octaves": 2}  # its last hidden layer reads the input
VARIANTS: dict[str, tuple[str, dict[str, Any]]] = {
    **{name: (name, options) for name, options in MODELS.items()},
    **{f"{name}_agr": (name, options | {"agr": True}) for name, options in MODELS.items()},
    **{f"{name}_deep_agr": (name, MODELS[name] | DEEP) for name in ("3dgs", "7dgs")},
    "4dgs_constant_colors": ("4dgs", {"time_degree": 0}),
    **{f"{name}_paper": (name, MODELS[name] | {"factor_order": "paper"}) for name in CHOLESKY},
    **{
        f"{name}_{form}": (name, MODELS[name] | {"off_diagonal": form})
        for name in CHOLESKY
        for form in ("raw", "row_scaled")
    },
}


def options_of(name: str) -> dict[str, inspect.Parameter]:
    """The options of a model's class and of its bases."""
    classes = [cls for cls in reversed(registry.find(name).__mro__) if issubclass(cls, GaussianModel)]
    parameters = [inspect.signature(cls.__init__, eval_str=True).parameters.values() for cls in classes]
    return {p.name: p for of_class in parameters for p in of_class if p.kind is p.KEYWORD_ONLY}


def halves(name: str) -> dict[str, float]:
    """Every option that is a number, such as lambda, at 0.5: a default of 1 hides that it is forgotten."""
    return {key: 0.5 for key, p in options_of(name).items() if p.annotation is float}


# Networks and paths small enough for a test.
NARROW: dict[str, dict[str, Any]] = {
    "ex4dgs": {"intervals": 2},
    "hexplane": {"channels": 3, "resolution": 5, "time_resolution": 4, "width": 6},
    "scgs": {"nodes": 8, "width": 6, "depth": 2},
}
# Every registered model is tested without being listed: EVERY has the variants above, and the others by their names.
assert registry.is_registered("3dgs")  # all are
NAMES = sorted(registry._REGISTRY)
EVERY = VARIANTS | {
    name + end: (name, halves(name) | NARROW.get(name, {}) | ({"agr": True} if end else {}))
    for name in NAMES
    for end in ("", "_agr")
    if name not in MODELS
}


def doubles(*numbers: Any) -> Tensor:
    return torch.tensor(numbers, dtype=torch.float64)


def row(*numbers: float) -> Tensor:
    return doubles(numbers)


def layer_of_the_vectors(number: int, rows: int, columns: int) -> tuple[Tensor, Tensor]:
    """The weights [rows, columns] and the bias [rows] that vectors of other programs have in a layer, by its number."""
    i, j = (torch.arange(n, dtype=torch.float64) for n in (rows, columns))
    weight = torch.sin(0.37 * number + 0.11 * i[:, None] + 0.23 * j) / math.sqrt(columns)
    return weight, 0.05 * torch.cos(number + 0.3 * i)


def seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def pinhole(width: int, height: int) -> Camera:
    """A camera at CAMERA that looks along z, in float64."""
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, 3] = -CAMERA
    K = torch.tensor([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]], dtype=torch.float64)
    return Camera(viewmat, K, width, height)


def started(model: GaussianModel, count: int = N, seed: int = 0) -> GaussianModel:
    """A model that was just built, with Gaussians at random points."""
    g = seeded(seed)
    model.initialise(Points(torch.rand(count, 3, generator=g) * 2 - 1, torch.rand(count, 3, generator=g)), EXTENT, g)
    return model


def last_layer(refinement: Changes) -> tuple[nn.Parameter, nn.Parameter]:
    """Weights and biases of the last layer of AGR or of a network in its place."""
    if isinstance(refinement, DeepRefinement):
        return refinement.head.weight, refinement.head.bias
    return refinement.weight_out, refinement.bias_out


def moved(model: GaussianModel, seed: int = 0) -> GaussianModel:
    """The model in float64 after a round, with every raw parameter moved and networks that say something."""
    model, g = model.double(), seeded(seed + 1)
    model.before_density(CAMERA[None], torch.ones(1, len(model), dtype=torch.bool))
    with torch.no_grad():
        for parameter in model.splats.values():
            parameter += 0.3 * torch.randn(parameter.shape, generator=g, dtype=torch.float64)
        if model.refinement is not None:
            for parameter in last_layer(model.refinement):
                parameter += 0.05 * torch.randn(parameter.shape, generator=g, dtype=torch.float64)
        for name, parameter in model.named_parameters():
            if name.partition(".")[0] not in ("splats", "refinement", "log_lambda"):  # of a field
                parameter += 0.05 * torch.randn(parameter.shape, generator=g, dtype=torch.float64)
    return model


def fresh(variant: str, count: int = N, seed: int = 0, **options: Any) -> GaussianModel:
    """A model as it starts, in float32."""
    name, of_variant = EVERY[variant]
    return started(build(name, **of_variant | options), count, seed)


def lively(variant: str, count: int = N, seed: int = 0, **options: Any) -> GaussianModel:
    """A model in the midst of a training, in float64."""
    return moved(fresh(variant, count, seed, **options), seed)


def active(variant: str, count: int = N, seed: int = 0, **options: Any) -> GaussianModel:
    """A model in the midst of a training, with everything switched on, in float64."""
    model = lively(variant, count, seed, **options)
    model.set_active(ActiveComponents(model.sh_degree, model.agr, True))
    return model


def with_effect_sets(model: GaussianModel, refined: int, conditioned: int) -> GaussianModel:
    """The model, of whose rows some are static, and have colours from one constant to more than there is."""
    if has_gates(model):
        orders = torch.randint(0, 16, (len(model),), generator=seeded(3), dtype=torch.int32)
        model.effect_sets = EffectSets(refined if model.agr else 0, conditioned, orders)
    return model


class Moments:
    """Moments of an optimizer that note the rows to follow, and which of them are fresh."""

    rows = fresh = torch.empty(0)

    def reindex(self, rows: Tensor, fresh: Tensor) -> None:
        self.rows, self.fresh = rows, fresh

    def forget(self, parameter: Tensor) -> None:
        raise AssertionError(parameter)


class Balls(GaussianModel):
    """Balls, as docs/adding_a_model.md has them, without gates."""

    geometry = ("radii",)

    def initial_geometry(self, points: Points, distances: Tensor, generator: torch.Generator) -> Raw:
        return {"radii": distances.log()[:, None]}

    def condition(self, raw: Raw, query: CameraTime | None) -> Conditioned:
        return Conditioned(raw["means"], raw["radii"].exp()[:, :, None] * torch.eye(3), torch.ones(len(raw["means"])))

    def spatial_scales(self) -> Tensor:
        return self.splats["radii"].exp()

    def split(self, raw: Raw, generator: torch.Generator) -> Raw:
        return {"means": raw["means"], "radii": raw["radii"] / SHRINK}


def raw(model: GaussianModel) -> dict[str, Tensor]:
    """The raw parameters, detached copies."""
    return {name: parameter.detach().clone() for name, parameter in model.splats.items()}


def covariances(gaussians: Conditioned | Geometry | Gaussians3D) -> Tensor:
    """The covariances of 3D Gaussians, [N, 3, 3]: equal Gaussians may have other factors."""
    return (gaussians.factors @ gaussians.factors.mT).detach()


def joint(model: GaussianModel) -> Tensor:
    """Covariance of each Gaussian of a Cholesky model, rows and columns ordered (p, d, t)."""
    factor = model.factors(raw(model))
    return factor @ factor.mT


def same(a: dict[str, Tensor], b: dict[str, Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(x, b[key]) and x.dtype == b[key].dtype for key, x in a.items())
