"""Average the parameters of a model over the last steps of a training, to remove the noise of the optimizer.

Polyak and Juditsky 1992, "Acceleration of stochastic approximation by averaging". A model with averaged parameters
costs the same to render.
"""

import sys
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from gsbench.errors import InputError
from gsbench.measure.exact_views import rank
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
        self.first = 0  # the step of the first parameters in the means
        self.means: list[Tensor] = []
        self.kept = 0  # the number of last iterations over which the model's parameters were averaged; 0: they were not

    @torch.no_grad()
    def add(self, step: int) -> None:
        """Add the parameters after a step (counted from 0) to the means; only every tenth step is used."""
        if self.start is None or step < self.start or (step - self.start) % EVERY:
            return
        parameters = [p.detach() for p in self.model.parameters()]
        if not self.count:
            self.first, self.means = step, [torch.zeros_like(p) for p in parameters]
        self.count += 1
        torch._foreach_lerp_(self.means, parameters, 1 / self.count)

    def keep_better(self, last: float, psnr: Callable[[], float], iterations: int) -> float:
        """Replace the model's parameters by their means if this raises PSNR, and delete the means.

        A long training can overfit: its means are then better than its last parameters. In a short training they are
        worse, because the parameters still improve while they are averaged. The last parameters are kept, and a line
        is printed, if PSNR is equal, or a number with neither.

        Args:
            last: PSNR of the model on val, dB.
            psnr: a function that measures it.
            iterations: the number of finished iterations.

        Returns:
            PSNR on val of the parameters that the model has now, dB.
        """
        if self.count:
            self._swap()
            averaged = psnr()
            if rank(averaged) > rank(last):
                self.kept = iterations - self.first
                last = averaged
            else:
                self._swap()
                if rank(averaged) == rank(last):
                    tqdm.write(f"step {iterations}: PSNR on val is {last:.2f} dB with the last and with averaged "
                               f"parameters: it cannot decide, and the last are kept", file=sys.stderr)  # fmt: skip
        self.forget()
        return last

    @torch.no_grad()
    def _swap(self) -> None:
        """Exchange the parameters of the model and their means."""
        for i, parameter in enumerate(self.model.parameters()):
            last = parameter.detach().clone()
            parameter.copy_(self.means[i])
            self.means[i] = last

    def forget(self) -> None:
        """Delete the means."""
        self.count, self.means = 0, []

    def follow(self, rows: Tensor, fresh: Tensor) -> None:
        """Delete the means, because Gaussians were added, removed or reordered."""
        self.forget()

    def state_dict(self) -> dict[str, Any]:
        """Return the means of the parameters and the numbers of averaged steps, for the checkpoint."""
        numbers = {"count": self.count, "first": self.first, "kept": self.kept}
        return numbers | {str(i): mean for i, mean in enumerate(self.means)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the means of the parameters from a checkpoint; raise InputError if they belong to another model."""
        self.count = whole_number("average", state.get("count"), MOST)
        self.first = whole_number("average", state.get("first", 0), MOST)
        self.kept = whole_number("average", state.get("kept", 0), MOST)
        parameters = list(self.model.parameters()) if self.count else []
        given = len(state.keys() - {"count", "first", "kept"})
        if given != len(parameters):
            raise InputError(f"checkpoint: expected {len(parameters)} averaged parameters, got {given}")
        self.means = [tensor(state, str(i), p.shape, p.dtype) for i, p in enumerate(parameters)]
