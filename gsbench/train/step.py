"""Compute the gradients of one training step: the views of a batch side by side, each on a tape of its own.

Threads share the views, not the kernels: a batch has few views and each of them many small kernels. Gradients are added
in an order that depends on the views alone, so that any number of threads gives the same bits.
"""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import torch
from torch import Tensor, nn

from gsbench.errors import InputError
from gsbench.kernels.tape import Tape, add_to
from gsbench.measure.speed import StageClock
from gsbench.models import GaussianModel, Query
from gsbench.models.render import rasterize_slice
from gsbench.process.workers import side_by_side
from gsbench.raster import RasterInfo
from gsbench.scenes import View
from gsbench.train.finite_check import DivergedError
from gsbench.train.losses import photometric
from gsbench.train.penalties import Penalty

Sums = dict[int, Tensor]  # gradients by the id of what they are by

# A view of fewer Gaussians, with what its pixels cost in Gaussians, is done before a second thread is awake: on two
# cores a step of 1,000 Gaussians at 80 x 80 took twice as long by two threads as by one.
WORTH_A_THREAD = 4_000
PIXELS_OF_A_GAUSSIAN = 12


@contextmanager
def fitting_threads(gaussians: int, pixels: int) -> Iterator[None]:
    """Run a step on one thread where a view has too little work for two; the results are the same bits."""
    threads = torch.get_num_threads()
    if gaussians + pixels / PIXELS_OF_A_GAUSSIAN < WORTH_A_THREAD:
        torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def deal(views: int, bounds: Sequence[int]) -> list[Sums]:
    """Choose what each view's gradients are added to, so that few are held at once and any number of workers agrees.

    Views of one part of the batch (`_parts`) share a sum. Views of a worker that begins within a part have a sum each,
    which `add_up` adds to that of the part. To the last bit it makes no difference whether a view adds to a sum or is
    added to it (`gsbench.kernels.tape`).

    Args:
        views: number of views in the batch.
        bounds: worker i sees the views from bounds[i] to bounds[i + 1].

    Returns:
        For each view the dictionary of its sum; views that share a sum have the same one.
    """
    sums: list[Sums] = []
    begins = 0  # of the part or the worker that the view belongs to
    for i in range(views):
        if i in _parts(views) or i in bounds:
            begins = i
        sums.append(sums[-1] if i > begins and begins in _parts(views) else {})
    return sums


def add_up(sums: Sequence[Sums]) -> Sums:
    """Add the sums that `deal` chose: those of a part in the order of the views, then one part to the other."""
    ends = [*_parts(len(sums))[1:], len(sums)]
    return _in_order([_in_order(sums[i:end]) for i, end in zip(_parts(len(sums)), ends, strict=True)])


def _parts(views: int) -> list[int]:
    """Return where the two halves of a batch begin; a last half of one view would only cost a sum of its own."""
    middle = (views + 1) // 2
    return [0, middle] if views - middle > 1 else [0]


def _in_order(parts: Sequence[Sums]) -> Sums:
    """Add sums to the first of them, in their order; a sum that several views share is added once."""
    total = parts[0]
    done = {id(total)}
    for part in parts[1:]:
        if id(part) not in done:
            done.add(id(part))
            for key, gradient in part.items():
                add_to(total, key, gradient)
    return total


class Seen(NamedTuple):
    """What a step learns from one view."""

    loss: Tensor  # []
    info: RasterInfo
    g_means2d: Tensor  # [1, N, 2] of the batch's loss, by pixels


class Step:
    """Render views, and leave the gradient of their mean loss in the model's parameters."""

    def __init__(
        self, model: GaussianModel, background: Tensor, ssim_weight: float, antialias: bool, stages: StageClock
    ) -> None:
        """Prepare steps of `model` over a background colour [3]; `stages` sums the seconds of each stage."""
        self.model = model
        self.background = background
        self.ssim_weight = ssim_weight
        self.antialias = antialias
        self.stages = stages
        self.penalties: Sequence[tuple[float, Penalty]] = ()

    def __call__(self, views: Sequence[View], penalties: Sequence[tuple[float, Penalty]] = ()) -> list[Seen]:
        """The loss is the mean over `views`, each with `penalties` (weight, penalty) added to it.

        Raises:
            DivergedError: a slice is not finite.
            InputError: the rasterizer refuses a slice for another reason; TooLargeError: memory would not suffice.
        """
        self.penalties = penalties
        sources = [parameter for parameter in self.model.parameters() if parameter.requires_grad]
        workers = min(len(views), self.model.backend.workers(self.model.splats["means"]))
        bounds = [len(views) * worker // workers for worker in range(workers + 1)]
        sums = deal(len(views), bounds)
        if workers == 1:
            seen = [
                self._see(view, sources, own, len(views), self.stages) for view, own in zip(views, sums, strict=True)
            ]
        else:
            seen = self._by_workers(views, sources, sums, bounds)
        with self.stages("backward"):
            total = add_up(sums)
            for parameter in sources:
                parameter.grad = total.get(id(parameter))
        return seen

    def _by_workers(
        self, views: Sequence[View], sources: list[nn.Parameter], sums: list[Sums], bounds: list[int]
    ) -> list[Seen]:
        """Let each worker render the views between its two `bounds`."""
        started = time.perf_counter()
        workers = len(bounds) - 1
        clocks = [StageClock() for _ in range(workers)]

        def run(worker: int) -> list[Seen]:
            return [self._see(views[i], sources, sums[i], len(views), clocks[worker])
                    for i in range(bounds[worker], bounds[worker + 1])]  # fmt: skip

        seen = [one for part in side_by_side(run, range(workers), workers) for one in part]
        self.stages.share([clock.seconds for clock in clocks], time.perf_counter() - started)
        return seen

    def _see(self, view: View, sources: list[nn.Parameter], sums: Sums, views: int, stages: StageClock) -> Seen:
        """Render one view of a batch and add the gradients of its loss to `sums`."""
        with Tape() as tape:
            with stages("slice"):
                query = Query.of(view.camera, view.time)
                gaussians = self.model.slice(query)
            with stages("raster"):
                try:
                    output = rasterize_slice(
                        gaussians, view.camera, self.background, self.model.backend, self.antialias
                    )
                except InputError as error:  # the rasterizer's door is the first to see a slice that is not finite
                    if all(tensor.isfinite().all() for tensor in gaussians if tensor is not None):
                        raise
                    raise DivergedError(str(error)) from None
            with stages("loss"):
                loss = photometric(output.image, view.image[None], self.ssim_weight, self.model.backend)
                for weight, penalty in self.penalties:
                    loss = loss + weight * penalty(self.model, query)
        with stages("backward"):
            means2d = output.info.means2d
            tape.backward(loss, torch.full_like(loss, 1 / views), [*sources, means2d], sums)
            g_means2d = sums.pop(id(means2d), None)
        if g_means2d is None:
            g_means2d = torch.zeros_like(means2d)
        return Seen(loss.detach() / views, output.info, g_means2d)
