"""What is compared on a GPU: steps of four views, the raster, frames, replays, steps, the loss."""

import itertools
from collections.abc import Iterator
from unittest.mock import patch

import torch
from torch import Tensor

from benchmarks.compare import Call, Case, Place, Row, attempted, compared
from benchmarks.gsplat_way import gsplat_image
from benchmarks.rows import useful_alphas
from benchmarks.scene import camera, gaussians, model
from benchmarks.training import training_step
from gsbench.kernels.backends import AUTO, REFERENCE
from gsbench.kernels.loss import l1_ssim
from gsbench.models import CameraTime, GaussianModel
from gsbench.models.factors import rotation
from gsbench.models.render import GraphedFrames, render
from gsbench.raster import rasterize
from gsbench.scenes.scene import Camera
from gsbench.train.losses import photometric

TIME = 0.4  # at which models are seen


def every(place: Place) -> Iterator[Row]:
    """All rows, those that matter most first."""
    for rows in (four_view_rows, raster_rows, frame_rows, replay_rows, step_rows, loss_rows):
        yield from rows(place)


def four_view_rows(place: Place) -> Iterator[Row]:
    """A step of training on four views together, against the same step that renders them one by one (`TOGETHER_ON`).

    Then the same step repeated, against the one launched (`REPEATED_ON`).
    """
    sizes = ((3_000, 160), (100_000, 400)) if place.on_gpu else ((500, 48),)
    sections = {"together": ("TOGETHER_ON", "one by one"), "repeated": ("REPEATED_ON", "launched")}
    for (section, (option, way)), name, (N, size) in itertools.product(sections.items(), ("4dgs", "7dgs"), sizes):
        case = f"{name}, {N} / {size}x{size}, four views, theirs is {way}"
        arguments = place, section, option, case, name, N, size
        yield from attempted(section, case, lambda a=arguments: [four_view_row(*a)])


def four_view_row(place: Place, section: str, option: str, case: str, name: str, N: int, size: int) -> Row:
    step = training_step(model(name, N, agr=True).to(place.device), size, size, 4)
    with patch(f"gsbench.train.step.{option}", ()):
        without = place.cost(step)
    with patch(f"gsbench.train.step.{option}", (torch.device(place.device).type,)):
        return compared(section, case, "all", place.cost(step), without)


def raster_rows(place: Place) -> Iterator[Row]:
    """The rasterizer alone: ours by factors, gsplat by quaternions and scales, its faster way."""
    sizes = [(1_000, 64)] if not place.on_gpu else itertools.product((10_000, 100_000, 1_000_000), (400, 800, 1600))
    for N, size in sizes:
        case = f"{N} / {size}x{size}"
        yield from attempted("raster", case, lambda a=(place, case, N, size): raster_case(*a).rows(place))


def raster_case(place: Place, case: str, N: int, size: int) -> Case:
    means, factors, opacities, colors = place.put(gaussians(N))
    quats = torch.randn(N, 4, generator=torch.Generator().manual_seed(0)).to(means)
    viewmats, Ks = place.put(camera(size))
    scales = factors.norm(dim=1)
    shared = [x.requires_grad_() for x in (means, opacities, colors)]
    equal = (rotation(quats) * scales[:, None]).requires_grad_()
    quats.requires_grad_()
    scales.requires_grad_()

    def ours() -> Tensor:
        return rasterize(means, equal, opacities, colors, viewmats, Ks, size, size).image

    def other() -> Tensor:
        return gsplat_image(means, quats, scales, opacities, colors, viewmats=viewmats, Ks=Ks, size=size)

    # 16 floats a Gaussian and four a pixel.
    return Case(
        "raster",
        case,
        ours,
        other,
        [*shared, equal],
        [*shared, quats, scales],
        4.0 * (16 * N + 4 * size * size),
        useful_alphas(N, size),
    )


def frame_rows(place: Place) -> Iterator[Row]:
    """Whole frames from a model's parameters to a picture, and the gradients of all parameters."""
    N, sizes = (500, (48,)) if not place.on_gpu else (100_000, (400, 800))
    for name, agr, size in itertools.product(("4dgs", "6dgs", "7dgs"), (False, True), sizes):
        case = f"{name} {'with' if agr else 'without'} AGR, {N} / {size}x{size}"
        yield from attempted("frame", case, lambda a=(place, case, name, agr, N, size): frame_case(*a).rows(place))


def frame_case(place: Place, case: str, name: str, agr: bool, N: int, size: int) -> Case:
    fitted = model(name, N, agr=agr).to(place.device)
    parameters = [p for p in fitted.parameters() if p.requires_grad]
    return Case("frame", case, *two_ways(place, fitted, size), parameters, parameters)


def two_ways(place: Place, fitted: GaussianModel, size: int) -> tuple[Call, Call]:
    """A model's picture by our kernels, and by slicing in torch and drawing by gsplat."""
    viewmats, Ks = place.put(camera(size))
    view, background = Camera(viewmats[0], Ks[0], size, size), torch.zeros(3, device=place.device)

    def ours() -> Tensor:
        fitted.backend = AUTO
        return render(fitted, view, TIME, background)

    def other() -> Tensor:
        fitted.backend = REFERENCE
        batch = fitted.slice(CameraTime.of(view, TIME))
        covars = batch.factors @ batch.factors.mT
        return gsplat_image(
            batch.means, None, None, batch.opacities, batch.colors, covars=covars, viewmats=viewmats, Ks=Ks, size=size
        )[0]

    return ours, other


def replay_rows(place: Place) -> Iterator[Row]:
    """Frames replayed as a CUDA graph, as FPS is measured, against the same frames launched."""
    N, sizes = 100_000, (400, 800) if place.on_gpu else ()
    for name, agr, size in itertools.product(("3dgs", "4dgs", "6dgs", "7dgs"), (False, True), sizes):
        case = f"{name} {'with' if agr else 'without'} AGR, {N} / {size}x{size}, theirs is launched"
        yield from attempted("replay", case, lambda a=(place, case, name, agr, N, size): [replay_row(*a)])


def replay_row(place: Place, case: str, name: str, agr: bool, N: int, size: int) -> Row:
    fitted, background = model(name, N, agr=agr).to(place.device), torch.zeros(3, device=place.device)
    viewmats, Ks = place.put(camera(size))
    view = Camera(viewmats[0], Ks[0], size, size)
    graphed = GraphedFrames(fitted, background)
    with torch.no_grad():
        launched = place.cost(lambda: render(fitted, view, TIME, background))
    return compared("replay", case, "forward", place.cost(lambda: graphed(view, TIME)), launched)


def step_rows(place: Place) -> Iterator[Row]:
    """A step of training on one view: frame, L1 + SSIM, gradients, Adam (fused in both).

    Ours is the trainer's, by kernels on a tape; theirs is autograd's, with the loss in torch.
    """
    N, sizes = (500, (48,)) if not place.on_gpu else (100_000, (400, 800))
    for agr, size in itertools.product((False, True), sizes):
        case = f"7dgs {'with' if agr else 'without'} AGR, {N} / {size}x{size}"
        yield from attempted("step", case, lambda a=(place, case, agr, N, size): [step_row(*a)])


def step_row(place: Place, case: str, agr: bool, N: int, size: int) -> Row:
    ours = training_step(model("7dgs", N, agr=agr).to(place.device), size, size, 1)
    other = place.cost(their_step(place, agr, N, size)) if place.gsplat else None
    return compared("step", case, "all", place.cost(ours), other)


def their_step(place: Place, agr: bool, N: int, size: int) -> Call:
    fitted, target = model("7dgs", N, agr=agr).to(place.device), torch.rand(size, size, 3, device=place.device)
    _, picture = two_ways(place, fitted, size)
    adam = torch.optim.Adam(fitted.parameters(), lr=1e-9, eps=1e-15, fused=True)

    def step() -> None:
        photometric(picture(), target, 0.2, REFERENCE).backward()
        adam.step()
        adam.zero_grad(set_to_none=True)

    return step


def loss_rows(place: Place) -> Iterator[Row]:
    """L1 + SSIM forward and backward, against torch's own operations."""
    for size in (32,) if not place.on_gpu else (400, 800, 1600):
        image, target = (torch.rand(size, size, 3, device=place.device) for _ in range(2))
        image.requires_grad_()
        ours = place.cost(lambda a=image, b=target: torch.autograd.grad(l1_ssim(a, b, 0.2), a))
        other = place.cost(lambda a=image, b=target: torch.autograd.grad(photometric(a, b, 0.2, REFERENCE), a))
        yield compared("loss", f"{size}x{size}, theirs is torch", "both", ours, other)
