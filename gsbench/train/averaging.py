"""Average the parameters of a model over the last steps of a training, to remove the noise of the optimizer.

Polyak and Juditsky 1992, "Acceleration of stochastic approximation by averaging". A model with averaged parameters
costs the same to render.
"""

from typing import Any

import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.models import GaussianModel
from gsbench.train.checkpoint import tensor, whole_number

EVERY = 10  # every tenth step is added: nearby steps hardly differ, and adding costs half of an Adam step
MOST = 10**9  # no training has more steps
NO_AVERAGE: dict[str, Any] = {"count": 0}  # the state of a checkpoint from before there were averages


class Average:
    """Hold the running mean of all parameters over every tenth step, from step `start` of a training on.

    The mean is started again from zero steps if Gaussians are added, removed or reordered.
    """

    def __init__(self, model: GaussianModel, start: int | None) -> None:
        """Average the parameters of a model from step `start` on; do nothing if `start` is None."""
        self.model = model
        self.start = start
        self.count = 0
        self.means: list[Tensor] = []

    @torch.no_grad()
    def add(self, step: int) -> None:
        """Add the parameters after a step (counted from 0) to the means; only every tenth step is used."""
        if self.start is None or step < self.start or (step - self.start) % EVERY:
            return
        parameters = [p.detach() for p in self.model.parameters()]
        if not self.count:
            self.means = [torch.zeros_like(p) for p in parameters]
        self.count += 1
        torch._foreach_lerp_(self.means, parameters, 1 / self.count)

    @torch.no_grad()
    def take(self) -> None:
        """Replace the parameters of the model by their means over steps; do nothing if no step was added."""
        if self.count:
            for parameter, mean in zip(self.model.parameters(), self.means, strict=True):
                parameter.copy_(mean)
            self.count, self.means = 0, []

    def follow(self, rows: Tensor, fresh: Tensor) -> None:
        """Delete the means, because Gaussians were added, removed or reordered."""
        self.count, self.means = 0, []

    def state_dict(self) -> dict[str, Any]:
        """Return the means of the parameters and the number of averaged steps, for the checkpoint."""
        return {"count": self.count, **{str(i): mean for i, mean in enumerate(self.means)}}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the means of the parameters from a checkpoint; raise InputError if they belong to another model."""
        self.count = whole_number("average", state.get("count"), MOST)
        parameters = list(self.model.parameters()) if self.count else []
        if len(state) != 1 + len(parameters):
            raise InputError(f"checkpoint: expected {len(parameters)} averaged parameters, got {len(state) - 1}")
        self.means = [tensor(state, str(i), p.shape, p.dtype) for i, p in enumerate(parameters)]
