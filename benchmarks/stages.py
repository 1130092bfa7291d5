"""Time each stage of a training step alone: every operation is called again as a step of one view has called it."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from benchmarks.scene import trained
from benchmarks.timing import Row
from benchmarks.training import adam_of, one_view, training_step
from gsbench.kernels.headers import ALPHA_MAX, ALPHA_MIN, HIDDEN, TRANSMITTANCE_MIN
from gsbench.kernels.operation import Operation, Results
from gsbench.kernels.raster import RasterInputs, Splats, Viewport, bin_tiles, flag_values
from gsbench.kernels.tape import Tape
from gsbench.models import CameraTime, GaussianModel
from gsbench.models.render import rasterize_slice
from gsbench.raster import reference
from gsbench.scenes import View
from gsbench.train.losses import photometric

MODELS = {"7dgs_noagr": ("7dgs", False), "7dgs": ("7dgs", True), "4dgs": ("4dgs", False)}  # name: model, AGR
SUCCESSORS = ("dgs", "dbs", "ubs", "freetime")  # of which only the slice is timed; other stages cost as above
STAGES = {
    "refine": "AGR",
    "slice_triangular": "slice",
    "slice_rotated": "slice",
    "show_colors": "colours",
    "project": "project",
    "blend": "blend",
}


class Call:
    """An operation of a step, with the arguments of its forward and its last backward kernel."""

    def __init__(self, operation: Operation, tensors: list[Tensor], numbers: Sequence[Any]) -> None:
        """Keep the forward call; the tape makes it."""
        self.operation, self.tensors, self.numbers = operation, tensors, numbers
        self.name, self.adds = operation.name, operation.adds
        self.differentiable, self.carries_gradient = operation.differentiable, operation.carries_gradient

    def run(self, tensors: list[Tensor], numbers: Sequence[Any]) -> tuple[list[Tensor], dict[str, Any]]:
        self.outputs, slots = self.operation.run(tensors, numbers)
        return self.outputs, slots

    def backward(
        self,
        tensors: list[Tensor],
        slots: dict[str, Any],
        outputs: list[Tensor],
        upstream: Sequence[Tensor | None],
        wanted: Sequence[bool],
        sums: dict[int, Tensor] | None = None,
    ) -> list[Tensor | None]:
        self.arguments = tensors, slots, outputs, upstream, wanted, sums
        self.gradients = self.operation.backward(*self.arguments)
        return self.gradients

    def forward_again(self) -> None:
        self.operation.run(self.tensors, self.numbers)

    def backward_again(self) -> None:
        self.operation.backward(*self.arguments)

    # ---- what it cannot do without

    def learning(self) -> float:
        """Return the share of Gaussians for which a gradient is given."""
        *_, upstream, _, _ = self.arguments
        there = [g for g in upstream if g is not None]
        N = _rows(there)
        learns = sum((g.reshape(N, -1) != 0).any(1) for g in there if g.numel() % N == 0)
        return float((torch.as_tensor(learns) > 0).float().mean())

    def forward_bytes(self, visible: float) -> float:
        """Count the inputs of visible Gaussians, and all outputs."""
        return visible * _bytes(self.tensors) + _bytes(self.outputs)

    def backward_bytes(self) -> float:
        """Count all gradients given; of Gaussians that have one the inputs; gradients written, or read and written."""
        *_, upstream, _, sums = self.arguments
        added = _bytes([g for i, g in enumerate(self.gradients) if g is not None and i in (sums or {})])
        written = _bytes([g for i, g in enumerate(self.gradients) if g is not None and i not in (sums or {})])
        given_bytes = _bytes([g for g in upstream if g is not None])
        return given_bytes + self.learning() * (_bytes(self.tensors) + 2 * added) + written


class Recording(Tape):
    """A tape that keeps every call in `calls`."""

    def __init__(self) -> None:
        """Start without calls."""
        super().__init__()
        self.calls: dict[str, Call] = {}

    def record(
        self, operation: Operation, tensors: list[Tensor], numbers: Sequence[Any], results: Results | None
    ) -> list[Tensor]:
        call = self.calls[operation.name] = Call(operation, tensors, numbers)
        return super().record(call, tensors, numbers, results)


def recorded(fitted: GaussianModel, view: View) -> dict[str, Call]:
    """Return the calls of the second of two views by name; its gradients are added to those of the first.

    The parameters get the gradients of both.
    """
    sources = [p for p in fitted.parameters() if p.requires_grad]
    sums: dict[int, Tensor] = {}
    for _ in range(2):
        with Recording() as tape:
            batch = fitted.slice(CameraTime.of(view.camera, view.time))
            output = rasterize_slice(batch, view.camera, torch.zeros(3), fitted.backend)
            loss = photometric(output.image, view.image[None], 0.2, fitted.backend)
        means2d = output.info.means2d
        tape.backward(loss, torch.ones_like(loss), [*sources, means2d], sums)
        sums.pop(id(means2d))
    for parameter in sources:
        parameter.grad = sums.get(id(parameter))
    return tape.calls


def stages(N: int = 150_000, size: int = 400) -> Iterator[Row]:
    """Every stage of a training step of 150,000 Gaussians and one view of 400 x 400; of later models the slice."""
    for name in MODELS:
        yield from stages_of(name, N, size)
    for name in SUCCESSORS:
        yield from slice_of(name, N, size)


def slice_of(name: str, N: int, size: int) -> Iterator[Row]:
    """The slice of one model and its gradients, of which a view shows as many Gaussians as in training."""
    calls = recorded(trained(name, N), one_view(size, size))
    (call,) = (call for key, call in calls.items() if key.startswith("slice"))
    forward, backward = floors(call, calls["project"], N)
    yield Row("stages", f"{name} slice forward", call.forward_again, floor=forward)
    yield Row("stages", f"{name} slice backward", call.backward_again, floor=backward)


def stages_of(name: str, N: int, size: int) -> Iterator[Row]:
    """The stages of one model, of which a view shows as many Gaussians as in training."""
    fitted, view = trained(MODELS[name][0], N, agr=MODELS[name][1]), one_view(size, size)
    calls = recorded(fitted, view)

    def row(stage: str, call: Callable[[], Any], floor: tuple[str, float], pixels: int | None = None) -> Row:
        return Row("stages", f"{name} {stage}", call, floor=floor, pixels=pixels)

    for key, call in calls.items():
        if key in STAGES:
            forward, backward = floors(call, calls["project"], N)
            yield row(f"{STAGES[key]} forward", call.forward_again, forward)
            if key == "project":
                yield from binning(name, calls)
            yield row(f"{STAGES[key]} backward", call.backward_again, backward)
    loss = calls["l1_ssim"]
    yield row(
        "loss forward + backward",
        lambda: (loss.forward_again(), loss.backward_again()),
        ("flops", loss_flops(size * size)),
        size * size,
    )
    updated = sum(p.numel() for p in fitted.parameters() if p.grad is not None)
    yield row("Adam", adam_of(fitted), ("bytes", 7 * 4 * updated))  # four arrays are read and three written
    yield Row("stages", f"{name} whole step", training_step(fitted, size, size, 1))


def binning(name: str, calls: dict[str, Call]) -> Iterator[Row]:
    """What the rasterizer does outside of operations: look for bad values, and list each tile's Gaussians."""
    project, blend = calls["project"], calls["blend"]
    means, factors, opacities, viewmats, Ks, _ = project.tensors
    values = means, factors, opacities, blend.tensors[3], viewmats, Ks, blend.tensors[4]
    splats, viewport = Splats(*project.outputs), Viewport(*project.numbers)
    yield Row(
        "stages", f"{name} check values", lambda: flag_values(RasterInputs(*values)), floor=("bytes", _bytes(values))
    )
    read = _bytes([splats.means2d, splats.depths, splats.half_sizes])
    yield Row(
        "stages",
        f"{name} bin",
        lambda: bin_tiles(splats, viewport),
        floor=("bytes", read + _bytes(blend.tensors[5:7])),
    )


def floors(call: Call, project: Call, N: int) -> list[tuple[str, float]]:
    """Return the least work of forward and backward as (limit, units of it)."""
    if call.name == "refine":
        return [("flops", refine_flops(N)), ("flops", call.learning() * 3 * refine_flops(N))]
    if call.name == "blend":
        alphas = blended_alphas(project)
        return [("alphas", alphas), ("alphas", 2 * alphas)]
    is_slice = call.name.startswith("slice")  # which finds out what is visible
    visible = 1.0 if is_slice else float((project.tensors[2] >= ALPHA_MIN).float().mean())
    return [("bytes", call.forward_bytes(visible)), ("bytes", call.backward_bytes())]


def refine_flops(N: int) -> float:
    """Count the operations of AGR's four networks for 7DGS, forward: 7 features, 35 numbers moved."""
    return 2.0 * N * HIDDEN * (4 * 7 + 35)


def loss_flops(pixels: int) -> float:
    """Count the operations of eight separable filters of eleven taps along two axes, on three channels."""
    return 2.0 * 8 * 22 * 3 * pixels


@torch.no_grad()
def blended_alphas(project: Call) -> float:
    """Count pairs of a pixel and a Gaussian that is blended into it: alpha of at least 1/255, before the pixel ends."""
    means, factors, opacities, viewmats, Ks, _ = project.tensors
    viewport = Viewport(*project.numbers)
    splats = reference.project(means, factors, opacities, viewmats[0], Ks[0], viewport)
    tiles, ids = reference.bin_tiles(splats, viewport.width, viewport.height)
    across, total = -(-viewport.width // reference.TILE), 0
    offsets = torch.arange(reference.TILE) + 0.5
    for tile, count in zip(*torch.unique_consecutive(tiles, return_counts=True), strict=True):
        rows, ids = ids[:count], ids[count:]
        dx = (tile % across * reference.TILE + offsets - splats.means2d[rows, :1])[:, None, :]
        dy = (tile // across * reference.TILE + offsets - splats.means2d[rows, 1:])[:, :, None]
        a, b, c = splats.conics[rows, :, None, None].unbind(1)
        alpha = splats.opacities[rows, None, None] * torch.exp(-0.5 * ((a * dx + b * dy).square() + (c * dy).square()))
        alpha = torch.where(alpha >= ALPHA_MIN, alpha.clamp(max=ALPHA_MAX), 0.0)
        total += int(((alpha > 0) & (torch.cumprod(1 - alpha, 0) >= TRANSMITTANCE_MIN)).sum())
    return float(total)


def _bytes(tensors: Sequence[Tensor]) -> int:
    return sum(x.numel() * x.element_size() for x in tensors)


def _rows(tensors: Sequence[Tensor]) -> int:
    """Return the number of Gaussians in gradients [N, ...] or [1, N, ...]."""
    x = tensors[0]
    return x.shape[1] if x.dim() > 2 and x.shape[0] == 1 else x.shape[0]
