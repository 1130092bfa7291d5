"""Optimize a model by Adam, with a learning rate for each parameter group.

Adam's moments are kept, copied or cleared when Gaussians are pruned, cloned or split.
"""

from __future__ import annotations

import math
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


class Optimizer:
    """Optimize the parameters of a model by Adam with eps = 1e-15, as 3DGS does.

    The two kinds differ for Gaussians that no view of a batch sees. `adam` still moves them by their momentum.
    `sparse_adam` leaves them and their moments unchanged (Mallick et al. 2024, Taming 3DGS).
    """

    def __init__(
        self, model: GaussianModel, config: ModelConfig, train: TrainConfig, extent: float, kind: str = "adam"
    ) -> None:
        """Make an Adam parameter group with a learning rate for each group of the model's parameters.

        Args:
            model: the initialised model.
            config: the config of the model, with the learning rates.
            train: the config of the training, with its number of iterations.
            extent: the radius of the scene, world units.
            kind: `adam` or `sparse_adam`.

        Raises:
            InputError: a parameter has no learning rate, or a learning rate has no parameter.
        """
        groups = model.groups()
        for name in groups:
            if name not in config.lr:
                raise InputError(f"model.lr: expected a learning rate for each of {sorted(groups)}, '{name}' has none")
        for name in config.lr:
            if name not in {*groups, "refinement", "lambda"}:
                raise InputError(f"model.lr: model '{config.name}' has no '{name}'. {did_you_mean(name, groups)}")
        self.rates = {name: config.lr[name] for name in groups}
        self.model = model
        self.train = train
        self.extent = extent
        self.is_sparse = kind == "sparse_adam"
        self.adam = torch.optim.Adam(
            [{"params": parameters, "name": name} for name, parameters in groups.items()], lr=0.0, eps=1e-15, fused=True
        )

    def step(
        self,
        step: int,
        drawn: Tensor | None,  # [N] bool
        slowed: float = 1.0,
    ) -> None:
        """Update the parameters that have a gradient, then delete the gradients.

        On a GPU nothing is updated if an earlier gradient was not finite (`adam.found_inf` is 1).

        Args:
            step: the number of the step, counted from 0; it determines the learning rates.
            drawn: which Gaussians are visible in the batch, [N] bool; only `sparse_adam` needs it.
            slowed: the factor by which the learning rate of AGR, the neural refinement, is multiplied.
        """
        by_kernel = []
        for group in self.adam.param_groups:
            group["lr"] = rate_at(self.rates[group["name"]], step, self.train, self.extent)
            if group["name"] == "refinement":
                group["lr"] *= slowed
            if self.is_sparse and group["name"] in self.model.splats:
                assert drawn is not None
                self._step_rows(group, drawn)
            by_kernel += [(p, group["lr"]) for p in group["params"] if p.grad is not None and self._is_native(p)]
        if by_kernel:
            self._step_all(by_kernel)
        if any(p.grad is not None for group in self.adam.param_groups for p in group["params"]):
            self.adam.step()  # parameters on a GPU, or those of the reference
            self.adam.zero_grad(set_to_none=True)

    def _is_native(self, parameter: Tensor) -> bool:
        """Return whether the CPU kernel, not torch, updates a parameter."""
        return parameter.device.type == "cpu" and self.model.backend.serves(parameter) and self._skip is None

    @property
    def _skip(self) -> Tensor | None:
        """The tensor [] on a GPU that is 1 if a gradient was not finite, so nothing must be updated; None on a CPU."""
        return getattr(self.adam, "found_inf", None)

    def _state_of(self, parameter: Tensor) -> dict[str, Tensor]:
        """Return Adam's step count and moments of a parameter; create them with zeros if they do not exist."""
        state: dict[str, Tensor] = self.adam.state[parameter]
        if not state:
            state["step"] = torch.zeros((), device=parameter.device)
            state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(parameter), torch.zeros_like(parameter)
        return state

    def _step_all(self, rated: list[tuple[nn.Parameter, float]]) -> None:
        """Update all given parameters by one call of the CPU kernel; `rated` pairs each with its learning rate."""
        parameters, rates = [p.data for p, _ in rated], [rate for _, rate in rated]
        gradients = [p.grad for p, _ in rated if p.grad is not None]
        states = [self._state_of(p) for p, _ in rated]
        steps, means, squares = ([state[key] for state in states] for key in ("step", "exp_avg", "exp_avg_sq"))
        torch._foreach_add_(steps, 1)
        betas, eps = self.adam.defaults["betas"], self.adam.defaults["eps"]
        adam_all(parameters, gradients, means, squares, steps, rates, list(betas), eps)
        for parameter, _ in rated:
            parameter.grad = None

    def _step_rows(self, group: dict[str, Any], drawn: Tensor) -> None:
        """Update only the Gaussians `drawn` [N] bool of a parameter group, unless a gradient was not finite."""
        (parameter,) = group["params"]
        if parameter.grad is None:
            return
        if self._skip is not None:
            drawn = drawn & (self._skip == 0)
        state = self._state_of(parameter)
        state["step"] += 1 if self._skip is None else 1 - self._skip
        update = adam if self.model.backend.serves(parameter) else adam_reference
        moments = state["exp_avg"], state["exp_avg_sq"]
        with torch.no_grad():
            update(parameter, parameter.grad, *moments, drawn, group["lr"], list(group["betas"]), group["eps"],
                   state["step"])  # fmt: skip
        parameter.grad = None

    def follow(self, rows: Tensor, fresh: Tensor) -> None:
        """Reorder Adam's moments after Gaussians were pruned, cloned or split.

        Args:
            rows: for each Gaussian now, the index of the Gaussian before whose moments it takes, [M].
            fresh: which Gaussians are new, [M] bool; their moments become zero.
        """
        for parameter in self.model.splats.values():
            state = self.adam.state.get(parameter, {})
            for name in ("exp_avg", "exp_avg_sq"):
                if name in state:
                    moments = state[name][rows]
                    moments[fresh] = 0
                    state[name] = moments

    def forget(self, parameter: Tensor) -> None:
        """Set Adam's moments of a parameter to zero, as 3DGS does after it resets the opacities."""
        for name in ("exp_avg", "exp_avg_sq"):
            if parameter in self.adam.state:
                self.adam.state[parameter][name].zero_()

    def state_dict(self) -> dict[str, Any]:
        """Return Adam's moments and step count of every parameter, for the checkpoint."""
        return {f"{group['name']}.{i}": dict(self.adam.state[parameter])
                for group in self.adam.param_groups for i, parameter in enumerate(group["params"])
                if parameter in self.adam.state}  # fmt: skip

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore Adam's moments from a checkpoint; the parameters of the model must be loaded first.

        Raises:
            InputError: the moments do not belong to the parameters of this model.
        """
        self.adam.state.clear()
        own = {f"{group['name']}.{i}": p for group in self.adam.param_groups for i, p in enumerate(group["params"])}
        for name, moments in state.items():
            if name not in own:
                raise InputError(f"checkpoint: expected moments of {', '.join(own)}, got some of {name!r:.80}")
            parameter = own[name]
            self.adam.state[parameter] = {
                "step": tensor(moments, "step", (), torch.float32),
                "exp_avg": tensor(moments, "exp_avg", parameter.shape, parameter.dtype),
                "exp_avg_sq": tensor(moments, "exp_avg_sq", parameter.shape, parameter.dtype),
            }


def rate_at(rate: LearningRate, step: int, train: TrainConfig, extent: float) -> float:
    """Compute the learning rate of a step, counted from 0; it decays log-linearly from start to end, as in 3DGS.

    A rate with `per_extent` is multiplied by the radius of the scene. A rate with `per_run` is multiplied by
    sqrt(recipe_iterations / iterations), so a short run takes larger steps; this improved every model (docs/tuning.md).
    """
    scale = extent if rate.per_extent else 1.0
    if rate.per_run:
        scale *= math.sqrt(train.recipe_iterations / train.iterations)
    progress = step / train.iterations
    if rate.end is None:
        return rate.start * scale
    return float(rate.start ** (1 - progress) * rate.end**progress * scale)


def adam_reference(
    parameter: Tensor, gradient: Tensor, mean: Tensor, square: Tensor, drawn: Tensor, rate: float, betas: list[float],
    eps: float, step: Tensor,
) -> None:  # fmt: skip
    """Do an Adam step in torch on the Gaussians `drawn` [N] bool only; the kernel `adam` does the same."""
    rows = drawn.nonzero()[:, 0]
    g = gradient[rows]
    m = mean[rows].lerp(g, 1 - betas[0])
    v = square[rows].lerp(g.square(), 1 - betas[1])
    count = step.double()
    denominator = v.sqrt() * (1 - betas[1] ** count) ** -0.5 + eps
    parameter[rows] -= m * (rate / (1 - betas[0] ** count)) / denominator
    mean[rows], square[rows] = m, v
