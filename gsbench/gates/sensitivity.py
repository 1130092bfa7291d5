"""Predict how much the squared error of the images grows if a Gaussian is simplified, for all Gaussians at once.

A simplified Gaussian is independent of time, direction or AGR (the neural refinement), has a lower SH degree, or is
removed. This changes the image of view v by x_v. Let r_v be the present image less the true one. The predicted error is

    E = sum over v of max(0, 2 <r_v, x_v>) + <g_v, x_v>^2,

where g_v has random signs, so that <g, x>^2 is |x|^2 on average. The maximum ignores improvements on training views.
One backward pass with r and one with g give the scalar products of all Gaussians. Let J be the derivative of the image
with respect to the parameters of a sliced Gaussian, and delta the change of these parameters.

- An image is linear in colour and opacity, so x = J delta for a lower SH degree and for a removal.
- If a Gaussian moves by less than its size, x = (J + J') delta / 2, where J' is the derivative at the simplified
  Gaussian. For J', the simplified Gaussians are rendered together with the present ones, with small opacities.
- If a Gaussian moves farther, the image changes at the old and at the new position, and the squares of the two changes
  are added.

The last two cases are mixed with the weights w and 1 - w. Here w = exp(-d^2 / 4) is the overlap of two equal Gaussians
at a distance of d standard deviations.
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
from gsbench.models import CameraTime, GaussianModel
from gsbench.models.gated import GatedModel
from gsbench.models.gaussian_batch import Gaussians3D, tensors_of
from gsbench.models.render import rasterize_slice
from gsbench.models.simplifications import REMOVED, Simplification, simplifications_of
from gsbench.process.workers import side_by_side
from gsbench.scenes import Camera, View

MOST_VIEWS = 60  # largest number of views; of more views, evenly spaced ones are used
THIN = 0.02  # largest opacity of the simplified Gaussians that are rendered together with the present ones
# The share of a transparent Gaussian's change that an opaque Gaussian at the same position hides. The root of the
# integral of r^2 g^2 (1 - g)^2 over that of r^2 g^2 is 0.6 = 1 - HIDDEN for g = exp(-r^2 / 2).
HIDDEN = 0.4
OPACITY, COLOR = 12, slice(13, 16)  # columns of `_rows_of`


@dataclass(frozen=True)
class Sensitivity:
    """Hold the predicted growth of the images' squared error if a Gaussian is simplified, for each Gaussian.

    A simplified Gaussian is independent of time, direction or AGR (the neural refinement), has a lower SH degree, or is
    removed.
    """

    simplifications: list[Simplification]
    errors: dict[str, Tensor]  # for each simplification by name: [N], summed over pixels, channels and views
    total: float  # the present squared error of the model, in the same units


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
    """Predict how much the squared error of training views grows if a Gaussian is simplified, for each Gaussian.

    A simplified Gaussian is independent of time, direction or AGR (the neural refinement), has a lower SH degree, or is
    removed.

    Args:
        model: the model, trained or in training.
        views: the training views.
        background: the background colour, [3].
        seed: the seed of the random images g, which have the values 1 and -1.
        most: the largest number of views that are used, evenly spaced.
        draws: the number of random images g for each view; more draws reduce the variance.
        antialias: whether to scale opacities by the 2D filter of Mip-Splatting, as in `gsbench.raster.rasterize`.
        by_halves: whether to include Gaussians that are independent of only one of time and direction.
        hidden: which Gaussians no training view shows.
    """
    looked_at = evenly(views, most)
    queries = [CameraTime.of(view.camera, view.time) for view in looked_at]
    workers = model.backend.workers(model.splats["means"])
    seen = list(side_by_side(model.slice, queries, workers))
    simplifications = simplifications_of(model, queries, seen, by_halves)
    random = torch.Generator().manual_seed(seed)
    seeds = torch.randint(2**62, (len(looked_at),), generator=random).tolist()

    def errors_in(v: int) -> tuple[float, list[Tensor]]:
        """Return the squared error of view `v`, and its growth by each simplification of each Gaussian."""
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
    if len(looked_at) < len(views):  # a Gaussian that none of these views shows must not be simplified
        unknown = (errors[REMOVED] == 0) if hidden is None else (errors[REMOVED] == 0) & ~hidden
        errors = {name: torch.where(unknown, math.inf, error) for name, error in errors.items()}
    return Sensitivity(simplifications, errors, total)


class Drawn(NamedTuple):
    """Hold a rendered image, its 3D Gaussians, and the recorded kernel calls (tape) for backward passes."""

    at: Gaussians3D  # the 3D Gaussians
    tape: Tape  # the operations of the rendering, for the backward pass
    images: Tensor  # [1, H, W, 3]
    means2d: Tensor  # [N, 2] pixels
    radii: Tensor  # [N] pixels, three standard deviations; 0 for a culled Gaussian

    @property
    def image(self) -> Tensor:
        """The rendered image [H, W, 3], without a gradient."""
        return self.images[0].detach()

    def products(self, vectors: list[Tensor]) -> Tensor:
        """Return gradients of K products <image, vector> with respect to the Gaussians, [K, N, 16].

        The 16 numbers of a Gaussian are mean, covariance factor, opacity and colour.
        """
        found = []
        for vector in vectors:
            sums: dict[int, Tensor] = {}
            self.tape.backward(self.images, vector[None], tensors_of(self.at), sums)
            found.append(_rows_of(Gaussians3D(*(sums[id(x)] for x in tensors_of(self.at)))))
        return torch.stack(found)


class ViewRasterizer(NamedTuple):
    """Rasterize 3D Gaussians for one camera, and record the kernel calls for backward passes."""

    model: GaussianModel
    camera: Camera
    background: Tensor
    antialias: bool

    @torch.enable_grad()
    def __call__(self, gaussians: Gaussians3D) -> Drawn:
        """Rasterize 3D Gaussians for the camera; return the image and the recorded kernel calls for backward passes."""
        at = Gaussians3D(*(x.detach().requires_grad_() for x in tensors_of(gaussians)))
        with Tape() as tape:
            output = rasterize_slice(at, self.camera, self.background, self.model.backend, self.antialias)
        return Drawn(at, tape, output.image, output.info.means2d[0].detach(), output.info.radii[0])


class Place(NamedTuple):
    """Hold a model's 3D Gaussians in one view, their image, and the derivatives from which errors are predicted."""

    model: GaussianModel
    query: CameraTime
    live: Gaussians3D  # the present slice
    rows: Tensor  # [N, 16], `live` as one matrix
    drawn: Drawn  # the image of `live`
    products: Tensor  # [K, N, 16] gradients of <image, vector>
    vectors: list[Tensor]  # K images [H, W, 3]: the residual r, then random signs g
    removed: Tensor  # [K, N] <x, vector> for the change x of the image by the removal of a Gaussian


def _error(simplification: Simplification, here: Place, draw: ViewRasterizer) -> Tensor:
    """Predict how much the squared error of one view grows if a Gaussian is simplified, for each Gaussian, [N].

    Args:
        simplification: the parameters of the simplified Gaussians.
        here: the present 3D Gaussians and image of the view.
        draw: the rasterizer of the view.
    """
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
    scale = changed.opacities / (thin.opacities.clamp(min=1e-12) * shown)  # the image is linear in each opacity
    thin_products = both.products(here.vectors)[:, N:]
    there = thin_products * scale[:, None]
    there[..., OPACITY] = thin_products[..., OPACITY] / shown
    along = ((here.products[:, :n] + there) * (_rows_of(changed) - here.rows[:n])).sum(-1) / 2
    added = there[..., OPACITY] * changed.opacities
    error = overlap * _grown(along) + (1 - overlap) * _grown(here.removed[:, :n], added)
    return F.pad(error, (0, N - n))


def _rows_of(gaussians: Gaussians3D) -> Tensor:
    """Concatenate mean, covariance factor, opacity and colour of each Gaussian to a matrix [N, 16]."""
    return torch.cat([x[:, None].flatten(1) for x in tensors_of(gaussians)], 1)


def _grown(*changes: Tensor) -> Tensor:
    """Compute the growth of the squared error, max(0, 2 <r, x>) + |x|^2, [N].

    The change x of the image is a sum of changes that do not overlap. There is one argument [K, N] for each of these
    changes: the scalar products of the change with the residual r, and with K - 1 images of random signs g, which
    estimate |x|^2.
    """
    products = torch.stack(changes)
    return (2 * products[:, 0].sum(0)).clamp(min=0) + products[:, 1:].square().mean(1).sum(0)
