"""Check losses and gradients for NaN and infinity with few GPU synchronisations; explain why a training diverged."""

import math

import torch
from torch import Tensor, nn

from gsbench.kernels.adam import flag_arrays
from gsbench.kernels.backends import AUTO
from gsbench.models import GaussianModel

LOOK_EVERY = 50  # steps between two reads of the result on a GPU, since a read synchronises; on a CPU it is 1


class DivergedError(RuntimeError):
    """A loss or a gradient of a training was NaN or infinite."""


class FiniteCheck:
    """Check the loss and the gradients of every step for NaN and infinity.

    From the first bad step on, the tensor `skip` [] is 1, and Adam reads it. So nothing is updated until the CPU looks:
    on a GPU every LOOK_EVERY steps and before what cannot be skipped, because it then waits, and on a CPU after each
    step.
    """

    def __init__(self, device: str) -> None:
        """Prepare the checks of a training on `device`, such as "cpu", "cuda" or "cuda:1"."""
        self.every = LOOK_EVERY if device.startswith("cuda") else 1
        self.loss = math.nan  # loss of the last good step that was looked at
        self.bad: int | None = None  # the first bad step, once the CPU has looked
        self.skip = torch.zeros((), device=device)
        self._names: list[str] = []  # the group of each parameter
        # [parameters + 2]: for each gradient and for the loss, 1 once it was not finite, else 0; then the last loss
        self._result = torch.empty(0)
        self._steps: list[int] = []  # since the last look
        self._results = torch.empty(0)  # [every, parameters + 2]: `_result` after each of these steps

    @torch.no_grad()
    def check(self, losses: Tensor, groups: dict[str, list[nn.Parameter]]) -> None:
        """Check the loss, the sum of `losses` [V], and the gradients of all groups, before Adam uses them.

        This can be recorded and repeated in other steps.
        """
        gradients = [p.grad for group in groups.values() for p in group]
        if len(self._result) != len(gradients) + 2:  # at first use
            self._names = [name for name, group in groups.items() for _ in group]
            self._result = losses.new_zeros(len(gradients) + 2)
            self._results = self._result.new_empty(self.every, len(self._result))
        loss = self._result[-1]  # [] in the memory of the result
        torch.sum(losses, 0, out=loss)
        _flag([*gradients, loss], self._result[:-1], self.skip)

    def end(self, step: int) -> None:
        """Look at the result of the checks if it is time, after each step that was checked.

        Raises:
            DivergedError: as `look`.
        """
        self._results[len(self._steps)].copy_(self._result)
        self._steps.append(step)
        if len(self._steps) == self.every:
            self.look()

    def look(self) -> None:
        """Read the result of all checks so far; on a GPU this waits for the kernels to finish.

        Raises:
            DivergedError: a check failed; the message names the step and the parameter.
        """
        for step, (*flags, loss) in zip(self._steps, self._results.tolist(), strict=False):  # the last rows may be old
            if any(flags):
                self.bad = step
                bad = flags.index(1)
                if bad == len(self._names):  # the flag after those of the gradients
                    raise DivergedError(f"step {step}: the loss is {loss}")
                raise DivergedError(f"step {step}: the gradient of '{self._names[bad]}' is not finite (loss {loss})")
            self.loss = loss
        self._steps.clear()

    def forget(self) -> None:
        """Start again after a bad step, as if it had not been done."""
        self.bad = None
        self.skip.zero_()
        self._result.zero_()
        self._steps.clear()


def _flag(arrays: list[Tensor | None], flags: Tensor, skip: Tensor) -> None:
    """Set `flags` [arrays] to 1 for arrays that are not finite, and then `skip` [] to 1."""
    if AUTO.serves(skip) and all(x is None or x.dtype == skip.dtype for x in arrays):
        flag_arrays(arrays, flags, skip)
        return
    for flag, x in zip(flags, arrays, strict=True):
        if x is not None:
            flag.masked_fill_(~x.isfinite().all(), 1)
    skip.masked_fill_(flags.any(), 1)


def explain(model: GaussianModel) -> str:
    """Name the first Gaussian with a NaN or infinite gradient; if there is none, name what else may have caused it."""
    for name, parameter in model.splats.items():
        if parameter.grad is None:
            continue
        rows = parameter.grad.reshape(len(parameter), math.prod(parameter.shape[1:]))  # flatten(1) refuses [N]
        bad = ~rows.isfinite().all(1)
        if bad.any():
            return f"the first is Gaussian {int(bad.nonzero()[0])} of {len(bad)} in '{name}' ({int(bad.sum())} in all)"
    where = "AGR's networks or lambda" if model.refinement is not None else "the learning rates"
    return f"no Gaussian's gradient is: look at {where}"  # completes the message of a DivergedError
