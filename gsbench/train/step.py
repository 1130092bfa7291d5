"""Compute the gradients of one training step. On a CPU, threads render different views of the batch in parallel.

The gradients of the views are added in a fixed order, so the result has the same bits for any number of threads.
"""

from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import torch
from torch import Tensor, nn

from gsbench.errors import InputError
from gsbench.kernels.tape import Tape, add_to
from gsbench.measure.speed import StageClock
from gsbench.models import CameraTime, GaussianModel
from gsbench.models.render import render_slice
from gsbench.process.workers import side_by_side
from gsbench.scenes import View
from gsbench.train.divergence import DivergedError
from gsbench.train.hooks import ImageMap, LossTerm
from gsbench.train.losses import photometric
from gsbench.train.step_replay import Observed, Stages, StepReplay

Sums = dict[int, Tensor]  # gradients by the id of the tensor with respect to which they are taken

# A step with less work than this many Gaussians runs on one thread, because a second thread takes longer to start: on
# two cores a step of 1,000 Gaussians at 80 x 80 took twice as long with two threads as with one. In this comparison 12
# pixels count as a Gaussian.
WORTH_A_THREAD = 4_000
PIXELS_OF_A_GAUSSIAN = 12

# The types of devices on which a step is recorded to be repeated. Tests run the kernels of "cuda" on the CPU, where
# repeated steps give the same bits; that they are faster on a GPU is to be shown by the first rows of `make gpu-check`.
REPEATED_ON = ("cpu",)

# A step with more work than this many Gaussians, in all views of its batch, is not recorded to be repeated. A recording
# keeps about 900 bytes of memory for each, and Python code is a small share of such a step.
MOST_RECORDED = 500_000


def work_of(gaussians: int, pixels: int) -> float:
    """Return the work on a view, as the number of Gaussians that without pixels are as much work."""
    return gaussians + pixels / PIXELS_OF_A_GAUSSIAN


@contextmanager
def fitting_threads(gaussians: int, pixels: int) -> Iterator[None]:
    """Run the training step in a `with` block on one thread if it has few Gaussians and pixels; results are equal."""
    threads = torch.get_num_threads()
    if work_of(gaussians, pixels) < WORTH_A_THREAD:
        torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def deal(views: int, bounds: Sequence[int]) -> list[Sums]:
    """Assign to each view of a batch the dictionary to which its gradients are added.

    Views share a dictionary if one thread renders them and they are in the same half of the batch. If a thread begins
    inside a half, each of the thread's views in this half has its own dictionary. `add_up` adds all dictionaries in the
    order of the views, so the total has the same bits for any number of threads. Thread i renders the views from
    bounds[i] to bounds[i + 1].
    """
    sums: list[Sums] = []
    begins = 0  # first view of the half, or of the thread, that view i belongs to
    for i in range(views):
        if i in _halves(views) or i in bounds:
            begins = i
        sums.append(sums[-1] if i > begins and begins in _halves(views) else {})
    return sums


def add_up(sums: Sequence[Sums]) -> Sums:
    """Return the sum of the gradients of all views; each half of the batch is summed first, then the two halves.

    This order does not depend on the threads, so the sum has the same bits for any number of them.
    """
    ends = [*_halves(len(sums))[1:], len(sums)]
    return _in_order([_in_order(sums[i:end]) for i, end in zip(_halves(len(sums)), ends, strict=True)])


def _halves(views: int) -> list[int]:
    """Return the index of the first view of each half of a batch; a batch of at most three views is not halved."""
    middle = (views + 1) // 2
    return [0, middle] if views - middle > 1 else [0]


def _in_order(sums: Sequence[Sums]) -> Sums:
    """Return the sum of dictionaries of gradients, added in order to the tensors of the first one.

    A dictionary that views share is added only once.
    """
    total = dict(sums[0])
    done = {id(sums[0])}
    for further in sums[1:]:
        if id(further) not in done:
            done.add(id(further))
            add_to(total, further)
    return total


class ViewResult(NamedTuple):
    """Hold the results of one view of a training step. The next step may overwrite the tensors."""

    loss: Tensor  # [1] the view's part of the batch's loss
    drawn: Tensor  # [1, N] bool: which Gaussians were not culled
    g_means2d: Tensor  # [1, N, 2] gradient of the batch's loss by the 2D means, per pixel
    sums: Sums  # gradients of the batch's loss by the parameters, of this view and of those that share the dictionary


class Step:
    """Render a batch of views and store the gradient of their mean loss in the parameters of a model."""

    def __init__(
        self, model: GaussianModel, background: Tensor, ssim_weight: float, antialias: bool, stages: StageClock
    ) -> None:
        """Store the background colour [3], the weight w of 1 - SSIM in the loss, and a clock of the stages."""
        self.model = model
        self.parameters = list(model.parameters())
        self.background = background
        self.ssim_weight = ssim_weight
        self.antialias = antialias
        self.stages = stages
        self.terms: Sequence[LossTerm] = ()
        self.maps: Sequence[ImageMap] = ()
        self.replay: StepReplay[ViewResult] = StepReplay()

    def __call__(
        self, views: Sequence[View], terms: Sequence[LossTerm] = (), maps: Sequence[ImageMap] = ()
    ) -> list[ViewResult]:
        """Render a batch of views and store the gradient of the loss in all parameters.

        The loss is the mean over views of the photometric loss of the mapped render plus weighted terms, plus the
        model's penalty.

        Raises:
            DivergedError: a 3D Gaussian of a view has a value that is not finite.
            InputError: the rasterizer refuses 3D Gaussians for another reason.
            TooLargeError: the memory does not suffice.
        """
        self.terms, self.maps = terms, maps
        sources = [parameter for parameter in self.parameters if parameter.requires_grad]
        workers = min(len(views), self.model.backend.workers(self.model.splats["means"]))
        bounds = [len(views) * worker // workers for worker in range(workers + 1)]
        sums = deal(len(views), bounds)
        seed = self.background.new_full((1,), 1 / len(views))
        results = self.replay(
            self._signature(views, sources, workers),
            views,
            lambda i, observed, stages: self._of_view(i, observed, sources, sums[i], seed, stages),
            lambda work: self._of_all(work, bounds),
        )
        with self.stages("backward"):
            total = add_up([result.sums for result in results])
            for parameter in sources:
                parameter.grad = total.get(id(parameter))
            if (penalty := self.model.penalty()) is not None:
                penalty.backward()
        return results

    def _signature(self, views: Sequence[View], sources: list[nn.Parameter], workers: int) -> Hashable:
        """Return all that the calls of a step depend on, except values of tensors; None if they must not be repeated.

        A model may have attributes that this class does not know, so all its numbers and strings are included.
        """
        model, sets = self.model, self.model.effect_sets
        by_kernels = self.background.device.type in REPEATED_ON and model.backend.serves(self.background)
        work = sum([work_of(len(model), view.camera.width * view.camera.height) for view in views])
        if self.terms or self.maps or not by_kernels or work > MOST_RECORDED:
            return None
        tensors = [*self.parameters, *([] if sets is None else [sets.orders, sets.intervals])]
        addresses = tuple([None if x is None else (x.data_ptr(), x.shape) for x in tensors])
        counts = None if sets is None else (sets.refined, sets.conditioned)
        options = tuple([x for x in vars(model).values() if isinstance(x, int | float | str)])
        return addresses, counts, options, model.active, tuple(map(id, sources)), workers, torch.get_num_threads()

    def _of_all(self, work: Callable[[int, Stages], ViewResult], bounds: Sequence[int]) -> list[ViewResult]:
        """Call `work` for all views of a batch; thread i does so for the views bounds[i] to bounds[i + 1]."""
        workers = len(bounds) - 1
        if workers == 1:
            return [work(i, self.stages) for i in range(bounds[1])]
        with self.stages.side_by_side(workers) as clocks:

            def run(worker: int) -> list[ViewResult]:
                return [work(i, clocks[worker]) for i in range(bounds[worker], bounds[worker + 1])]

            return [result for part in side_by_side(run, range(workers), workers) for result in part]

    def _of_view(
        self, index: int, view: Observed, sources: list[nn.Parameter], sums: Sums, seed: Tensor, stages: Stages
    ) -> ViewResult:
        """Render view number `index` of a batch and add the gradients of its loss to `sums`.

        `seed` is the gradient of the batch's loss by the loss of one view.
        """
        with Tape() as tape:
            with stages("slice"):
                query = CameraTime.of(view.camera, view.time)
                gaussians = self.model.slice(query)
            with stages("raster"):
                try:
                    output = render_slice(self.model, gaussians, view.camera, self.background, self.antialias)
                except InputError as error:  # the rasterizer checks its inputs, so it is the first to see NaN
                    if all(tensor.isfinite().all() for tensor in gaussians if tensor is not None):
                        raise
                    raise DivergedError(str(error)) from None
            with stages("loss"):
                image = output.image
                for image_map in self.maps:
                    image = image_map(image, index)
                loss = photometric(image, view.target[None], self.ssim_weight, self.model.backend)
                for weight, term in self.terms:
                    loss = loss + weight * term(query, index)
        with stages("backward"):
            means2d = output.info.means2d
            tape.backward(loss, seed, [*sources, means2d], sums)
            g_means2d = sums.pop(id(means2d), None)
            if g_means2d is None:
                g_means2d = torch.zeros_like(means2d)
            return ViewResult(loss.detach() * seed, output.info.drawn, g_means2d, sums)
