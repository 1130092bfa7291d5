"""Predict what every simplification of every Gaussian would cost, all of them at once, from a few renders.

A variant of a Gaussian (AGR baked in, time or direction frozen, fewer harmonics, removed) changes its slice in view v
by delta_v. With J the derivative of the image by slices, halfway between the model and the variant, and r the image
minus the truth, the squared error of all views grows by about

    E = sum over v of max(0, 2 <r, J delta_v>) + <g, J delta_v>^2,

with random signs g, for <g, x>^2 is |x|^2 on average. One product of r and one of g with J, backwards, have this for
every Gaussian. The linear term is cut at zero: what would improve the training views is not counted on.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gsbench.models import GaussianModel, Query
from gsbench.models.base import Gaussians3D, Raw
from gsbench.models.render import rasterize_slice
from gsbench.models.variants import REMOVED, Variant, variants_of
from gsbench.scenes import Camera, View


@dataclass(frozen=True)
class Strength:
    """What each variant of each Gaussian would add to the squared error of the training views."""

    variants: list[Variant]
    errors: dict[str, Tensor]  # [N] by the name of the variant, summed over pixels, channels and views
    total: float  # the squared error of the model as it is, in the same units


@torch.no_grad()
def probe(
    model: GaussianModel,
    views: Sequence[View],
    background: Tensor,
    *,
    seed: int = 0,
    most: int = 60,
    antialias: bool = False,
    by_halves: bool = True,
) -> Strength:
    """Predict the error of every variant of every Gaussian.

    Args:
        model: trained, or on its way.
        views: training views.
        background: colour [3].
        seed: of the random signs.
        most: this many views, evenly spaced, stand for more.
        antialias: see `gsbench.raster.rasterize`.
        by_halves: whether time or direction alone may be frozen.
    """
    looked_at = evenly_spaced(views, most)
    queries = [Query.of(view.camera, view.time) for view in looked_at]
    seen = [model.slice(query) for query in queries]
    variants = variants_of(model, queries, [one.opacities for one in seen], by_halves)
    errors = {variant.name: torch.zeros_like(seen[0].opacities) for variant in variants}
    random = torch.Generator().manual_seed(seed)
    total = 0.0
    for view, query, live in zip(looked_at, queries, seen, strict=True):
        image = rasterize_slice(live, view.camera, background, model.backend, antialias).image[0]
        residual = image - view.image
        total += float(residual.square().sum())
        signs = torch.randint(0, 2, residual.shape, generator=random).to(residual) * 2 - 1
        for at, group in _by_midpoint(model, variants, query, live):
            products = _products(at, view.camera, background, model, antialias, [residual, signs])
            for name, changed in group:
                first, second = (_dot(product, live, changed) for product in products)
                errors[name] += (2 * first).clamp(min=0) + second.square()
    if len(looked_at) < len(views):  # of a Gaussian in none of these views nothing is known, so nothing is taken
        unknown = errors[REMOVED] == 0
        errors = {name: torch.where(unknown, math.inf, error) for name, error in errors.items()}
    return Strength(variants, errors, total)


def evenly_spaced(views: Sequence[View], most: int) -> list[View]:
    """Choose at most `most` of the views, evenly spaced."""
    count = min(len(views), most)
    return [views[i * len(views) // count] for i in range(count)]


def _by_midpoint(
    model: GaussianModel, variants: list[Variant], query: Query, live: Gaussians3D
) -> Iterator[tuple[Gaussians3D, list[tuple[str, Gaussians3D]]]]:
    """Yield a place between model and variants, and the slices of the variants that share it.

    The image is linear in colours and in the opacity of each Gaussian, so the variants that change nothing else share
    the model's own place.
    """
    beside: list[tuple[str, Gaussians3D]] = []
    for variant in variants:
        if variant.raw is None:
            beside.append((variant.name, live._replace(opacities=torch.zeros_like(live.opacities))))
        elif variant.level is not None:
            colors = model.paint(_merged(model, variant.raw), live.means, live.opacities, query)
            beside.append((variant.name, live._replace(colors=colors)))
        else:
            raw = _merged(model, variant.raw)
            means, factors, opacities = model.observe(raw, query)
            changed = Gaussians3D(means, factors, opacities, model.paint(raw, means, live.opacities, query))
            yield Gaussians3D(*((a + b) / 2 for a, b in zip(live, changed, strict=True))), [(variant.name, changed)]
    yield live, beside


def _merged(model: GaussianModel, raw: Raw) -> Raw:
    return dict(model.splats.items()) | raw


@torch.enable_grad()
def _products(
    at: Gaussians3D, camera: Camera, background: Tensor, model: GaussianModel, antialias: bool, vectors: list[Tensor]
) -> list[Gaussians3D]:
    """Multiply vectors [H, W, 3] by the derivative of the image by the slice at a place, from the left."""
    place = Gaussians3D(*(x.detach().requires_grad_() for x in at))
    image = rasterize_slice(place, camera, background, model.backend, antialias).image[0]
    last = len(vectors) - 1
    return [Gaussians3D(*torch.autograd.grad(image, place, vector, retain_graph=i < last))
            for i, vector in enumerate(vectors)]  # fmt: skip


def _dot(product: Gaussians3D, live: Gaussians3D, changed: Gaussians3D) -> Tensor:
    """Compute <product, changed - live> of each Gaussian, [N]."""
    parts = [(p * (b - a)).flatten(1).sum(1) if p.dim() > 1 else p * (b - a)
             for p, a, b in zip(product, live, changed, strict=True)]  # fmt: skip
    return torch.stack(parts).sum(0)
