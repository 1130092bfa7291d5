"""Adam with a learning rate a parameter, whose moments follow the Gaussians when density control moves rows."""

import torch
from torch import Tensor

from gsbench.config import LearningRate, ModelConfig
from gsbench.errors import InputError, did_you_mean
from gsbench.models import GaussianModel


class Optimizer:
    """torch.optim.Adam over a model's parameter groups (eps 1e-15, as 3DGS)."""

    def __init__(self, model: GaussianModel, config: ModelConfig, extent: float, iterations: int) -> None:
        """One group for each name of `model.groups()`.

        Raises:
            InputError: a parameter without a learning rate, or a rate for a parameter no variant of the model has.
        """
        groups = model.groups()
        for name in groups:
            if name not in config.lr:
                raise InputError(f"model.lr: expected a learning rate for each of {sorted(groups)}, '{name}' has none")
        for name in config.lr:
            if name not in {*groups, "refinement", "modulation"}:
                raise InputError(f"model.lr: model '{config.name}' has no '{name}'. {did_you_mean(name, groups)}")
        self.rates = {name: config.lr[name] for name in groups}
        self.extent = extent
        self.iterations = iterations
        self.adam = torch.optim.Adam(
            [{"params": parameters, "name": name} for name, parameters in groups.items()], lr=0.0, eps=1e-15, fused=True
        )

    def step(self, step: int) -> None:
        """Update everything that has a gradient, at the rates of this step, and drop the gradients."""
        for group in self.adam.param_groups:
            group["lr"] = rate_at(self.rates[group["name"]], step / self.iterations, self.extent)
        self.adam.step()
        self.adam.zero_grad(set_to_none=True)

    def follow(self, model: GaussianModel, rows: Tensor, fresh: Tensor) -> None:
        """Move Adam's moments as `model.select(rows)` moved the Gaussians; those `fresh` start from zero."""
        for parameter in model.splats.values():
            state = self.adam.state.get(parameter, {})
            for name in ("exp_avg", "exp_avg_sq"):
                if name in state:
                    moments = state[name][rows]
                    moments[fresh] = 0
                    state[name] = moments

    def forget(self, parameter: Tensor) -> None:
        """Zero the moments of a parameter that was set by hand (3DGS does after an opacity reset)."""
        for name in ("exp_avg", "exp_avg_sq"):
            if parameter in self.adam.state:
                self.adam.state[parameter][name].zero_()


def rate_at(rate: LearningRate, progress: float, extent: float) -> float:
    """The learning rate when `progress` in [0, 1] of the run is done: log-linear from start to end (3DGS)."""
    scale = extent if rate.per_extent else 1.0
    if rate.end is None:
        return rate.start * scale
    return float(rate.start ** (1 - progress) * rate.end**progress * scale)
