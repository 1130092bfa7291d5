"""Optimize by Adam, with a learning rate for each parameter group and moments that follow the Gaussians."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator
from functools import cached_property
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from gsbench.errors import InputError, did_you_mean
from gsbench.kernels.adam import adam, adam_all
from gsbench.models import GaussianModel
from gsbench.train.checkpoint import tensor

if TYPE_CHECKING:  # config.py needs hydra, which a machine that checks kernels may lack
    from gsbench.config import LearningRate, ModelConfig, TrainConfig

OPTIMIZERS = ("adam", "sparse_adam")
BETAS, EPS = (0.9, 0.999), 1e-15
COOLED = 0.1  # share of a learning rate that is left at the end of a cooldown


class Optimizer:
    """Adam over a model's parameter groups (eps 1e-15, as 3DGS).

    One call of the CPU's kernel updates its parameters. torch.optim.Adam updates those of a GPU and of the reference.

    `adam` moves Gaussians that no view of the batch sees by their remaining momentum. `sparse_adam` leaves them and
    their moments unchanged (Mallick et al. 2024, Taming 3DGS). Where all Gaussians are visible the two are the same.
    """

    def __init__(
        self, model: GaussianModel, config: ModelConfig, train: TrainConfig, extent: float, kind: str = "adam"
    ) -> None:
        """Make a parameter group for each name of `model.groups()`.

        Args:
            model: the initialised model.
            config: the model's config, with the learning rates.
            train: the config with the length of the run, and the length that the rates are stated for.
            extent: the scene's extent, world units.
            kind: the optimizer, one of OPTIMIZERS.

        Raises:
            InputError: a parameter has no learning rate, or a rate is for a parameter that no variant of the model has.
        """
        groups = model.groups()
        for name in groups:
            if name not in config.lr:
                raise InputError(f"model.lr: expected a learning rate for each of {sorted(groups)}, '{name}' has none")
        for name in config.lr:
            if name not in {*groups, "refinement", "lambda"}:
                raise InputError(f"model.lr: model '{config.name}' has no '{name}'. {did_you_mean(name, groups)}")
        self.groups = groups
        self.rates = {name: config.lr[name] for name in groups}
        self.model = model
        self.train = train
        self.extent = extent
        self.is_sparse = kind == "sparse_adam"
        # Of each parameter, named as torch.optim.Adam names them.
        self.moments: defaultdict[Tensor, dict[str, Tensor]] = defaultdict(dict)
        self.skip: Tensor | None = None  # a GPU's finite check, [] 1 if a step is to change nothing

    @cached_property
    def torch_adam(self) -> torch.optim.Adam:
        """torch's Adam over the same groups and moments. Made when it is needed: it takes a second to import."""
        groups = [{"params": parameters, "name": name} for name, parameters in self.groups.items()]
        adam = torch.optim.Adam(groups, lr=0.0, betas=BETAS, eps=EPS, fused=True)
        adam.state = self.moments
        return adam

    def step(
        self,
        step: int,
        drawn: Tensor | None,  # [N] bool
        slowed: float = 1.0,
    ) -> None:
        """Update the parameters that have a gradient, at the rates of this step, and drop the gradients.

        If `skip` [] is 1, nothing is updated.

        Args:
            step: number of the step, counted from 0.
            drawn: the Gaussians that some view of the batch sees, which `sparse_adam` needs; the others have no
                gradient.
            slowed: factor of AGR's learning rate.
        """
        rates = self.rates_at(step, slowed)
        by_kernel: list[tuple[nn.Parameter, float]] = []
        rest_has_gradients = False
        for name, parameters in self.groups.items():
            if self.is_sparse and name in self.model.splats:
                assert drawn is not None
                self._step_rows(parameters[0], rates[name], drawn)
            for parameter in parameters:
                if parameter.grad is not None and self._is_native(parameter):
                    by_kernel.append((parameter, rates[name]))
                elif parameter.grad is not None:
                    rest_has_gradients = True
        if by_kernel:
            self._step_all(by_kernel)
        if rest_has_gradients:
            for group in self.torch_adam.param_groups:
                group["lr"] = rates[group["name"]]
            if self.skip is not None:
                self.torch_adam.found_inf = self.skip  # type: ignore[attr-defined]
            self.torch_adam.step()
            self.torch_adam.zero_grad(set_to_none=True)

    def rates_at(self, step: int, slowed: float = 1.0) -> dict[str, float]:
        """Return the learning rate of each group at a step; `slowed` is a factor of AGR's."""
        rates = {name: rate_at(rate, step, self.train, self.extent) for name, rate in self.rates.items()}
        return {name: rate * slowed if name == "refinement" else rate for name, rate in rates.items()}

    def _is_native(self, parameter: Tensor) -> bool:
        """Tell whether the kernel of the CPU updates a parameter."""
        return parameter.device.type == "cpu" and self.model.backend.serves(parameter) and self.skip is None

    def _state_of(self, parameter: Tensor) -> dict[str, Tensor]:
        """Return the moments of a parameter, zero at first."""
        state = self.moments[parameter]
        if not state:
            state["step"] = torch.zeros((), device=parameter.device)
            state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(parameter), torch.zeros_like(parameter)
        return state

    def _step_all(self, rated: list[tuple[nn.Parameter, float]]) -> None:
        """Update parameters, each at its rate, in one call of the kernel."""
        parameters, rates = [p.data for p, _ in rated], [rate for _, rate in rated]
        gradients = [p.grad for p, _ in rated if p.grad is not None]
        states = [self._state_of(p) for p, _ in rated]
        steps, means, squares = ([state[key] for state in states] for key in ("step", "exp_avg", "exp_avg_sq"))
        torch._foreach_add_(steps, 1)
        adam_all(parameters, gradients, means, squares, steps, rates, list(BETAS), EPS)
        for parameter, _ in rated:
            parameter.grad = None

    def _step_rows(self, parameter: nn.Parameter, rate: float, drawn: Tensor) -> None:
        """Update the rows `drawn` of a parameter with a gradient, unless the step is to be skipped."""
        if parameter.grad is None:
            return
        if self.skip is not None:
            drawn = drawn & (self.skip == 0)
        state = self._state_of(parameter)
        state["step"] += 1 if self.skip is None else 1 - self.skip
        update = adam if self.model.backend.serves(parameter) else adam_reference
        moments = state["exp_avg"], state["exp_avg_sq"]
        with torch.no_grad():
            update(parameter, parameter.grad, *moments, drawn, rate, list(BETAS), EPS, state["step"])
        parameter.grad = None

    def follow(self, rows: Tensor, fresh: Tensor) -> None:
        """Move Adam's moments as `model.select(rows)` moved the Gaussians; those of `fresh` rows become zero."""
        for parameter in self.model.splats.values():
            state = self.moments.get(parameter, {})
            for name in ("exp_avg", "exp_avg_sq"):
                if name in state:
                    moments = state[name][rows]
                    moments[fresh] = 0
                    state[name] = moments

    def forget(self, parameter: Tensor) -> None:
        """Zero the moments of a parameter that was set directly, as 3DGS does after an opacity reset."""
        for name in ("exp_avg", "exp_avg_sq"):
            if parameter in self.moments:
                self.moments[parameter][name].zero_()

    def state_dict(self) -> dict[str, Any]:
        """Return the moments and the number of steps of every parameter, for the checkpoint."""
        return {key: dict(self.moments[parameter]) for key, parameter in self._keyed() if parameter in self.moments}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from the `state_dict` of a checkpoint, once the model's parameters are loaded.

        Raises:
            InputError: moments are not of this model's parameters.
        """
        self.moments.clear()
        own = dict(self._keyed())
        for name, moments in state.items():
            if name not in own:
                raise InputError(f"checkpoint: expected moments of {', '.join(own)}, got some of {name!r:.80}")
            parameter = own[name]
            self.moments[parameter] = {
                "step": tensor(moments, "step", (), torch.float32),
                "exp_avg": tensor(moments, "exp_avg", parameter.shape, parameter.dtype),
                "exp_avg_sq": tensor(moments, "exp_avg_sq", parameter.shape, parameter.dtype),
            }

    def _keyed(self) -> Iterator[tuple[str, nn.Parameter]]:
        """Yield the parameters with their keys in a checkpoint: the group's name and a number."""
        for name, parameters in self.groups.items():
            for i, parameter in enumerate(parameters):
                yield f"{name}.{i}", parameter


def rate_at(rate: LearningRate, step: int, train: TrainConfig, extent: float) -> float:
    """Compute the learning rate of a step counted from 0: log-linear from start to end over the run (3DGS).

    A `per_run` rate is multiplied by sqrt(recipe_iterations / iterations). The length of an Adam step is its rate,
    whatever the size of the gradient. The steps of a run add up in proportion to its length where gradients keep their
    sign, and to its square root where they are noise. The root improved every model (docs/tuning.md). From
    `cooldown_from` on, a rate also falls linearly to COOLED of itself.
    """
    scale = extent if rate.per_extent else 1.0
    if rate.per_run:
        scale *= math.sqrt(train.recipe_iterations / train.iterations)
    progress = step / train.iterations
    if train.cooldown_from is not None and (begin := train.cooldown_from / train.recipe_iterations) < progress:
        scale *= 1 - (1 - COOLED) * (progress - begin) / (1 - begin)
    if rate.end is None:
        return rate.start * scale
    return float(rate.start ** (1 - progress) * rate.end**progress * scale)


def adam_reference(
    parameter: Tensor, gradient: Tensor, mean: Tensor, square: Tensor, drawn: Tensor, rate: float, betas: list[float],
    eps: float, step: Tensor,
) -> None:  # fmt: skip
    """Compute `gsbench.kernels.adam.adam` in torch; see there for the arguments."""
    rows = drawn.nonzero()[:, 0]
    g = gradient[rows]
    m = mean[rows].lerp(g, 1 - betas[0])
    v = square[rows].lerp(g.square(), 1 - betas[1])
    count = step.double()
    denominator = v.sqrt() * (1 - betas[1] ** count) ** -0.5 + eps
    parameter[rows] -= m * (rate / (1 - betas[0] ** count)) / denominator
    mean[rows], square[rows] = m, v
