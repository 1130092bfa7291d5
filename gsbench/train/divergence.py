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

    On a GPU the result is read only every LOOK_EVERY steps. Until then, the tensor `skip` [] stops the updates: it is 1
    from the first bad step on, and Adam reads it.
    """

    def __init__(self, device: str) -> None:
        """Prepare the checks of a training on `device`, such as "cpu", "cuda" or "cuda:1"."""
        self.every = LOOK_EVERY if device.startswith("cuda") else 1
        self.loss = math.nan  # loss of the last step whose result was read
        self.skip = torch.zeros((), device=device)
        self._names: list[str] = []  # the group of each parameter
        self._steps: list[tuple[int, Tensor]] = []  # number and loss of each step since the last look
        self._flags = torch.empty(0)  # [every, parameters + 1] bool: what of each of these steps is not finite

    @torch.no_grad()
    def check(self, step: int, loss: Tensor, groups: dict[str, list[nn.Parameter]]) -> None:
        """Check the loss and the gradients of a step, before the optimizer uses them.

        Args:
            step: the number of the step.
            loss: the loss, [].
            groups: the parameters by group.

        Raises:
            DivergedError: a check failed, in this step or since the result was last read.
        """
        arrays = [*[p.grad for group in groups.values() for p in group], loss]
        if self._flags.shape != (self.every, len(arrays)):
            self._names = [name for name, group in groups.items() for _ in group]
            self._flags = torch.zeros(self.every, len(arrays), dtype=torch.bool, device=loss.device)
        _flag(arrays, self._flags[len(self._steps)], self.skip)
        self._steps.append((step, loss))
        if len(self._steps) == self.every:
            self.look()

    def look(self) -> None:
        """Read the result of all checks so far; on a GPU this waits for the kernels to finish.

        Raises:
            DivergedError: a check failed; the message names the step and the parameter.
        """
        for (step, loss), flags in zip(self._steps, self._flags.tolist(), strict=False):
            if any(flags):
                self.loss = float(loss)
                bad = flags.index(True)
                if bad == len(self._names):
                    raise DivergedError(f"step {step}: the loss is {self.loss}")
                raise DivergedError(
                    f"step {step}: the gradient of '{self._names[bad]}' is not finite (loss {self.loss})"
                )
        if self._steps:
            self.loss = float(self._steps[-1][1])
            self._steps.clear()


def _flag(arrays: list[Tensor | None], flags: Tensor, skip: Tensor) -> None:
    """Set `flags` [arrays] to true for arrays that are not finite, and then `skip` [] to 1."""
    if AUTO.serves(skip) and all(x is None or x.dtype == skip.dtype for x in arrays):
        flag_arrays(arrays, flags, skip)
        return
    for flag, x in zip(flags, arrays, strict=True):
        if x is not None:
            flag.copy_(~x.isfinite().all())
    skip.masked_fill_(flags.any(), 1)


def explain(model: GaussianModel) -> str:
    """Name the first Gaussian with a NaN or infinite gradient; if there is none, name what else may have caused it."""
    for name, parameter in model.splats.items():
        if parameter.grad is None:
            continue
        bad = ~parameter.grad.reshape(len(parameter), math.prod(parameter.shape[1:])).isfinite().all(1)
        if bad.any():
            return f"the first is Gaussian {int(bad.nonzero()[0])} of {len(bad)} in '{name}' ({int(bad.sum())} in all)"
    where = "AGR's networks or lambda" if model.refinement is not None else "the learning rates"
    return f"no Gaussian's gradient is: look at {where}"
