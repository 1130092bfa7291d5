"""Average the parameters of a model over the last steps of a training, to remove the noise of the optimizer.

Polyak and Juditsky 1992, "Acceleration of stochastic approximation by averaging". A model with averaged parameters
costs the same to render.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

from gsbench.config_key import joins, key
from gsbench.errors import InputError
from gsbench.measure.exact_views import rank
from gsbench.train.hooks import Hook, Training, check_step

if TYPE_CHECKING:
    from torch import Tensor

    from gsbench.config import Config

EVERY = 10  # every tenth step is added: nearby steps hardly differ, and adding costs half of an Adam step


@joins("train")
@dataclass
class AverageKey:
    """The key of this hook."""

    average_from: int | None = key(None, "step from which parameters are averaged; kept if better on val", low=0)


class Average(Hook):
    """Hold the running mean of all parameters over every tenth step, from `train.average_from` on.

    It starts again when Gaussians are added, removed or reordered. The training ends with the means if these have a
    higher PSNR on val: a long training can overfit. In a short training the parameters still improve, so the means are
    worse. They are not used if results are measured on val, which would be too high then.
    """

    name = "average"

    def __init__(self, training: Training) -> None:
        super().__init__(training)
        start = cast(AverageKey, training.config.train).average_from
        self.start = None if start is None else training.schedule.scaled(start)
        self.count = 0  # how many steps are in the means
        self.first = 0  # the step of the first parameters in the means
        self.means: list[Tensor] = []
        self.kept = 0  # the number of last iterations over which the model's parameters were averaged; 0: they were not

    @classmethod
    def check(cls, config: Config) -> None:
        check_step("train.average_from", cast(AverageKey, config.train).average_from, config)

    def acts(self, step: int) -> bool:
        return self.start is not None and step >= self.start and (step - self.start) % EVERY == 0

    def after_step(self, step: int) -> None:
        """Add the parameters to the means; only every tenth step is used."""
        import torch

        if not self.acts(step):
            return
        parameters = [p.detach() for p in self.training.model.parameters()]
        if not self.count:
            self.first, self.means = step, [torch.zeros_like(p) for p in parameters]
        self.count += 1
        torch._foreach_lerp_(self.means, parameters, 1 / self.count)

    def after_measuring(self, finished: int, psnr: float) -> float:
        """Replace the parameters by their means after the last step, if PSNR on val is higher with them."""
        training = self.training
        if finished < training.config.train.iterations:
            return psnr
        if self.count and training.scene.val and training.config.scene.eval_split != "val":
            self._swap()
            averaged = training.psnr(training.scene.val)
            if rank(averaged) > rank(psnr):  # NaN is below all numbers
                self.kept = finished - self.first
                training.report(
                    f"step {finished}: PSNR on val is {averaged - psnr:.2f} dB higher with parameters "
                    f"averaged over the last {self.kept} iterations: the training ends with "
                    f"these"
                )
                psnr = averaged
            else:
                self._swap()
                if rank(averaged) == rank(psnr):
                    training.report(
                        f"step {finished}: PSNR on val is {psnr:.2f} dB with the last and with averaged "
                        f"parameters: it cannot decide, and the last are kept"
                    )
        self._forget()  # the final checkpoint need not hold the means
        return psnr

    def _swap(self) -> None:
        """Exchange the parameters of the model and their means."""
        for i, parameter in enumerate(self.training.model.parameters()):
            last = parameter.detach().clone()
            parameter.data.copy_(self.means[i])
            self.means[i] = last

    def _forget(self) -> None:
        self.count, self.means = 0, []

    def reindex(self, rows: Tensor, fresh: Tensor) -> None:
        self._forget()

    def state_dict(self) -> dict[str, Any]:
        means = {str(i): mean for i, mean in enumerate(self.means)}
        return {"count": self.count, "first": self.first, "kept": self.kept, "means": means}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        from gsbench.train.checkpoint import MOST_STEPS, tensor, whole_number

        self.count, self.first, self.kept = (
            whole_number(f"average.{name}", state.get(name), MOST_STEPS) for name in ("count", "first", "kept")
        )
        parameters, means = list(self.training.model.parameters()) if self.count else [], state["means"]
        if len(means) != len(parameters):
            raise InputError(f"checkpoint: expected {len(parameters)} averaged parameters, got {len(means)}")
        self.means = [tensor(means, str(i), p.shape, p.dtype) for i, p in enumerate(parameters)]

    def results(self) -> dict[str, Any]:
        return {"averaged": self.kept}
