"""Optimize a model by Adam, with a learning rate for each parameter group.

Adam's moments are kept, copied or cleared when Gaussians are pruned, cloned or split.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from gsbench.errors import InputError, did_you_mean
from gsbench.kernels.adam import adam_all
from gsbench.models import GaussianModel
from gsbench.train.checkpoint import tensor

if TYPE_CHECKING:  # config.py needs hydra, which a machine that checks kernels may lack
    from gsbench.config import LearningRate, ModelConfig, TrainConfig

BETAS, EPS = (0.9, 0.999), 1e-15
NO_FACTORS: Mapping[str, float] = {}
COOLED = 0.1  # share of a learning rate that is left at the end of a cooldown


class Optimizer:
    """Optimize the parameters of a model by Adam with eps = 1e-15, as 3DGS does.

    One call of a kernel updates all parameters; without kernels torch.optim.Adam does. The kinds `adam` and
    `sparse_adam` differ for Gaussians that no view of a batch sees. `adam` still moves them by their momentum.
    `sparse_adam` leaves them and their moments unchanged (Mallick et al. 2024, Taming 3DGS).
    """

    def __init__(
        self, model: GaussianModel, config: ModelConfig, train: TrainConfig, extent: float, kind: str = "adam"
    ) -> None:
        """Check that each parameter group of an initialised model has a learning rate; `extent` is the scene's radius.

        Raises:
            InputError: a group has no learning rate, or a learning rate has no group.
        """
        self.groups = groups = model.groups()
        check_rates(groups, config)
        self.rates = {name: config.lr[name] for name in groups}
        self.model = model
        self.train = train
        self.extent = extent
        self.is_sparse = kind == "sparse_adam"
        # The step count and both moments of each parameter, in the form of torch.optim.Adam.state.
        self.moments: defaultdict[Tensor, dict[str, Tensor]] = defaultdict(dict)
        self.skip: Tensor | None = None  # []: nothing is updated unless it is 0 (`FiniteCheck`)
        self._rates: dict[str, float] = {}  # of the present step, by group

    def add(self, name: str, parameters: list[nn.Parameter], rate: LearningRate) -> None:
        """Also optimize a group of parameters that is not of the model; use it before the first step."""
        self.groups[name], self.rates[name] = parameters, rate

    @property
    def parameters(self) -> list[nn.Parameter]:
        """Return the parameters of all groups."""
        return [p for group in self.groups.values() for p in group]

    @cached_property
    def torch_adam(self) -> torch.optim.Adam:
        """torch's Adam with the same moments, of what is not updated by rows; its import takes a second."""
        rest = [(name, [p for p in group if id(p) not in self._by_rows]) for name, group in self.groups.items()]
        groups = [{"params": parameters, "name": name} for name, parameters in rest]
        adam = torch.optim.Adam(groups, lr=0.0, betas=BETAS, eps=EPS, fused=True)  # `update` sets the rates
        adam.state = self.moments  # shared: densification and `load_state_dict` change it in place
        return adam

    @cached_property
    def _by_rows(self) -> set[int]:
        """The ids of the parameters of which only the rows of visible Gaussians are updated."""
        return {id(p) for p in self.model.splats.values()} if self.is_sparse else set()

    @cached_property
    def _rates_in_memory(self) -> Tensor:
        """The learning rates of the present step where kernels read them, [groups]."""
        return self.model.splats["means"].detach().new_zeros(len(self.groups))

    def begin(self, step: int, factors: Mapping[str, float] = NO_FACTORS) -> None:
        """Set the learning rates to those of a step, multiplied by the factors of some groups."""
        self._rates, memory = self.rates_at(step, factors), self._rates_in_memory
        # The copy from pinned memory does not wait for the GPU.
        rates = torch.tensor(list(self._rates.values()), dtype=memory.dtype, pin_memory=memory.is_cuda)
        memory.copy_(rates, non_blocking=True)

    def update(self, drawn: Tensor | None) -> None:
        """Update the parameters that have a gradient. By kernels, this can be recorded and repeated in other steps.

        `drawn` [N] bool are the Gaussians that are visible in the batch; for sparse_adam.
        """
        if self.model.backend.serves(self.model.splats["means"]):  # which has the device and the type of all parameters
            self._update_all(drawn)
            return
        for name, parameter in self.model.splats.items():
            if id(parameter) in self._by_rows:
                assert drawn is not None
                self._update_rows(parameter, self._rates[name], drawn)
        if any(p.grad is not None for p in self.parameters if id(p) not in self._by_rows):
            for group in self.torch_adam.param_groups:
                group["lr"] = self._rates[group["name"]]
            if self.skip is not None:
                # torch's fused Adam changes nothing where it is 1.
                self.torch_adam.found_inf = self.skip  # type: ignore[attr-defined]
            self.torch_adam.step()

    def end(self) -> None:
        """Delete the gradients of a step."""
        for p in self.parameters:
            p.grad = None

    def rates_at(self, step: int, factors: Mapping[str, float] = NO_FACTORS) -> dict[str, float]:
        """Return the learning rate of each group at a step, multiplied by the factors of some groups."""
        return {
            name: rate_at(rate, step, self.train, self.extent) * factors.get(name, 1.0)
            for name, rate in self.rates.items()
        }

    def _state_of(self, parameter: Tensor) -> dict[str, Tensor]:
        """Return Adam's step count and moments of a parameter; create them with zeros if they do not exist."""
        state = self.moments[parameter]
        if not state:
            state["step"] = torch.zeros((), device=parameter.device)
            state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(parameter), torch.zeros_like(parameter)
        return state

    def _update_all(self, drawn: Tensor | None) -> None:
        """Update all parameters that have a gradient by one call of the kernel."""
        groups = zip(self.groups.values(), self._rates_in_memory.unbind(), strict=True)
        rated = [(p, rate) for group, rate in groups for p in group if p.grad is not None]
        parameters, rates = [p for p, _ in rated], [rate for _, rate in rated]
        gradients = [p.grad for p in parameters if p.grad is not None]
        states = [self._state_of(p) for p in parameters]
        steps, means, squares = ([state[key] for state in states] for key in ("step", "exp_avg", "exp_avg_sq"))
        rows = [drawn if id(p) in self._by_rows else None for p in parameters]
        adam_all(parameters, gradients, means, squares, steps, rates, BETAS, EPS, self.skip, rows)

    def _update_rows(self, parameter: nn.Parameter, rate: float, drawn: Tensor) -> None:
        """Update only the Gaussians `drawn` [N] bool of a parameter."""
        if parameter.grad is None:
            return
        if self.skip is not None:
            drawn = drawn & (self.skip == 0)
        state = self._state_of(parameter)
        state["step"] += 1 if self.skip is None else 1 - self.skip
        moments = state["exp_avg"], state["exp_avg_sq"]
        with torch.no_grad():
            adam_reference(parameter, parameter.grad, *moments, drawn, rate, BETAS, EPS, state["step"])

    def reindex(self, rows: Tensor, fresh: Tensor) -> None:
        """Reorder Adam's moments after Gaussians were added, removed or sorted; those of new Gaussians become zero.

        `rows` [M] has for each Gaussian its index before, or that of its parent; `fresh` [M] bool, whether it is new.
        """
        for parameter in self.model.splats.values():
            state = self.moments.get(parameter, {})
            for name in ("exp_avg", "exp_avg_sq"):
                if name in state:
                    moments = state[name][rows]
                    moments[fresh] = 0
                    state[name] = moments

    def forget(self, parameter: Tensor) -> None:
        """Set Adam's moments of a parameter to zero, as 3DGS does after it resets the opacities."""
        for name in ("exp_avg", "exp_avg_sq"):
            if parameter in self.moments:
                self.moments[parameter][name].zero_()

    def state_dict(self) -> dict[str, Any]:
        """Return Adam's moments and step count of every parameter, for the checkpoint."""
        return {key: dict(self.moments[parameter]) for key, parameter in self._keyed() if parameter in self.moments}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore Adam's moments from a checkpoint; the parameters of the model must be loaded first.

        Raises:
            InputError: the moments do not belong to the parameters of this model.
        """
        self.moments.clear()
        parameters = dict(self._keyed())
        for name, moments in state.items():
            if name not in parameters:
                raise InputError(f"checkpoint: expected moments of {', '.join(parameters)}, got some of {name!r:.80}")
            parameter = parameters[name]
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


def check_rates(groups: Collection[str], config: ModelConfig) -> None:
    """Raise InputError if a group of a model's parameters has no learning rate, or a learning rate has no group."""
    for name in groups:
        if name not in config.lr:
            raise InputError(f"model.lr: expected a learning rate for each of {sorted(groups)}, '{name}' has none")
    for name in config.lr:
        if name not in {*groups, "refinement", "lambda"}:  # a run may switch off what has these two groups
            raise InputError(f"model.lr: model '{config.name}' has no '{name}'. {did_you_mean(name, groups)}")


def rate_at(rate: LearningRate, step: int, train: TrainConfig, extent: float) -> float:
    """Compute the learning rate of a step, counted from 0; it decays log-linearly from start to end, as in 3DGS.

    A rate with `until` reaches its end at this step, scaled by iterations / recipe_iterations, and stays there.
    A rate with `per_extent` is multiplied by the radius of the scene. A rate with `per_run` is multiplied by
    sqrt(recipe_iterations / iterations), so a short run takes larger steps; this improved every model (docs/tuning.md).
    From a step on (`cooldown_from`, scaled by iterations / recipe_iterations), every rate is also multiplied by a
    factor that falls linearly from 1 to COOLED.
    """
    scale = extent if rate.per_extent else 1.0
    if rate.per_run:
        scale *= math.sqrt(train.recipe_iterations / train.iterations)
    progress = step / train.iterations
    if train.cooldown_from is not None and (begin := train.cooldown_from / train.recipe_iterations) < progress:
        scale *= 1 - (1 - COOLED) * (progress - begin) / (1 - begin)
    if rate.end is None:
        return rate.start * scale
    if rate.until is not None:
        progress = min(1.0, progress * train.recipe_iterations / rate.until)
    return float(rate.start ** (1 - progress) * rate.end**progress * scale)


def adam_reference(
    parameter: Tensor,  # [N, ..]
    gradient: Tensor,  # [N, ..]
    mean: Tensor,  # [N, ..] first moment
    square: Tensor,  # [N, ..] second moment
    drawn: Tensor,  # [N] bool
    rate: float,
    betas: Sequence[float],
    eps: float,
    step: Tensor,  # [] the number of steps with this one
) -> None:
    """Do an Adam step in torch on the Gaussians `drawn` only; the kernel of `adam_all` does the same.

    Kingma and Ba 2015, algorithm 1, with both bias corrections.
    """
    rows = drawn.nonzero()[:, 0]
    g = gradient[rows]
    m = mean[rows].lerp(g, 1 - betas[0])
    v = square[rows].lerp(g.square(), 1 - betas[1])
    count = step.double()
    denominator = v.sqrt() * (1 - betas[1] ** count) ** -0.5 + eps
    parameter[rows] -= m * (rate / (1 - betas[0] ** count)) / denominator
    mean[rows], square[rows] = m, v
