"""Measure the error of float32 in the images of a model: its bound, its change of PSNR, and the Gaussians behind it."""

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import torch
from torch import Tensor

from gsbench.errors import InputError, one_line
from gsbench.kernels.raster import Viewport
from gsbench.measure.images import STEPS
from gsbench.measure.quality import capped_psnr, evenly
from gsbench.models import CameraTime, GaussianModel
from gsbench.models.gaussian_batch import Gaussians3D
from gsbench.models.render import rasterize_slice
from gsbench.raster import EPS2D, FAR
from gsbench.raster.exact import ORDERED, SKIPPED, STOPPED, ExactImage, U, exact_image
from gsbench.raster.reference import project
from gsbench.scenes.scene import Camera, View

VIEWS = 3  # of a run's `psnr_float32`, evenly spaced; a view takes ten to twenty times as long as a frame
WORST = 10  # Gaussians that are listed
# What makes a Gaussian hard: the ratio of its axes, its opacity, and pixels by which rounding moves its mean.
FLAT, OPAQUE, MOVED = 1e-3, 0.99, 1e-3
BRANCHES = {"skipped": SKIPPED, "stopped": STOPPED, "order": ORDERED}


class Shot(NamedTuple):
    """A camera and a time of which the image is rendered, with the photograph if there is one."""

    name: str
    camera: Camera
    time: float | None
    photograph: Tensor | None  # [H, W, 3] in [0, 1]

    @classmethod
    def of(cls, view: View) -> "Shot":
        """Return the shot of a data set's view."""
        return cls(view.name, view.camera, view.time, view.image)


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
    model: GaussianModel,  # trained, on the CPU
    shots: Sequence[Shot],
    background: Sequence[float],  # [3]
    title: str,
    antialias: bool = False,  # as in `gsbench.raster.rasterize`
) -> Exactness:
    """Render each shot, of which there is at least one, in float32 by the CPU kernels and in float64, and compare.

    Raises:
        InputError: the CPU kernels are not installed.
    """
    double = float64_model(model)
    behind = torch.tensor(background, dtype=torch.float32)
    views, culprits, shown = [], [], None
    for shot in shots:
        both = render_twice(model, double, shot.camera, shot.time, behind, antialias)
        views.append(compare(shot, both.image, both.exact))
        with torch.inference_mode():
            culprits += blame(both.gaussians, shot, both.exact)
        if shown is None or both.exact.bound.max() > shown[2].bound.max():
            shown = (shot.name, both.image, both.exact)
    assert shown is not None
    culprits.sort(key=lambda culprit: -culprit.bound)
    first = {culprit.index: culprit for culprit in reversed(culprits)}  # of each Gaussian its worst view
    worst = [culprit for culprit in culprits if first[culprit.index] is culprit][:WORST]
    return Exactness(title, len(model), views, worst, shown)


def compare(shot: Shot, image: Tensor, exact: ExactImage) -> ViewExactness:
    """Compare a float32 image [H, W, 3] with the exact one, and both with the photograph if there is one."""
    error = (image.double() - exact.image).abs()
    plain = ViewExactness(
        shot.name,
        largest=STEPS * float(error.max()),
        rms=STEPS * float(error.square().mean().sqrt()),
        bound=STEPS * float(exact.bound.max()),
        median_bound=STEPS * exact.median_bound,
        undecided=float(exact.undecided.double().mean()),
    )
    if shot.photograph is None:
        return plain
    psnr = capped_psnr(image, shot.photograph)
    away = (exact.image.clamp(0, 1) - shot.photograph.double()).abs()
    bound = exact.bound[..., None]
    # The squared error of a channel, away^2, changes by at most 2 away bound + bound^2. A fall changes PSNR most.
    share = float((2 * away * bound + bound.square()).mean() / away.square().mean().clamp(min=1e-300))
    most = -10 * math.log10(1 - share) if share < 1 else math.inf
    return replace(plain, psnr=psnr, psnr_change=psnr - capped_psnr(exact.image, shot.photograph), psnr_bound=most)


def psnr_float32(
    model: GaussianModel,
    views: Sequence[View],
    background: Tensor,  # [3] float32
    antialias: bool,
) -> tuple[float | None, str]:
    """Return the largest change of a view's PSNR by float32 in dB, or None and the reason why it is not measured.

    PSNR is capped (gsbench.measure.exact_views), so that a view that is rendered exactly has no change.
    """
    if model.backend.name != "cpu":
        return None, f"needs raster.backend=cpu, whose images have a float64 twin; this run has {model.backend.name}"
    try:
        double = float64_model(model)
        changes = []
        for shot in map(Shot.of, evenly(views, VIEWS)):  # with photographs, so `psnr_change` is a number
            both = render_twice(model, double, shot.camera, shot.time, background, antialias)
            changes.append(abs(compare(shot, both.image, both.exact).psnr_change or 0.0))
    except Exception as error:  # a user's model may compute in float32 alone, and fail in any way
        return None, f"the model has no image in float64: {one_line(error)}"
    if not all(map(math.isfinite, changes)):
        return None, "an image has a pixel that is not a number"
    return max(changes), ""


# ---- the same image in float32 and in float64


class RenderedTwice(NamedTuple):
    """The images of one view in float32 and in float64, and the 3D Gaussians in float64."""

    image: Tensor  # [H, W, 3] float32
    gaussians: Gaussians3D  # float64
    exact: ExactImage


def check_exactness(model: GaussianModel) -> None:
    """Raise InputError if the images of a model have no bound on the error of float32.

    They need the CPU kernels, and an image that is blended and not decoded.
    """
    means = model.splats["means"]
    if means.device.type != "cpu":
        raise InputError(
            f"expected a model on the CPU, whose kernels have a float64 twin, got one on "
            f"{means.device}: start the viewer with --device cpu"
        )
    if not model.backend.serves(means):
        raise InputError(
            "expected the CPU kernels, which have a float64 twin, but they are not built in this "
            "installation: reinstall with a C++20 compiler",
            docs="install.md#without-a-compiler",
        )
    if model.decodes:
        raise InputError(
            f"expected a model whose image is what is blended, {type(model).__name__} decodes it, and the bound on "
            f"the error of float32 ends before that"
        )


def float64_model(model: GaussianModel) -> GaussianModel:
    """Return a copy of a float32 model on the CPU that computes in float64."""
    return copy.deepcopy(model).double()


def float64_camera(camera: Camera) -> Camera:
    """Return a camera whose matrices are float64; its position is computed in float64 too."""
    return replace(camera, viewmat=camera.viewmat.double(), K=camera.K.double())


@torch.inference_mode()
def render_twice(
    model: GaussianModel,
    double: GaussianModel,  # its `float64_model`
    camera: Camera,
    time: float | None,
    background: Tensor,  # [3] float32
    antialias: bool,
) -> RenderedTwice:
    """Render a view of a model in float32, and of its copy in float64.

    Raises:
        InputError: the model decodes what is blended, the CPU kernels are not installed, or a Gaussian has a value that
            is not finite.
    """
    check_exactness(model)
    single = model.slice(CameraTime.of(camera, time))
    image = rasterize_slice(single, camera, background, model.backend, antialias).image[0]
    gaussians = double.slice(CameraTime.of(float64_camera(camera), time))
    return RenderedTwice(image, gaussians, float64_image(gaussians, single, camera, background, antialias))


def float64_image(
    gaussians: Gaussians3D,  # float64
    single: Gaussians3D,  # the same in float32
    camera: Camera,
    background: Tensor,  # [3] float32
    antialias: bool,
) -> ExactImage:
    """Render 3D Gaussians in float64, and bound the error of their image in float32; see `exact_image`."""
    return exact_image(
        gaussians,
        single,
        camera.viewmat,
        camera.K,
        camera.width,
        camera.height,
        background=background,
        near=camera.near,
        antialias=antialias,
    )


# ---- which Gaussians, and why


def blame(
    gaussians: Gaussians3D,  # of a shot, float64
    shot: Shot,
    exact: ExactImage,
) -> list[Culprit]:
    """Return the Gaussians with the largest shares of the bounds in a view, and what makes each of them hard."""
    blamed = exact.culprit.flatten() >= 0
    ids = exact.culprit.flatten()[blamed].long()
    bounds, branches = exact.bound.flatten()[blamed], exact.branches.flatten()[blamed]
    sums = bounds.new_zeros(len(gaussians.means)).index_add_(0, ids, bounds)
    rows = sums.argsort(descending=True)[:WORST]
    rows = rows[sums[rows] > 0]
    culprits = []
    for row, words in zip(rows.tolist(), reasons(gaussians, shot.camera, rows), strict=True):
        mask = ids == row
        words += [name for name, bit in BRANCHES.items() if bounds[mask & (branches & bit > 0)].sum() > sums[row] / 2]
        culprits.append(Culprit(row, shot.name, int(mask.sum()), STEPS * float(sums[row]), words))
    return culprits


def reasons(
    gaussians: Gaussians3D,  # float64
    camera: Camera,
    rows: Tensor,  # [M]
) -> list[list[str]]:
    """Return of some Gaussians whether each is flat, far, huge or opaque in a view."""
    means, factors, opacities = (part[rows] for part in gaussians[:3])
    exponents = None if gaussians.beta_exponents is None else gaussians.beta_exponents[rows]
    exact = float64_camera(camera)
    viewport = Viewport(camera.width, camera.height, camera.near, FAR, EPS2D, False)
    splats = project(means, factors, opacities, exact.viewmat, exact.K, viewport, exponents)
    axes = torch.linalg.svdvals(factors)
    moved = U * (means.norm(dim=-1) + exact.center.norm()) * exact.K[0, 0] / splats.depths
    named = {
        "flat": axes[:, -1] < FLAT * axes[:, 0],
        "far": moved > MOVED,
        "huge": splats.half_sizes.amax(-1) > max(camera.width, camera.height),
        "opaque": opacities > OPAQUE,
    }
    return [[name for name, holds in named.items() if holds[i]] for i in range(len(rows))]
