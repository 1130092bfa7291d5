"""Predict the error of every simplification of every Gaussian, all at once, from a few renders.

A simplification of a Gaussian (AGR baked in, time or direction frozen, fewer harmonics, removed) changes its slice in
view v by delta_v, and the image by x_v. With r the image minus the truth, the squared error of all views grows by

    E = sum over v of max(0, 2 <r, x_v>) + <g, x_v>^2,

with random signs g, because <g, x>^2 is |x|^2 on average. The maximum ignores improvements of the training
views. Products of r and g with J, the derivative of the image by slices, have <r, x> and <g, x> for all Gaussians at
once:

- The image is linear in a Gaussian's colour and in its opacity, so x = J delta for fewer harmonics and for a removal.
- If a simplification moves a Gaussian by less than its size, x = (J + J') delta / 2, with J' at the simplification. To
  compute J' the simplified Gaussians are rendered beside the model's own, so thin that they do not hide each other.
  What the own Gaussian hides of its simplification is added.
- If it moves the Gaussian farther, |x|^2 is the sum of the squares at both places.

Two equal Gaussians that are d standard deviations apart overlap by exp(-d^2 / 4). This is the weight of the second
case, and the rest is that of the third.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from gsbench.kernels.tape import Tape
from gsbench.measure.quality import evenly
from gsbench.models import GaussianModel, Query
from gsbench.models.base import Gaussians3D, tensors_of
from gsbench.models.gated import GatedModel
from gsbench.models.render import rasterize_slice
from gsbench.models.simplifications import REMOVED, Simplification, simplifications_of
from gsbench.process.workers import side_by_side
from gsbench.scenes import Camera, View

MOST_VIEWS = 60  # evenly spaced ones stand for more
THIN = 0.02  # the opacity of Gaussians that are tried out beside the others
# The share of a thin Gaussian's motion that an opaque one in its place hides or outshines: the root of the integral of
# r^2 g^2 (1 - g)^2 over that of r^2 g^2 is 0.6 for g = exp(-r^2 / 2).
HIDDEN = 0.4
OPACITY, COLOR = 12, slice(13, 16)  # columns of `_rows_of`


@dataclass(frozen=True)
class Sensitivity:
    """What each simplification of each Gaussian would add to the squared error of the training views."""

    simplifications: list[Simplification]
    errors: dict[str, Tensor]  # [N] by the name of the simplification, summed over pixels, channels and views
    total: float  # the squared error of the model as it is, in the same units


@torch.no_grad()
def probe(
    model: GatedModel,
    views: Sequence[View],
    background: Tensor,
    *,
    seed: int = 0,
    most: int = MOST_VIEWS,
    draws: int = 1,
    antialias: bool = False,
    by_halves: bool = True,
    hidden: Tensor | None = None,  # [N] bool
) -> Sensitivity:
    """Predict the error of every simplification of every Gaussian.

    Args:
        model: the model, trained or in training.
        views: training views.
        background: background colour [3].
        seed: seed of the random signs g.
        most: the largest number of views that are used, evenly spaced.
        draws: random g for each view; one draw says little about a Gaussian that few views show.
        antialias: see `gsbench.raster.rasterize`.
        by_halves: whether time alone or direction alone may be frozen, not only both.
        hidden: mask of Gaussians that no view shows.
    """
    looked_at = evenly(views, most)
    queries = [Query.of(view.camera, view.time) for view in looked_at]
    workers = model.backend.workers(model.splats["means"])
    seen = list(side_by_side(model.slice, queries, workers))
    simplifications = simplifications_of(model, queries, seen, by_halves)
    random = torch.Generator().manual_seed(seed)
    seeds = torch.randint(2**62, (len(looked_at),), generator=random).tolist()

    def errors_in(v: int) -> tuple[float, list[Tensor]]:
        """Return the squared error of a view's image, and what each simplification would add to this error."""
        view = looked_at[v]
        drawing = ViewRasterizer(model, view.camera, background, antialias)
        here = drawing(seen[v])
        residual = here.image - view.image
        own = torch.Generator().manual_seed(seeds[v])
        signs = [torch.randint(0, 2, residual.shape, generator=own).to(residual) * 2 - 1 for _ in range(draws)]
        vectors = [residual, *signs]
        products = here.products(vectors)
        removed = -products[..., OPACITY] * seen[v].opacities
        place = Place(model, queries[v], seen[v], _rows_of(seen[v]), here, products, vectors, removed)
        return float(residual.square().sum()), [_error(one, place, drawing) for one in simplifications]

    errors, total = {one.name: torch.zeros_like(seen[0].opacities) for one in simplifications}, 0.0
    for squared, added in side_by_side(errors_in, range(len(looked_at)), workers):
        total += squared
        for simplification, error in zip(simplifications, added, strict=True):
            errors[simplification.name] += error
    if len(looked_at) < len(views):  # of a Gaussian in none of these views nothing is known, so nothing is taken
        unknown = (errors[REMOVED] == 0) if hidden is None else (errors[REMOVED] == 0) & ~hidden
        errors = {name: torch.where(unknown, math.inf, error) for name, error in errors.items()}
    return Sensitivity(simplifications, errors, total)


class Drawn(NamedTuple):
    """The image of a model at one view, with the derivative by the Gaussians."""

    at: Gaussians3D
    tape: Tape  # how
    images: Tensor  # [1, H, W, 3]
    means2d: Tensor  # [N, 2] pixels
    radii: Tensor  # [N] pixels, three standard deviations; 0 where it is culled

    @property
    def image(self) -> Tensor:
        """Return the image [H, W, 3]."""
        return self.images[0].detach()

    def products(self, vectors: list[Tensor]) -> Tensor:
        """Return the gradients [K, N, 16], by the Gaussians' rows, of the image's scalar products with K `vectors`."""
        found = []
        for vector in vectors:
            sums: dict[int, Tensor] = {}
            self.tape.backward(self.images, vector[None], tensors_of(self.at), sums)
            found.append(_rows_of(Gaussians3D(*(sums[id(x)] for x in tensors_of(self.at)))))
        return torch.stack(found)


class ViewRasterizer(NamedTuple):
    """The rasterizer of one view."""

    model: GaussianModel
    camera: Camera
    background: Tensor
    antialias: bool

    @torch.enable_grad()
    def __call__(self, gaussians: Gaussians3D) -> Drawn:
        """Rasterize the 3D Gaussians of the view."""
        at = Gaussians3D(*(x.detach().requires_grad_() for x in tensors_of(gaussians)))
        with Tape() as tape:
            output = rasterize_slice(at, self.camera, self.background, self.model.backend, self.antialias)
        return Drawn(at, tape, output.image, output.info.means2d[0].detach(), output.info.radii[0])


class Place(NamedTuple):
    """A model at one view, with the camera and time of the view."""

    model: GaussianModel
    query: Query
    live: Gaussians3D
    rows: Tensor  # [N, 16], of `live`
    drawn: Drawn
    products: Tensor  # [K, N, 16] of `vectors` with the derivative of the image
    vectors: list[Tensor]  # K of [H, W, 3]: the residual, then random signs
    removed: Tensor  # [K, N] what each Gaussian's removal changes, times each of the vectors


def _error(simplification: Simplification, here: Place, draw: ViewRasterizer) -> Tensor:
    """Compute the error E [N] that a simplification of each Gaussian adds in one view (formula in the module)."""
    model, live = here.model, here.live
    if simplification.raw is None:
        return _grown(here.removed)
    raw = dict(model.splats.items()) | simplification.raw
    if simplification.order is not None:
        colors = model.shade(raw, live.means, live.opacities, here.query)
        return _grown((here.products[..., COLOR] * (colors - live.colors)).sum(-1))
    whole = model.colored(model.slice_geometry(raw, here.query), raw, here.query)
    N, n = len(live.means), simplification.rows
    changed = Gaussians3D(*(x[:n] for x in tensors_of(whole)))
    thin = changed._replace(opacities=changed.opacities.clamp(max=THIN))
    pairs = zip(tensors_of(live), tensors_of(thin), strict=True)
    both = draw(Gaussians3D(*(torch.cat(pair) for pair in pairs)))
    size = torch.maximum(here.drawn.radii[:n], both.radii[N:]).clamp(min=1) / 3
    distance = (both.means2d[N:] - here.drawn.means2d[:n]) / (2 * size[:, None])
    overlap = torch.exp(-distance.square().sum(-1))
    shown = 1 - HIDDEN * live.opacities[:n] * overlap
    scale = changed.opacities / (thin.opacities.clamp(min=1e-12) * shown)  # an image is linear in an opacity
    thin_products = both.products(here.vectors)[:, N:]
    there = thin_products * scale[:, None]
    there[..., OPACITY] = thin_products[..., OPACITY] / shown
    along = ((here.products[:, :n] + there) * (_rows_of(changed) - here.rows[:n])).sum(-1) / 2
    added = there[..., OPACITY] * changed.opacities
    error = overlap * _grown(along) + (1 - overlap) * _grown(here.removed[:, :n], added)
    return F.pad(error, (0, N - n))


def _rows_of(gaussians: Gaussians3D) -> Tensor:
    """Put the mean, the factor, the opacity and the colour of each Gaussian in a row, [N, 16]; then its shape."""
    return torch.cat([x[:, None].flatten(1) for x in tensors_of(gaussians)], 1)


def _grown(*changes: Tensor) -> Tensor:
    """Compute max(0, 2 <r, x>) + |x|^2 [N] of changes x that do not overlap, [K, N] each: <r, x>, then some <g, x>."""
    products = torch.stack(changes)
    return (2 * products[:, 0].sum(0)).clamp(min=0) + products[:, 1:].square().mean(1).sum(0)
