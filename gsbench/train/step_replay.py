"""Record how a training step renders and differentiates its views, and replay this in the steps that follow.

Consecutive steps differ only in the values of tensors, such as the camera, until densification changes the number of
Gaussians, or the schedule changes what is trained. `gsbench.kernels.recording` says why a replay is faster.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

import torch
from torch import Tensor

from gsbench.kernels.recording import OutdatedError, Recording
from gsbench.scenes import Camera, View

Stages = Callable[[str], AbstractContextManager[None]]  # `with stages("loss"): ...` marks work of one stage
Result = TypeVar("Result")


class Observed(NamedTuple):
    """What a training step reads of a view."""

    camera: Camera
    time: float | Tensor | None
    target: Tensor  # [H, W, 3] floats in [0, 1] or 8 bits

    @classmethod
    def of(cls, view: View) -> Observed:
        """Take it from a view."""
        return cls(view.camera, view.time, view.target)

    def copy(self) -> Observed:
        """Return a copy in memory of its own, which `overwrite` changes."""
        camera = self.camera.clone()
        time = None if self.time is None else camera.K.new_tensor(self.time)
        return Observed(camera, time, self.target.clone())

    def overwrite(self, other: Observed) -> None:
        """Take the values of another view of the same size."""
        self.camera.overwrite(other.camera)
        self.target.copy_(other.target)
        if isinstance(self.time, Tensor) and other.time is not None:
            self.time.fill_(other.time)

    @property
    def signature(self) -> Hashable:
        """Everything but values: views with equal signatures may overwrite each other."""
        return self.camera.width, self.camera.height, self.time is None, self.target.shape, self.target.dtype


class _StagedRecording:
    """Records the blocks `with staged(name): ...`, and also times each one as a stage."""

    def __init__(self, stages: Stages) -> None:
        self._stages = stages
        self._blocks: list[tuple[str, Recording]] = []

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        with self._stages(name), Recording() as recording:
            self._blocks.append((name, recording))
            yield

    @property
    def is_repeatable(self) -> bool:
        return all(recording.is_repeatable for _, recording in self._blocks)

    def repeat(self, stages: Stages) -> None:
        for name, recording in self._blocks:
            with stages(name):
                recording.repeat()


@dataclass(frozen=True)
class _Recorded(Generic[Result]):
    """The recorded work on one view: what it reads, the recording, and the result that a repetition overwrites."""

    observed: Observed
    work: _StagedRecording
    result: Result

    @torch.no_grad()
    def repeat(self, observed: Observed, stages: Stages) -> Result:
        self.observed.overwrite(observed)
        self.work.repeat(stages)
        return self.result


class StepReplay(Generic[Result]):
    """Does the work of a step on each view of a batch: at first as written, later by repeating a recording."""

    def __init__(self) -> None:
        """Start without a recording."""
        self._signature: Hashable = None
        self._recorded: dict[int, _Recorded[Result]] = {}  # by the index of the view in the batch
        self._is_repeatable = True

    def __call__(
        self,
        signature: Hashable,
        views: Sequence[View],
        see: Callable[[int, Observed, Stages], Result],
        of_all: Callable[[Callable[[int, Stages], Result]], list[Result]],
    ) -> list[Result]:
        """Return the results of all views; a later call overwrites the tensors in them.

        Args:
            signature: all that the work depends on, except values of tensors; None: it must not be recorded.
            views: the views of the batch.
            see: does the work on one view, given its index. All calculations must be inside of stages.
            of_all: calls a function for each index of a view, and returns the results.
        """
        observed = [Observed.of(view) for view in views]
        signature = None if signature is None else (signature, *[view.signature for view in observed])
        is_new = signature is None or signature != self._signature
        if is_new:
            self._signature, self._recorded, self._is_repeatable = signature, {}, True
        if self._recorded:
            recorded = self._recorded
            try:
                return of_all(lambda index, stages: recorded[index].repeat(observed[index], stages))
            except OutdatedError:
                self._recorded = {}
        if is_new or not self._is_repeatable:
            return of_all(lambda index, stages: see(index, observed[index], stages))
        recordings: dict[int, _Recorded[Result]] = {}

        def record(index: int, stages: Stages) -> Result:
            copied, work = observed[index].copy(), _StagedRecording(stages)
            recordings[index] = _Recorded(copied, work, see(index, copied, work))
            return recordings[index].result

        results = of_all(record)
        self._is_repeatable = all(recorded.work.is_repeatable for recorded in recordings.values())
        if self._is_repeatable:
            self._recorded = recordings
        return results
