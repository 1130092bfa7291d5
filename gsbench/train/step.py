"""Compute the gradients of one training step.

A part is the views of a batch that are rendered together. On a CPU each view is a part, and threads render different
parts at the same time; their gradients are added in a fixed order, so the result has the same bits for any number of
threads. On a GPU views of equal size are one part, so that each kernel is launched once for all of them.
"""

from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.tape import Tape, add_to
from gsbench.measure.speed import StageClock
from gsbench.models import CameraTime, GaussianModel
from gsbench.models.render import render_slices
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

# The types of devices on which views of equal size are one part; the first rows of `make gpu-check` are to time it.
TOGETHER_ON = ("cuda",)

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


def deal(parts: int, bounds: Sequence[int]) -> list[Sums]:
    """Assign to each part of a batch the dictionary to which its gradients are added.

    Parts share a dictionary if one thread renders them and they are in the same half of the batch. If a thread begins
    inside a half, each of the thread's parts in this half has its own dictionary. `add_up` adds all dictionaries in the
    order of the parts, so the total has the same bits for any number of threads. Thread i renders the parts from
    bounds[i] to bounds[i + 1].
    """
    sums: list[Sums] = []
    begins = 0  # first part of the half, or of the thread, that part i belongs to
    for i in range(parts):
        if i in _halves(parts) or i in bounds:
            begins = i
        sums.append(sums[-1] if i > begins and begins in _halves(parts) else {})
    return sums


def add_up(sums: Sequence[Sums]) -> Sums:
    """Return the sum of the gradients of all parts; each half of the batch is summed first, then the two halves.

    This order does not depend on the threads, so the sum has the same bits for any number of them.
    """
    ends = [*_halves(len(sums))[1:], len(sums)]
    return _in_order([_in_order(sums[i:end]) for i, end in zip(_halves(len(sums)), ends, strict=True)])


def _halves(parts: int) -> list[int]:
    """Return the index of the first part of each half of a batch; a batch of at most three parts is not halved."""
    middle = (parts + 1) // 2
    return [0, middle] if parts - middle > 1 else [0]


def _in_order(sums: Sequence[Sums]) -> Sums:
    """Return the sum of dictionaries of gradients, added in order to the tensors of the first one.

    A dictionary that parts share is added only once.
    """
    total = dict(sums[0])
    done = {id(sums[0])}
    for further in sums[1:]:
        if id(further) not in done:
            done.add(id(further))
            add_to(total, further)
    return total


class PartResult(NamedTuple):
    """Hold the results of V views of a training step, rendered together. The next step may overwrite the tensors."""

    views: list[int]  # [V] their indices in the batch
    loss: Tensor  # [V] the views' parts of the batch's loss
    drawn: Tensor  # [V, N] bool: which Gaussians were not culled
    g_means2d: Tensor  # [V, N, 2] gradient of the batch's loss by the 2D means, per pixel
    sums: Sums  # gradients of the batch's loss by the parameters, of this part and of those that share the dictionary


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
        self.leaves: list[Tensor] = []  # what the views of a step share, in the same memory in each
        self.replay: StepReplay[PartResult] = StepReplay()

    def __call__(
        self, views: Sequence[View], terms: Sequence[LossTerm] = (), maps: Sequence[ImageMap] = ()
    ) -> list[PartResult]:
        """Render a batch of views and store the gradient of the loss in all parameters.

        The loss is the mean over views of the photometric loss of the mapped render plus weighted terms, plus the
        model's penalty.

        Raises:
            DivergedError: a 3D Gaussian of a view has a value that is not finite.
            InputError: the rasterizer refuses 3D Gaussians for another reason.
            TooLargeError: the memory does not suffice.
        """
        self.terms, self.maps = terms, maps
        with self.stages("slice"), Tape() as tape:
            shared = self._shared()
        sources = [x for x in (*self.parameters, *self.leaves) if x.requires_grad]
        parts = self._parts(views)
        workers = min(len(parts), self.model.backend.workers(self.model.splats["means"]))
        bounds = [len(parts) * worker // workers for worker in range(workers + 1)]
        sums = deal(len(parts), bounds)
        # The gradient of the batch's loss by the loss of each view of a part.
        seed = self.background.new_full((max(map(len, parts)),), 1 / len(views))
        self.model.shared = self.leaves  # views read these in place of computing them
        try:
            results = self.replay(
                self._signature(views, parts, sources, workers),
                [[views[i] for i in part] for part in parts],
                lambda i, observed, stages: self._of_part(parts[i], observed, sources, sums[i], seed, stages),
                lambda work: self._of_all(work, bounds),
            )
        finally:
            self.model.shared = ()
        with self.stages("backward"):
            total = add_up([result.sums for result in results])
            for x, leaf in zip(shared, self.leaves, strict=True):
                if (g := total.get(id(leaf))) is not None:
                    tape.backward(x, g, self.parameters, total)
            for parameter in self.parameters:
                parameter.grad = total.get(id(parameter))
            if (penalty := self.model.penalty()) is not None:  # of parameters alone: not on the tape
                penalty.backward()
        return results

    def _shared(self) -> list[Tensor]:
        """Compute what all views of a step read, and copy it to the leaves by which the views are differentiated."""
        shared = self.model.shared_by_views()
        if [x.shape for x in shared] != [leaf.shape for leaf in self.leaves]:
            self.leaves = [torch.empty_like(x).requires_grad_() for x in shared]
        for leaf, x in zip(self.leaves, shared, strict=True):
            leaf.data.copy_(x)
        return shared

    def _parts(self, views: Sequence[View]) -> list[list[int]]:
        """Return the indices of the views of each part; what is done to single views needs parts of one view."""
        model, like = self.model, self.background
        by_kernels = like.device.type in TOGETHER_ON and model.backend.serves(like)
        if not by_kernels or self.terms or self.maps or model.decodes:
            return [[i] for i in range(len(views))]
        parts: dict[Hashable, list[int]] = {}
        for i, view in enumerate(views):
            camera, pixels = view.camera, view.pixels
            # A call has one size and one near plane, and all of its views have times, or none.
            key = camera.width, camera.height, camera.near, pixels.shape, pixels.dtype, view.time is None
            parts.setdefault(key, []).append(i)
        return list(parts.values())

    def _signature(
        self, views: Sequence[View], parts: list[list[int]], sources: list[Tensor], workers: int
    ) -> Hashable:
        """Return all that the calls of a step depend on, except values of tensors; None if they must not be repeated.

        A model may have attributes that this class does not know, so all its numbers and strings are included. So is
        `model.active`, because the schedule changes which parts of the model act.
        """
        model, sets = self.model, self.model.effect_sets
        by_kernels = self.background.device.type in REPEATED_ON and model.backend.serves(self.background)
        work = sum([work_of(len(model), view.camera.width * view.camera.height) for view in views])
        if self.terms or self.maps or not by_kernels or work > MOST_RECORDED:
            return None
        tensors = [*self.parameters, *self.leaves, *([] if sets is None else [sets.orders, sets.intervals])]
        addresses = tuple([None if x is None else (x.data_ptr(), x.shape) for x in tensors])
        counts = None if sets is None else (sets.refined, sets.conditioned)
        options = tuple([x for x in vars(model).values() if isinstance(x, int | float | str)])
        threads = workers, torch.get_num_threads()
        return addresses, counts, options, model.active, tuple(map(id, sources)), tuple(map(tuple, parts)), threads

    def _of_all(self, work: Callable[[int, Stages], PartResult], bounds: Sequence[int]) -> list[PartResult]:
        """Call `work` for all parts of a batch; thread i does so for the parts bounds[i] to bounds[i + 1]."""
        workers = len(bounds) - 1
        if workers == 1:
            return [work(i, self.stages) for i in range(bounds[1])]
        with self.stages.side_by_side(workers) as clocks:

            def run(worker: int) -> list[PartResult]:
                return [work(i, clocks[worker]) for i in range(bounds[worker], bounds[worker + 1])]

            return [result for part in side_by_side(run, range(workers), workers) for result in part]

    def _of_part(
        self, part: list[int], observed: Observed, sources: list[Tensor], sums: Sums, seed: Tensor, stages: Stages
    ) -> PartResult:
        """Render the views `part` of a batch and add the gradients of their losses to `sums`.

        The numbers of `seed` are the gradient of the batch's loss by the loss of one view.
        """
        with Tape() as tape:
            with stages("slice"):
                queries = [CameraTime.of(*each) for each in zip(observed.cameras, observed.times, strict=True)]
                gaussians = self.model.slices(queries)
            with stages("raster"):
                try:
                    output = render_slices(self.model, gaussians, observed.cameras, self.background, self.antialias)
                except InputError as error:  # the rasterizer checks its inputs, so it is the first to see NaN
                    if all(x.isfinite().all() for x in gaussians if x is not None):
                        raise
                    raise DivergedError(str(error)) from None
            with stages("loss"):
                image = output.image
                for image_map in self.maps:
                    image = image_map(image, part[0])  # the part has one view
                loss = photometric(image, observed.targets(), self.ssim_weight, self.model.backend)
                for weight, term in self.terms:
                    loss = loss + weight * term(queries[0], part[0])
        with stages("backward"):
            means2d, seed = output.info.means2d, seed[: len(part)]
            tape.backward(loss, seed, [*sources, means2d], sums)
            g_means2d = sums.pop(id(means2d), None)
            if g_means2d is None:
                g_means2d = torch.zeros_like(means2d)
            return PartResult(part, loss.detach() * seed, output.info.drawn, g_means2d, sums)
