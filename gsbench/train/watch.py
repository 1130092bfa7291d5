"""Whether training goes well: the loss, and the first value that is not finite, found without waiting for a GPU."""

import math

import torch
from torch import Tensor, nn

LOOK_EVERY = 50  # steps on a GPU, which a look waits for; on the CPU there is nothing to wait for


class DivergedError(RuntimeError):
    """A loss or a gradient was not finite."""


class Watch:
    """Sees every step's loss and gradients on their device, and raises when they are looked at.

    On a GPU that may be some steps late. So from the first bad step on `skip` [] is 1 instead of 0, and torch's fused
    Adam, which takes it as its `found_inf`, leaves every parameter as it is.
    """

    def __init__(self, device: str) -> None:
        """Watch a training on `device` ("cpu", "cuda", "cuda:1")."""
        self.every = LOOK_EVERY if device.startswith("cuda") else 1
        self.loss = math.nan  # of the step last looked at
        self._names: list[str] = []
        self._state = torch.zeros(4, device=device)  # skip, step, the first bad one of `_names`, loss
        self.skip = self._state[0]

    @torch.no_grad()
    def see(self, step: int, loss: Tensor, groups: dict[str, list[nn.Parameter]]) -> None:
        """Take in a step, before its gradients are applied; every `every` steps, look.

        Raises:
            DivergedError: as `look`.
        """
        gradients = {name: [p.grad for p in group if p.grad is not None] for name, group in groups.items()}
        if self.every == 1:
            # A finite sum hides no NaN. Only where it is not finite, as it may be of large numbers, each is looked at.
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
        """Read what was seen so far.

        Raises:
            DivergedError: with the step and the parameter.
        """
        bad, step, which, self.loss = self._state.tolist()
        if not bad:
            return
        if which < len(self._names):
            raise DivergedError(f"step {step:.0f}: the gradient of '{self._names[int(which)]}' is not finite "
                                f"(loss {self.loss})")  # fmt: skip
        raise DivergedError(f"step {step:.0f}: the loss is {self.loss}")


def _all_finite(gradients: list[Tensor], like: Tensor) -> Tensor:
    """[] bool, on the device."""
    finite = torch.ones_like(like, dtype=torch.bool)
    for gradient in gradients:
        finite = finite & gradient.isfinite().all()
    return finite
