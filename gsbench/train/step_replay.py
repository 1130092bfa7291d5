"""Record how a training step renders and differentiates its parts, and replay this in the steps that follow.

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
from gsbench.models.render import in_one
from gsbench.scenes import Camera, View

GRAPHED_ON = ("cuda",)  # types of devices on which what is recorded becomes CUDA graphs

Stages = Callable[[str], AbstractContextManager[None]]  # `with stages("loss"): ...` marks work of one stage
Result = TypeVar("Result")


class Observed(NamedTuple):
    """What a training step reads of the V views of a part."""

    cameras: list[Camera]
    times: list[float | Tensor | None]
    images: list[Tensor]  # [V] of [H, W, 3] floats in [0, 1] or 8 bits
    together: Tensor | None = None  # [V, H, W, 3] the images, if they are in one memory

    def targets(self) -> Tensor:
        """Return the images that the loss takes, [V, H, W, 3]."""
        return in_one(self.images) if self.together is None else self.together

    def copy(self) -> Observed:
        """Return a copy in memory of its own, which `overwrite` changes."""
        cameras, together = [camera.clone() for camera in self.cameras], torch.stack(self.images)
        K = cameras[0].K
        times: list[float | Tensor | None] = [None if time is None else K.new_tensor(time) for time in self.times]
        return Observed(cameras, times, list(together.unbind()), together)

    def overwrite(self, other: Observed) -> None:
        """Take the values of views of the same signature."""
        torch._foreach_copy_(self.images, other.images)  # views of `together`; on a GPU in one launch
        torch._foreach_copy_(_tensors_of(self.cameras), _tensors_of(other.cameras))
        for kept, time in zip(self.times, other.times, strict=True):
            if isinstance(kept, Tensor) and time is not None:
                kept.fill_(time)

    @classmethod
    def of(cls, views: Sequence[View]) -> Observed:
        """Take what is read of views; nothing is copied."""
        return cls([view.camera for view in views], [view.time for view in views], [view.target for view in views])

    @property
    def signature(self) -> Hashable:
        """Everything but values: parts with equal signatures may overwrite each other."""
        camera, image = self.cameras[0], self.images[0]
        return camera.width, camera.height, camera.near, self.times[0] is None, image.shape, image.dtype


def _tensors_of(cameras: Sequence[Camera]) -> list[Tensor]:
    """Return what differs between cameras of one size."""
    return [x for camera in cameras for x in (camera.viewmat, camera.K, camera.center)]


class Recorded(Generic[Result]):
    """Work that was recorded, stage by stage, and the result that a repetition overwrites."""

    def __init__(self, work: Callable[[Stages], Result], stages: Stages, device: str) -> None:
        """Do the work, all of whose calculations are inside of stages, and record it; `device` is a type."""
        self._recordings: list[tuple[str, Recording]] = []  # by stage

        @contextmanager
        def recorded(stage: str) -> Iterator[None]:
            with stages(stage), Recording() as recording:
                self._recordings.append((stage, recording))
                yield

        self.result = work(recorded)
        self.is_repeatable = all(recording.is_repeatable for _, recording in self._recordings)
        if self.is_repeatable and device in GRAPHED_ON:
            with suppress(RuntimeError):  # then single calls of this stage and of later ones are repeated
                for _, recording in self._recordings:
                    recording.capture()

    @torch.no_grad()
    def repeat(self, stages: Stages) -> Result:
        """Do the work again, with the present values of the tensors that it reads."""
        for stage, recording in self._recordings:
            with stages(stage):
                recording.repeat()
        return self.result


class _RecordedPart(Recorded[Result]):
    """The recorded work on one part, and the copy of the views that it reads."""

    def __init__(self, work: Callable[[Observed, Stages], Result], observed: Observed, stages: Stages) -> None:
        self._observed = observed.copy()
        super().__init__(partial(work, self._observed), stages, observed.images[0].device.type)

    def repeat_on(self, observed: Observed, stages: Stages) -> Result:
        self._observed.overwrite(observed)
        return self.repeat(stages)


class StepReplay(Generic[Result]):
    """Does the work of a step on each part of a batch: at first as written, later by repeating a recording.

    `counts` has how many steps were `launched` call by call and how many were `replayed`, and how many of those that
    were launched were recorded (`recordings`); on a GPU the calls of a recording are captured as CUDA graphs.
    """

    def __init__(self) -> None:
        self.counts = {"launched": 0, "replayed": 0, "recordings": 0}
        self.forget()

    def forget(self) -> None:
        """Launch the next step call by call, and record the one after it."""
        self._signature: Hashable = None
        self._recorded: list[_RecordedPart[Result]] = []  # one for each part of a batch
        self._is_repeatable = True

    @property
    def recording(self) -> int | None:
        """Return a number of the recording whose memory the last results are in; None: they are of no recording."""
        return self.counts["recordings"] if self._recorded else None

    def __call__(
        self,
        signature: Hashable,
        parts: Sequence[Sequence[View]],
        work: Callable[[int, Observed, Stages], Result],
        of_all: Callable[[Callable[[int, Stages], Any]], list[Any]],
    ) -> list[Result]:
        """Return the results of all parts; a later call overwrites the tensors in them.

        The first step with a signature is launched, the second is launched and recorded, and all further ones replayed.

        Args:
            signature: all that the work depends on, except values of tensors; None: it must not be recorded.
            parts: the views of the batch that are rendered together, of equal size.
            work: does the work on one part, whose index is its first argument. All calculations are inside of stages.
            of_all: calls a function for each index of a part, and returns the results in this order.
        """
        observed = [Observed.of(views) for views in parts]
        signature = None if signature is None else (signature, *[part.signature for part in observed])
        is_new = signature is None or signature != self._signature
        if is_new:
            self._signature, self._recorded, self._is_repeatable = signature, [], True
        if recorded := self._recorded:
            with suppress(OutdatedError):  # then the work is recorded anew
                results = of_all(lambda index, stages: recorded[index].repeat_on(observed[index], stages))
                self.counts["replayed"] += 1
                return results
        self.counts["launched"] += 1
        if is_new or not self._is_repeatable:  # a recording must not make again what is made at first use
            return of_all(lambda index, stages: work(index, observed[index], stages))
        recorded = of_all(lambda index, stages: _RecordedPart(partial(work, index), observed[index], stages))
        self._is_repeatable = all(part.is_repeatable for part in recorded)
        self._recorded = recorded if self._is_repeatable else []
        self.counts["recordings"] += self._is_repeatable
        return [part.result for part in recorded]
