"""Measure how far the float32 images of a trained model are from the same images in float64, view by view."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.raster import Viewport
from gsbench.measure.images import STEPS
from gsbench.measure.quality import capped_psnr
from gsbench.models import GaussianModel
from gsbench.models.joint import JointModel
from gsbench.models.sliced import Gaussians3D
from gsbench.models.slicing import subtract
from gsbench.models.twins import doubled, exact_model, render_twins
from gsbench.raster import EPS2D, FAR, NEAR
from gsbench.raster.exact import ORDERED, SKIPPED, STOPPED, ExactImage, U
from gsbench.raster.reference import project
from gsbench.scenes.scene import Camera

WORST = 10  # Gaussians that are listed
# What makes a Gaussian hard: the ratio of its axes, its opacity, and pixels by which rounding moves its mean.
FLAT, OPAQUE, MOVED = 1e-3, 0.99, 1e-3
BRANCHES = {"skipped": SKIPPED, "stopped": STOPPED, "order": ORDERED}


class Shot(NamedTuple):
    """A camera and a time of which the image is rendered, with the photograph if there is one."""

    name: str
    camera: Camera
    time: float | None
    truth: Tensor | None  # [H, W, 3] in [0, 1]


@dataclass(frozen=True)
class ViewExactness:
    """The error of float32 in the image of one view; pixel values are in steps of 8 bits, 1/255."""

    name: str
    largest: float  # error of a channel of a pixel
    rms: float
    bound: float  # largest bound on the error
    median_bound: float  # of the pixels that show a Gaussian
    undecided: float  # share of the pixels in which rounding may decide what is blended, or in which order
    psnr: float | None = None  # of the float32 image, dB; None: no photograph
    psnr_change: float | None = None  # minus that of the float64 image
    psnr_bound: float | None = None  # no rounding within the pixels' bounds changes PSNR by more


@dataclass(frozen=True)
class Culprit:
    """A Gaussian with the largest share of the bound in some pixels of a view."""

    index: int
    view: str
    pixels: int  # in which its share is the largest
    bound: float  # sum of the bounds of these pixels, steps of 8 bits
    why: list[str]  # what makes it hard


@dataclass(frozen=True)
class Exactness:
    """The errors of float32 in all views of a model."""

    title: str
    gaussians: int
    views: list[ViewExactness]
    worst: list[Culprit]
    shown: tuple[str, Tensor, ExactImage] = field(repr=False)  # the view with the largest bound: name, float32, exact

    @property
    def psnr_change(self) -> float | None:
        """Return the largest change of a view's PSNR by float32, in dB; None without photographs."""
        changes = [abs(view.psnr_change) for view in self.views if view.psnr_change is not None]
        return max(changes) if changes else None


def measure(
    model: GaussianModel, shots: Sequence[Shot], background: Sequence[float], title: str, antialias: bool = False
) -> Exactness:
    """Render each shot in float32 by the CPU kernels and in float64, and compare.

    Args:
        model: a trained model on the CPU, float32.
        shots: the cameras and times, at least one.
        background: the background colour, three numbers.
        title: the name of the model in reports.
        antialias: whether opacities are scaled by the 2D filter of Mip-Splatting, as in `gsbench.raster.rasterize`.

    Raises:
        InputError: there is no shot, or the CPU kernels are not installed.
    """
    if not shots:
        raise InputError("expected at least one view to render, got none")
    double = exact_model(model)
    behind = torch.tensor(background, dtype=torch.float32)
    views, culprits, shown = [], [], None
    for shot in shots:
        twins = render_twins(model, double, shot.camera, shot.time, behind, antialias)
        found = twins.exact
        views.append(compare(shot, twins.image, found))
        with torch.inference_mode():
            culprits += blame(double, twins.gaussians, shot, found)
        if shown is None or found.bound.max() > shown[2].bound.max():
            shown = (shot.name, twins.image, found)
    assert shown is not None
    culprits.sort(key=lambda one: -one.bound)
    first = {one.index: one for one in reversed(culprits)}  # of each Gaussian its worst view
    worst = [one for one in culprits if first[one.index] is one][:WORST]
    return Exactness(title, len(model), views, worst, shown)


def compare(shot: Shot, image: Tensor, found: ExactImage) -> ViewExactness:
    """Compare a float32 image [H, W, 3] with the exact one, and both with the photograph if there is one."""
    error = (image.double() - found.image).abs()
    plain = ViewExactness(
        shot.name,
        largest=STEPS * float(error.max()),
        rms=STEPS * float(error.square().mean().sqrt()),
        bound=STEPS * float(found.bound.max()),
        median_bound=STEPS * found.median_bound,
        undecided=float(found.undecided.double().mean()),
    )
    if shot.truth is None:
        return plain
    own = capped_psnr(image, shot.truth)
    away = (found.image.clamp(0, 1) - shot.truth.double()).abs()
    bound = found.bound[..., None]
    share = float((2 * away * bound + bound.square()).mean() / away.square().mean().clamp(min=1e-300))
    most = -10 * math.log10(1 - share) if share < 1 else math.inf
    return replace(plain, psnr=own, psnr_change=own - capped_psnr(found.image, shot.truth), psnr_bound=most)


def blame(model: GaussianModel, exact: Gaussians3D, shot: Shot, found: ExactImage) -> list[Culprit]:
    """Return the Gaussians with the largest shares of the bounds in a view, and what makes each of them hard.

    Args:
        model: the model in float64.
        exact: its 3D Gaussians in this view.
        shot: the camera and the time.
        found: the exact image.
    """
    blamed = found.culprit.flatten() >= 0
    ids = found.culprit.flatten()[blamed].long()
    bounds, branches = found.bound.flatten()[blamed], found.branches.flatten()[blamed]
    sums = bounds.new_zeros(len(exact.means)).index_add_(0, ids, bounds)
    rows = sums.argsort(descending=True)[:WORST]
    rows = rows[sums[rows] > 0]
    why = reasons(exact, shot.camera, rows)
    made = []
    for row, words, negative in zip(rows.tolist(), why, by_published_formula(model, rows), strict=True):
        own = ids == row
        words += ["indefinite"] if negative else []
        words += [name for name, bit in BRANCHES.items() if bounds[own & (branches & bit > 0)].sum() > sums[row] / 2]
        made.append(Culprit(row, shot.name, int(own.sum()), STEPS * float(sums[row]), words))
    return made


def reasons(exact: Gaussians3D, camera: Camera, rows: Tensor) -> list[list[str]]:
    """Say of some Gaussians [M] in a view whether each is flat, far, huge or opaque."""
    means, factors, opacities = (part[rows] for part in exact[:3])
    shapes = None if exact.shapes is None else exact.shapes[rows]
    own = doubled(camera)
    viewport = Viewport(camera.width, camera.height, NEAR, FAR, EPS2D, False)
    splats = project(means, factors, opacities, own.viewmat, own.K, *viewport, shapes)
    axes = torch.linalg.svdvals(factors)
    moved = U * (means.norm(dim=-1) + own.center.norm()) * own.K[0, 0] / splats.depths
    named = {
        "flat": axes[:, -1] < FLAT * axes[:, 0],
        "far": moved > MOVED,
        "huge": splats.half_sizes.amax(-1) > max(camera.width, camera.height),
        "opaque": opacities > OPAQUE,
    }
    return [[name for name, holds in named.items() if holds[i]] for i in range(len(rows))]


def by_published_formula(model: GaussianModel, rows: Tensor) -> Iterable[bool]:
    """Return of some Gaussians [M] whether the papers' formula makes their covariance indefinite in float32.

    That formula, cov = S_pp - K S_pq^T, subtracts covariances (docs/stability.md). AGR is left out. A model without
    such a covariance has none that is indefinite.
    """
    if not isinstance(model, JointModel) or not len(rows):
        return [False] * len(rows)
    cov = subtract(model.factors(model.raw_of(rows)).float(), "schur")[1].double()
    return (torch.linalg.eigvalsh(cov)[:, 0] < 0).tolist()
