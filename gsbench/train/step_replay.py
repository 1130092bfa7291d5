"""Record how a training step renders and differentiates its views, and replay this in the steps that follow.

Consecutive steps differ only in the values of tensors, such as the camera, until densification changes the number of
Gaussians, or the schedule changes what is trained. `gsbench.kernels.recording` says why a replay is faster.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import partial
from typing import Any, Generic, NamedTuple, TypeVar

import torch
from torch import Tensor

from gsbench.kernels.recording import OutdatedError, Recording
from gsbench.scenes import Camera, View

GRAPHED_ON = ("cuda",)  # types of devices on which what is recorded becomes CUDA graphs

Stages = Callable[[str], AbstractContextManager[None]]  # `with stages("loss"): ...` marks work of one stage
Result = TypeVar("Result")


class Observed(NamedTuple):
    """What a training step reads of a view."""

    camera: Camera
    time: float | Tensor | None
    target: Tensor  # [H, W, 3] floats in [0, 1] or 8 bits

    def copy(self) -> Observed:
        """Return a copy in memory of its own, which `overwrite` changes."""
        camera = self.camera.clone()
        time = None if self.time is None else camera.K.new_tensor(self.time)
        return Observed(camera, time, self.target.clone())

    def overwrite(self, other: Observed) -> None:
        """Take the values of another view of the same signature."""
        self.camera.overwrite(other.camera)
        self.target.copy_(other.target)
        if isinstance(self.time, Tensor) and other.time is not None:
            self.time.fill_(other.time)

    @property
    def signature(self) -> Hashable:
        """Everything but values: views with equal signatures may overwrite each other."""
        return self.camera.width, self.camera.height, self.time is None, self.target.shape, self.target.dtype


class _RecordedView(Generic[Result]):
    """The recorded work on one view, stage by stage, what it reads, and the result that a repetition overwrites."""

    def __init__(self, work: Callable[[Observed, Stages], Result], observed: Observed, stages: Stages) -> None:
        """Do the work on a copy of `observed`, and record it."""
        self._observed = observed.copy()
        self._recordings: list[tuple[str, Recording]] = []  # by stage

        @contextmanager
        def recorded(stage: str) -> Iterator[None]:
            with stages(stage), Recording() as recording:
                self._recordings.append((stage, recording))
                yield

        self.result = work(self._observed, recorded)
        self.is_repeatable = all(recording.is_repeatable for _, recording in self._recordings)
        if self.is_repeatable and observed.target.device.type in GRAPHED_ON:
            with suppress(RuntimeError):  # then single calls are repeated
                for _, recording in self._recordings:
                    recording.capture()

    @torch.no_grad()
    def repeat(self, observed: Observed, stages: Stages) -> Result:
        self._observed.overwrite(observed)
        for stage, recording in self._recordings:
            with stages(stage):
                recording.repeat()
        return self.result

    def check(self) -> None:
        """Raise OutdatedError if the repetition met other numbers than its calls can work with."""
        for _, recording in self._recordings:
            recording.check()


class StepReplay(Generic[Result]):
    """Does the work of a step on each view of a batch: at first as written, later by repeating a recording.

    `counts` has how many steps were `launched` call by call and how many were `replayed`, and how many of those that
    were launched were recorded (`recordings`); on a GPU the calls of a recording are captured as CUDA graphs.
    """

    def __init__(self) -> None:
        """Start without a recording."""
        self.counts = {"launched": 0, "replayed": 0, "recordings": 0}
        self._signature: Hashable = None
        self._recorded: list[_RecordedView[Result]] = []  # one for each view of a batch
        self._is_repeatable = True

    def __call__(
        self,
        signature: Hashable,
        views: Sequence[View],
        work: Callable[[int, Observed, Stages], Result],
        of_all: Callable[[Callable[[int, Stages], Any]], list[Any]],
    ) -> list[Result]:
        """Return the results of all views; a later call overwrites the tensors in them.

        Args:
            signature: all that the work depends on, except values of tensors; None: it must not be recorded.
            views: the views of the batch.
            work: does the work on one view, whose index is its first argument. All calculations are inside of stages.
            of_all: calls a function for each index of a view, and returns the results in this order.
        """
        observed = [Observed(view.camera, view.time, view.target) for view in views]
        signature = None if signature is None else (signature, *[view.signature for view in observed])
        is_new = signature is None or signature != self._signature
        if is_new:
            self._signature, self._recorded, self._is_repeatable = signature, [], True
        if recorded := self._recorded:
            with suppress(OutdatedError):  # then the work is recorded anew
                results = of_all(lambda index, stages: recorded[index].repeat(observed[index], stages))
                for view in recorded:
                    view.check()
                self.counts["replayed"] += 1
                return results
        self.counts["launched"] += 1
        if is_new or not self._is_repeatable:
            return of_all(lambda index, stages: work(index, observed[index], stages))
        recorded = of_all(lambda index, stages: _RecordedView(partial(work, index), observed[index], stages))
        self._is_repeatable = all(view.is_repeatable for view in recorded)
        self._recorded = recorded if self._is_repeatable else []
        self.counts["recordings"] += self._is_repeatable
        return [view.result for view in recorded]
