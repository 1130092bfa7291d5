"""Check every loss and gradient of a training for NaN and infinity, without a wait for the GPU at every step."""

import math

import torch
from torch import Tensor, nn

LOOK_EVERY = 50  # steps on a GPU, since a look waits for it; on the CPU every step is looked at


class DivergedError(RuntimeError):
    """A loss or a gradient was not finite."""


class FiniteCheck:
    """Checks the loss and the gradients of every step on their device, and raises when the result is read.

    On a GPU the result is read some steps later. From the first bad step on, `skip` [] is therefore 1 instead of 0, and
    torch's fused Adam, which takes it as its `found_inf`, changes no parameter.
    """

    def __init__(self, device: str) -> None:
        """Check a training on `device` ("cpu", "cuda", "cuda:1")."""
        self.every = LOOK_EVERY if device.startswith("cuda") else 1
        self.loss = math.nan  # of the last step that was read
        self._names: list[str] = []
        self._state = torch.zeros(4, device=device)  # skip, step, the first bad one of `_names`, loss
        self.skip = self._state[0]

    @torch.no_grad()
    def see(self, step: int, loss: Tensor, groups: dict[str, list[nn.Parameter]]) -> None:
        """Check a step before its gradients are applied; `look` every `every` steps.

        Raises:
            DivergedError: as `look`.
        """
        gradients = {name: [p.grad for p in group if p.grad is not None] for name, group in groups.items()}
        if self.every == 1:
            # A finite sum contains no NaN. A sum of large numbers may overflow; then each gradient is checked.
            total = sum([g.sum() for given in gradients.values() for g in given], loss)
            if math.isfinite(float(total)):
                self.loss = float(loss)
                self._state[3] = loss
                return
        self._names = list(gradients)
        bad = torch.stack([*(~_all_finite(given, loss) for given in gradients.values()), ~loss.isfinite()]).float()
        now = torch.stack([bad.amax(), loss.new_full((), step), bad.argmax().float(), loss])
        self._state.copy_(torch.where(self.skip > 0, self._state, now))
        if step % self.every == 0:
            self.look()

    def look(self) -> None:
        """Read the result of the checks so far.

        Raises:
            DivergedError: a check failed; the message names the step and the parameter.
        """
        bad, step, which, self.loss = self._state.tolist()
        if not bad:
            return
        if which < len(self._names):
            raise DivergedError(f"step {step:.0f}: the gradient of '{self._names[int(which)]}' is not finite "
                                f"(loss {self.loss})")  # fmt: skip
        raise DivergedError(f"step {step:.0f}: the loss is {self.loss}")


def _all_finite(gradients: list[Tensor], like: Tensor) -> Tensor:
    """Tell whether all gradients are finite, as [] bool on the device."""
    finite = torch.ones_like(like, dtype=torch.bool)
    for gradient in gradients:
        finite = finite & gradient.isfinite().all()
    return finite
