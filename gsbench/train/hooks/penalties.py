"""Add penalties to the photometric loss, each with a weight and a range of steps (`train.penalties`).

    loss = (1 - w) L1 + w (1 - SSIM) + sum_k weight_k penalty_k(view)

`gsbench.train.regularisers` defines them. A model adds terms of its parameters alone by `GaussianModel.penalty`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

from gsbench.config_key import group, joins, key
from gsbench.errors import InputError
from gsbench.train.hooks import Hook, LossTerm, Training

if TYPE_CHECKING:
    from torch import Tensor

    from gsbench.config import Config
    from gsbench.models import GaussianModel
    from gsbench.scenes import View


@dataclass
class PenaltyConfig:
    """Set one loss term."""

    weight: float = key(0.0, "factor of the term", low=0, absent=0)
    start: int = key(0, "first step", low=0, absent=0)
    stop: int | None = key(None, "first step without it", low=0)


@dataclass
class PenaltiesConfig:
    """Add terms to every view's loss."""

    opacity: PenaltyConfig = group(PenaltyConfig, "mean opacity")
    size: PenaltyConfig = group(PenaltyConfig, "mean scale in space, in parts of the scene's extent")
    strain: PenaltyConfig = group(PenaltyConfig, "how fast neighbours move apart, for their distance")


@joins("train")
@dataclass
class PenaltiesKey:
    """The key of this hook."""

    penalties: PenaltiesConfig = group(PenaltiesConfig)


class Penalties(Hook):
    """Add the penalties that have a weight, and those of the model, to the loss."""

    name = "penalties"

    def __init__(self, training: Training) -> None:
        from gsbench.train.regularisers import PENALTIES

        super().__init__(training)
        frames = len({view.time for view in training.scene.train})
        self.weighted = _weighted(training.config)
        self.active = {name: PENALTIES[name](training.model, training.config.seed, frames) for name in self.weighted}

    @classmethod
    def check(cls, config: Config) -> None:
        for name, penalty in _all(config).items():
            if penalty.stop is not None and penalty.stop <= penalty.start:
                raise InputError(
                    f"train.penalties.{name}: expected stop above start, got {penalty.start} to {penalty.stop}"
                )

    @classmethod
    def check_model(cls, model: GaussianModel, config: Config) -> None:
        """Raise InputError if a penalty needs time or direction, and the model does not observe it."""
        from gsbench.train.regularisers import PENALTIES

        for name in _weighted(config):
            for needed in set(PENALTIES[name].needs) - set(model.observes):
                key = f"train.penalties.{name}"
                raise InputError(
                    f"{key}: expected a model that observes {needed}, {type(model).__name__} does not: "
                    f"set {key}.weight=0"
                )

    def loss_terms(self, step: int, views: Sequence[View]) -> Sequence[LossTerm]:
        terms: list[LossTerm] = []
        for name, penalty in self.active.items():
            weighted = self.weighted[name]
            if self.training.schedule.within(step, weighted.start, weighted.stop):
                penalty.prepare(step, views[0])
                terms.append((weighted.weight, penalty))
        return terms

    def reindex(self, rows: Tensor, fresh: Tensor) -> None:
        for penalty in self.active.values():
            penalty.reindex()

    def state_dict(self) -> dict[str, Any]:
        return {name: penalty.state_dict() for name, penalty in self.active.items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        for name, penalty in self.active.items():
            penalty.load_state_dict(state[name])


def _all(config: Config) -> dict[str, PenaltyConfig]:
    return vars(cast(PenaltiesKey, config.train).penalties)


def _weighted(config: Config) -> dict[str, PenaltyConfig]:
    """Return the settings of the penalties that have a weight, by name."""
    return {name: penalty for name, penalty in _all(config).items() if penalty.weight}
