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

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from gsbench.kernels.headers import ALPHA_MIN
from gsbench.kernels.tape import Tape
from gsbench.measure.quality import evenly
from gsbench.models import CameraTime, GaussianModel
from gsbench.models.gated import GatedModel
from gsbench.models.gaussian_batch import Gaussians3D, tensors_of
from gsbench.models.render import rasterize_slice
from gsbench.models.simplifications import REMOVED, Simplification, simplifications_of
from gsbench.process.workers import side_by_side
from gsbench.scenes import View

MOST_VIEWS = 60  # largest number of views; of more views, evenly spaced ones are used
THIN = 0.02  # largest opacity of the simplified Gaussians that are rendered together with the present ones
# The share of a transparent Gaussian's change that an opaque Gaussian at the same position hides. The root of the
# integral of r^2 g^2 (1 - g)^2 over that of r^2 g^2 is 0.6 = 1 - HIDDEN for g = exp(-r^2 / 2).
HIDDEN = 0.4
OPACITY, COLOR = 12, slice(13, 16)  # columns of `_matrix_of`


@dataclass(frozen=True)
class Sensitivity:
    """The predicted growth of the images' squared error if a Gaussian is simplified, for each Gaussian."""

    simplifications: list[Simplification]
    errors: dict[str, Tensor]  # for each simplification by name: [N], summed over pixels, channels and views
    total: float  # the present squared error of the model, in the same units


@torch.no_grad()
def probe(
    model: GatedModel,
    views: Sequence[View],
    background: Tensor,  # [3]
    *,
    seed: int = 0,
    most: int = MOST_VIEWS,
    draws: int = 1,
    antialias: bool = False,
    hidden: Tensor | None = None,  # [N] bool
) -> Sensitivity:
    """Predict how much the squared error of training views grows if a Gaussian is simplified, for each Gaussian.

    Args:
        model: the model, trained or in training.
        views: the training views.
        background: the background colour.
        seed: the seed of the random images g, which have the values 1 and -1.
        most: the largest number of views that are used, evenly spaced.
        draws: the number of random images g for each view; more draws reduce the variance.
        antialias: whether to scale opacities by the 2D filter of Mip-Splatting, as in `gsbench.raster.rasterize`.
        hidden: which Gaussians no training view shows.
    """
    used = evenly(views, most)
    queries = [CameraTime.of(view.camera, view.time) for view in used]
    workers = model.backend.workers(model.splats["means"])
    slices = list(side_by_side(model.slice, queries, workers))
    simplifications = simplifications_of(model, queries, slices)
    random = torch.Generator().manual_seed(seed)
    seeds = torch.randint(2**62, (len(used),), generator=random).tolist()

    def errors_in(v: int) -> tuple[float, list[Tensor]]:
        """Return the squared error of view `v`, and its growth by each simplification of each Gaussian."""
        probed = ProbedView(model, used[v], queries[v], slices[v], background, antialias, draws, seeds[v])
        return probed.squared_error, [probed.growth(simplification) for simplification in simplifications]

    errors, total = {way.name: torch.zeros_like(slices[0].opacities) for way in simplifications}, 0.0
    for squared, added in side_by_side(errors_in, range(len(used)), workers):
        total += squared
        for simplification, error in zip(simplifications, added, strict=True):
            errors[simplification.name] += error
    if len(used) < len(views):  # a Gaussian that none of these views shows must not be simplified
        unknown = (errors[REMOVED] == 0) if hidden is None else (errors[REMOVED] == 0) & ~hidden
        errors = {name: torch.where(unknown, math.inf, error) for name, error in errors.items()}
    return Sensitivity(simplifications, errors, total)


class Drawn(NamedTuple):
    """A rendered image, its 3D Gaussians, and the recorded kernel calls for backward passes."""

    at: Gaussians3D
    tape: Tape
    images: Tensor  # [1, H, W, 3]
    means2d: Tensor  # [N, 2] pixels
    radii: Tensor  # [N] pixels, three standard deviations; 0 for a culled Gaussian

    def products(self, vectors: list[Tensor]) -> Tensor:  # [K, N, 16]
        """Return gradients of K products <image, vector> with respect to the Gaussians, as in `_matrix_of`."""
        rows = []
        for vector in vectors:
            sums: dict[int, Tensor] = {}
            self.tape.backward(self.images, vector[None], tensors_of(self.at), sums)
            rows.append(_matrix_of(Gaussians3D(*(sums[id(x)] for x in tensors_of(self.at)))))
        return torch.stack(rows)


class ProbedView:
    """A view, its image by the present model, and the derivatives from which errors are predicted."""

    def __init__(
        self,
        model: GaussianModel,
        view: View,
        query: CameraTime,
        live: Gaussians3D,
        background: Tensor,
        antialias: bool,
        draws: int,
        seed: int,
    ) -> None:
        """Draw the present Gaussians `live` of a view, and compute their scalar products; see `probe`."""
        self.model, self.query, self.live = model, query, live
        self.camera, self.background, self.antialias = view.camera, background, antialias
        self.matrix, self.drawn = _matrix_of(live), self._draw(live)
        residual = self.drawn.images[0].detach() - view.image
        random = torch.Generator().manual_seed(seed)
        signs = [torch.randint(0, 2, residual.shape, generator=random).to(residual) * 2 - 1 for _ in range(draws)]
        self.vectors = [residual, *signs]  # K images [H, W, 3]: the residual r, then random signs g
        self.products = self.drawn.products(self.vectors)
        self.removed = -self.products[..., OPACITY] * live.opacities  # [K, N] <x, vector> of a removal
        self.squared_error = float(residual.square().sum())

    @torch.enable_grad()
    def _draw(self, gaussians: Gaussians3D) -> Drawn:
        at = Gaussians3D(*(x.detach().requires_grad_() for x in tensors_of(gaussians)))
        with Tape() as tape:
            output = rasterize_slice(at, self.camera, self.background, self.model.backend, self.antialias)
        return Drawn(at, tape, output.image, output.info.means2d[0].detach(), output.info.radii[0])

    def growth(self, simplification: Simplification) -> Tensor:
        """Predict how much the squared error of the view grows if a Gaussian is simplified, for each Gaussian, [N].

        The first lines of this module have the formulas for colours, removals and motions.
        """
        model, live = self.model, self.live
        if simplification.raw is None:  # removed
            return _growth_of(self.removed)
        raw = dict(model.splats.items()) | simplification.raw
        if simplification.order is not None:  # only the colour changes
            colors = model.shade(raw, live.means, live.opacities, self.query)
            return _growth_of((self.products[..., COLOR] * (colors - live.colors)).sum(-1))
        simplified = model.colored(model.slice_geometry(raw, self.query), raw, self.query)
        changed = Gaussians3D(*(x[: simplification.rows] for x in tensors_of(simplified)))  # others stay the same
        return F.pad(self._growth_of_motion(changed), (0, len(live.means) - simplification.rows))

    def _growth_of_motion(self, changed: Gaussians3D) -> Tensor:
        """Predict the growth for the first n Gaussians, [n], if each becomes the one in `changed`, near or far."""
        live, N, n = self.live, len(self.live.means), len(changed.means)
        thin = changed._replace(opacities=changed.opacities.clamp(max=THIN))
        pairs = zip(tensors_of(live), tensors_of(thin), strict=True)
        both = self._draw(Gaussians3D(*(torch.cat(pair) for pair in pairs)))
        size = torch.maximum(self.drawn.radii[:n], both.radii[N:]).clamp(min=1) / 3  # pixels; not drawn: radius 0
        half_offset = (both.means2d[N:] - self.drawn.means2d[:n]) / (2 * size[:, None])  # [n, 2] d / 2
        overlap = torch.exp(-half_offset.square().sum(-1))
        shown = 1 - HIDDEN * live.opacities[:n] * overlap
        scale = changed.opacities / (thin.opacities.clamp(min=1e-12) * shown)  # the image is linear in each opacity
        thin_products = both.products(self.vectors)[:, N:]
        products = thin_products * scale[:, None]  # as if `changed` was in the image, instead of `thin`
        # A derivative by an opacity does not grow with this opacity.
        products[..., OPACITY] = thin_products[..., OPACITY] / shown
        # <x, vector>, [K, n]: x = (J + J') delta / 2 if the Gaussian is near; if it is far, what appears there
        moved = ((self.products[:, :n] + products) * (_matrix_of(changed) - self.matrix[:n])).sum(-1) / 2
        added = products[..., OPACITY] * changed.opacities
        return overlap * _growth_of(moved) + (1 - overlap) * _growth_of(self.removed[:, :n], added)


def _matrix_of(gaussians: Gaussians3D) -> Tensor:
    """Concatenate mean, covariance factor, opacity and colour of each Gaussian to a matrix [N, 16]."""
    return torch.cat([x[:, None].flatten(1) for x in tensors_of(gaussians)], 1)


def _growth_of(*changes: Tensor) -> Tensor:
    """Compute the growth of the squared error, max(0, 2 <r, x>) + |x|^2, [N].

    The change x of the image is a sum of changes that do not overlap. Each argument [K, N] has the scalar products of
    such a change with the residual r, and with K - 1 images of random signs g, which estimate |x|^2.
    """
    products = torch.stack(changes)
    return (2 * products[:, 0].sum(0)).clamp(min=0) + products[:, 1:].square().mean(1).sum(0)


@torch.no_grad()
def visible_times(model: GaussianModel, views: Sequence[View]) -> Tensor:  # [N, 2]
    """Return the first and the last time at which each Gaussian is visible in a training view, in [0, 1].

    A Gaussian is visible in a view if its opacity at this time and direction is at least 1/255, with or without AGR.
    The interval is extended on both sides by the largest gap between the times of neighbouring views, as no view shows
    when in this gap a Gaussian appears. It is (inf, -inf) for a Gaussian that is never visible.
    """
    unrefined = dict(model.splats.items())

    def shown(view: View) -> Tensor:
        """Return which Gaussians are visible in a view, [N] bool."""
        query = CameraTime.of(view.camera, view.time)
        opacities = model.slice_geometry(model.refined(query), query).opacities
        if model.refines:
            opacities = torch.maximum(opacities, model.slice_geometry(unrefined, query).opacities)
        return opacities >= ALPHA_MIN

    times = [view.time or 0.0 for view in views]
    gap = max((later - earlier for earlier, later in itertools.pairwise(sorted(times))), default=0.0)
    first = torch.full_like(model.splats["opacities"], math.inf)
    last = -first
    for time, visible in zip(times, side_by_side(shown, views, model.backend.workers(first)), strict=True):
        first = torch.where(visible, first.clamp(max=time - gap), first)
        last = torch.where(visible, last.clamp(min=time + gap), last)
    return torch.stack([first, last], -1)


def share_asleep(model: GaussianModel, views: Sequence[View]) -> float | None:
    """Return the share of AGR's evaluations that are skipped because the Gaussian is invisible at the time of a view.

    Return None if the times at which Gaussians are visible are unknown.
    """
    intervals = None if model.effect_sets is None else model.effect_sets.intervals
    if intervals is None or not len(intervals):
        return None
    times = intervals.new_tensor([view.time or 0.0 for view in views])[:, None]
    return float(((times < intervals[:, 0]) | (times > intervals[:, 1])).float().mean())
