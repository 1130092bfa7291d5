"""List the rows of each section: a name, a call, the target if there is one, and the limit of the machine."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from benchmarks.scene import camera, gaussians, model
from benchmarks.stages import loss_flops, refine_flops, stages
from benchmarks.timing import Row
from benchmarks.training import training_step
from gsbench import kernels
from gsbench.kernels.backends import BACKENDS, CPU, REFERENCE
from gsbench.kernels.loss import l1_ssim
from gsbench.models import CameraTime
from gsbench.models.gaussian_batch import tensors_of
from gsbench.raster import rasterize
from gsbench.train.losses import photometric

RASTER_TARGETS = {(10_000, 400): (2.8, 3.8), (100_000, 800): (30.0, 37.0)}  # ms forward, backward


def raster() -> Iterator[Row]:
    """Forward and backward of the rasterizer on the scene's recipe."""
    for N in (2_000, 10_000, 50_000, 100_000):
        for size in (128, 400, 800):
            yield from raster_rows(N, size)
    for N, size in RASTER_TARGETS:
        yield from raster_rows(N, size, threads=2)


def both_ways(
    section: str,
    name: str,  # with {} for forward or backward
    forward: Callable[[], Any],
    inputs: Sequence[Tensor],
    limit: str,
    amounts: tuple[float, float],  # of the limit, forward and backward
    targets: tuple[float | None, float | None] = (None, None),  # ms
    threads: int = 1,
) -> Iterator[Row]:
    """Yield the rows of a call, and of the gradients of its outputs by `inputs`, on a graph that is kept."""
    outputs = forward()
    upstream = [torch.ones_like(x) for x in outputs]
    calls = {
        "forward": forward,
        "backward": lambda: torch.autograd.grad(outputs, inputs, upstream, retain_graph=True, allow_unused=True),
    }
    for (way, call), target, amount in zip(calls.items(), targets, amounts, strict=True):
        yield Row(section, name.format(way), call, target, (limit, amount), threads)


def raster_rows(N: int, size: int, threads: int = 1) -> Iterator[Row]:
    """Both directions at one size; the limit counts alphas of at least 1/255, the fewest any blender evaluates."""
    inputs = [x.requires_grad_() for x in gaussians(N)]
    viewmats, Ks = camera(size)

    def forward() -> list[Tensor]:
        return [rasterize(*inputs, viewmats, Ks, size, size, backend="cpu").image]

    alphas = useful_alphas(N, size)
    targets = RASTER_TARGETS.get((N, size), (None, None)) if threads == 1 else (None, None)
    name = f"{N // 1000}k / {size}x{size}" + (f", {threads} threads" if threads > 1 else "")
    yield from both_ways("raster", f"{name} {{}}", forward, inputs, "alphas", (alphas, 2 * alphas), targets, threads)


@torch.no_grad()
def useful_alphas(N: int, size: int) -> float:
    """Pixels where a Gaussian's alpha is at least 1/255, were nothing in front of it: ellipses of power ln(255 o)."""
    means, factors, opacities, _ = gaussians(N)
    scale = size * 1.39 / (means[:, 2:3] + 4.0)
    M = factors[:, :2] * scale[..., None]
    cov = M @ M.mT + 0.3 * torch.eye(2)
    return float((2 * torch.pi * (255 * opacities).log().clamp(min=0) * cov.det().sqrt()).sum())


def observing() -> Iterator[Row]:
    """Slices, colours and projection of 100k Gaussians, one after the other, and AGR."""
    center = torch.tensor([0.0, 0.0, -4.0])
    for name in ("3dgs", "4dgs", "6dgs", "7dgs"):
        for backend in ("cpu", "reference"):
            observed = model(name, 100_000, backend=BACKENDS[backend])
            time = 0.4 if "time" in observed.observes else None
            parameters = [p for p in observed.parameters() if p.requires_grad]
            query = CameraTime.at(center, time)
            targets = (15.0, 25.0) if name == "7dgs" and backend == "cpu" else (None, None)
            values = sum(p.numel() for p in observed.splats.values())
            yield from both_ways(
                "observe",
                f"{name} 100k slice and colours, {backend} {{}}",
                lambda o=observed, q=query: tensors_of(o.slice(q)),
                parameters,
                "bytes",
                (4 * values, 12 * values),
                targets,
            )
    yield from refining()


def refining() -> Iterator[Row]:
    """AGR's four perceptrons on 100k 7D Gaussians."""
    refinement = model("7dgs", 100_000, agr=True).refinement
    assert refinement is not None
    values = [torch.randn(100_000, width).requires_grad_() for width in (3, 1, 3, 7, 21)]
    flops = refine_flops(100_000)
    for backend, targets in (("cpu", (20.0, 60.0)), ("reference", (None, None))):
        yield from both_ways(
            "agr",
            f"AGR 100k {{}}, {backend}",
            lambda native=backend == "cpu": refinement(values, torch.tensor(0.3), by_kernel=native),
            [*values, *refinement.parameters()],
            "flops",
            (flops, 3 * flops),
            targets,
        )


def loss() -> Iterator[Row]:
    """L1 + SSIM, forward and backward; eight separable filters of eleven taps along two axes."""
    for width, height in ((400, 400), (800, 800), (2048, 1088)):
        g = torch.Generator().manual_seed(0)
        image, target = (torch.rand(height, width, 3, generator=g) for _ in range(2))
        image.requires_grad_()
        for backend in (CPU,) if width > 800 else (CPU, REFERENCE):  # where torch would take seconds a call
            yield Row(
                "loss",
                f"{width}x{height} forward + backward, {backend.name}",
                lambda a=image, b=target, by=backend: torch.autograd.grad(photometric(a, b, 0.2, by), a),
                6.0 if (width, backend) == (400, CPU) else None,
                ("flops", loss_flops(width * height)),
                pixels=width * height,
            )


def step() -> Iterator[Row]:
    """A whole training step of one view, as the trainer makes it: gradients, then Adam."""
    for name, agr in (("3dgs", False), ("4dgs", False), ("6dgs", False), ("7dgs", False), ("7dgs", True)):
        for backend in (CPU, REFERENCE):
            yield Row(
                "step",
                f"{name}{'+agr' if agr else ''} 10k / 400x400, {backend.name}",
                training_step(model(name, 10_000, agr=agr, backend=backend), 400, 400, 1),
            )
    for N, size in ((16, 16), (1_000, 80), (5_000, 80), (10_000, 400), (50_000, 400)):
        for name, agr in (("7dgs", False), ("4dgs", False), ("7dgs", True)):
            for threads in (1, 2):
                title = f"{name}{'+agr' if agr else ''} {N} / {size}x{size}, 4 views, {threads} threads"
                yield Row("step", title, training_step(model(name, N, agr=agr), size, size, 4), threads=threads)


def instruction_sets() -> Iterator[Row]:
    """The same calls by each instruction set that this machine has: a higher one is not to be slower."""
    query, g = CameraTime.at(torch.tensor([0.0, 0.0, -4.0]), 0.4), torch.Generator().manual_seed(0)
    image, target = (torch.rand(400, 400, 3, generator=g) for _ in range(2))
    image.requires_grad_()
    inputs, (viewmats, Ks) = [x.requires_grad_() for x in gaussians(10_000)], camera(400)
    calls: dict[str, Callable[[], Any]] = {
        f"{name} 50k slice and colours": lambda fitted=fitted: sum(
            x.sum() for x in tensors_of(fitted.slice(query))
        ).backward()
        for name, fitted in ((n, model(n, 50_000, agr=n == "7dgs")) for n in ("3dgs", "4dgs", "6dgs", "7dgs"))
    }
    calls["raster 10k / 400x400"] = lambda: rasterize(*inputs, viewmats, Ks, 400, 400).image.sum().backward()
    calls["loss 400x400"] = lambda: l1_ssim(image, target, 0.2).backward()
    best = kernels.native().active()
    for name, call in calls.items():
        for level in kernels.native().instruction_sets():
            kernels.use_instruction_set(level)
            yield Row("instruction sets", f"{name} forward + backward, {level}", call)
        kernels.use_instruction_set(best)


SECTIONS: dict[str, Callable[[], Iterator[Row]]] = {
    "stages": stages,
    "raster": raster,
    "observe": observing,
    "loss": loss,
    "step": step,
    "isa": instruction_sets,
}
