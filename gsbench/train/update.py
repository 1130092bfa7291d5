"""Use the gradients of a training step: check them, add up what density control needs, and update the model by Adam.

While steps repeat a recording (`gsbench.train.step_replay`), their gradients are in the same memory, so this work is
recorded and repeated too.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence

import torch
from torch import Tensor

from gsbench.measure.speed import StageClock
from gsbench.scenes import View
from gsbench.train.density.control import DensityControl
from gsbench.train.divergence import FiniteCheck
from gsbench.train.optim import Optimizer
from gsbench.train.rows import Rows
from gsbench.train.step import PartResult
from gsbench.train.step_replay import Recorded, Stages, StepReplay


class Update:
    """Update a model by the gradients that its parameters have."""

    def __init__(
        self,
        optimizer: Optimizer,
        check: FiniteCheck,
        density: DensityControl,
        rows: Rows,
        replay: StepReplay[PartResult],  # of the gradients
        stages: StageClock,
    ) -> None:
        self.optimizer = optimizer
        self.check = check
        self.density = density
        self.replay = replay
        self.stages = stages
        optimizer.skip = check.skip
        rows.add(lambda *_: self.forget())
        self.forget()

    def forget(self) -> None:
        """Record anew, after moments or statistics were replaced."""
        self._signature: Hashable = None  # of what is recorded
        self._recorded: Recorded[None] | None = None

    def __call__(
        self,
        step: int,
        views: Sequence[View],
        results: Sequence[PartResult],  # of the step, all views together
        factors: dict[str, float],  # of the learning rates, by group
    ) -> None:
        """Update the model once, then delete the gradients.

        Raises:
            DivergedError: the loss or a gradient was not finite, in this step or since the last look. No bad gradient
                is used, and the present gradients are kept to say which Gaussian has them.
        """
        self.optimizer.begin(step, factors)
        self._do(step, views, results)
        self.check.end(step)
        self.optimizer.end()

    @torch.no_grad()
    def _do(self, step: int, views: Sequence[View], results: Sequence[PartResult]) -> None:
        """Check, update and accumulate; by repeating a recording if this has the same memory and the same work."""

        def work(stages: Stages) -> None:
            with stages("optimizer"):
                self.check.check(_joined([part.loss for part in results]), self.optimizer.groups)
                drawn = _joined([part.drawn for part in results]).any(0) if self.optimizer.is_sparse else None
                self.optimizer.update(drawn)
            with stages("density"):
                self.density.accumulate(step, views, results, self.check.skip)

        gradients = [None if p.grad is None else p.grad.data_ptr() for p in self.optimizer.parameters]
        signature = self.replay.recording, self.density.accumulates(step), tuple(gradients)
        if self.replay.recording is None or signature != self._signature:
            self.forget()
            self._signature = signature
            work(self.stages)  # not recorded: a recording must not make again what is made at first use
        elif self._recorded is None or not self._recorded.is_repeatable:
            self._recorded = Recorded(work, self.stages, self.check.skip.device.type)
        else:
            self._recorded.repeat(self.stages)


def _joined(parts: list[Tensor]) -> Tensor:
    """Join tensors, without a copy if there is only one."""
    return parts[0] if len(parts) == 1 else torch.cat(parts)
