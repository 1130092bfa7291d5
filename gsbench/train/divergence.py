"""Check losses and gradients for NaN and infinity with few GPU synchronisations; explain why a training diverged."""

import math

import torch
from torch import Tensor, nn

from gsbench.kernels.adam import are_finite
from gsbench.kernels.backends import CPU
from gsbench.models import GaussianModel

LOOK_EVERY = 50  # steps between two reads of the result on a GPU, since a read synchronises; on a CPU it is 1


class DivergedError(RuntimeError):
    """A loss or a gradient of a training was NaN or infinite."""


class FiniteCheck:
    """Check the loss and the gradients of every step for NaN and infinity.

    On a GPU the result is read only every LOOK_EVERY steps. Until then, the tensor `skip` [] stops the updates: it is 1
    from the first bad step on, and torch's fused Adam reads it as `found_inf`.
    """

    def __init__(self, device: str) -> None:
        """Prepare the checks of a training on `device`, such as "cpu", "cuda" or "cuda:1"."""
        self.every = LOOK_EVERY if device.startswith("cuda") else 1
        self.loss = math.nan  # loss of the last step whose result was read
        self._names: list[str] = []
        self._state = torch.zeros(4, device=device)  # skip, step, index of the first bad group in `_names`, loss
        self.skip = self._state[0]

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
        gradients = {name: [p.grad for p in group if p.grad is not None] for name, group in groups.items()}
        if self.every == 1 and _are_finite([loss, *[g for group in gradients.values() for g in group]]):
            self.loss = float(loss)
            self._state[3] = loss
            return
        self._names = list(gradients)
        bad = torch.stack([*(~_all_finite(group, loss) for group in gradients.values()), ~loss.isfinite()]).float()
        now = torch.stack([bad.amax(), loss.new_full((), step), bad.argmax().float(), loss])
        self._state.copy_(torch.where(self.skip > 0, self._state, now))
        if step % self.every == 0:
            self.look()

    def look(self) -> None:
        """Read the result of all checks so far; on a GPU this waits for the kernels to finish.

        Raises:
            DivergedError: a check failed; the message names the step and the parameter.
        """
        bad, step, which, self.loss = self._state.tolist()
        if not bad:
            return
        if which < len(self._names):
            raise DivergedError(
                f"step {step:.0f}: the gradient of '{self._names[int(which)]}' is not finite (loss {self.loss})"
            )
        raise DivergedError(f"step {step:.0f}: the loss is {self.loss}")


def _are_finite(values: list[Tensor]) -> bool:
    """Return whether all values are finite; if torch's sum of them overflows, also False."""
    if all(CPU.serves(x) for x in values):
        return are_finite(values)
    return math.isfinite(float(sum(x.sum() for x in values)))


def _all_finite(gradients: list[Tensor], like: Tensor) -> Tensor:
    """Return whether all gradients are finite, as a bool tensor [] on the device of `like`."""
    finite = torch.ones_like(like, dtype=torch.bool)
    for gradient in gradients:
        finite = finite & gradient.isfinite().all()
    return finite


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
