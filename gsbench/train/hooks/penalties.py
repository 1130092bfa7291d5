"""Add the penalties of 3DGS-MCMC to the photometric loss, each with a weight and a range of steps (`train.penalties`).

    loss = (1 - w) L1 + w (1 - SSIM) + sum_k weight_k penalty_k

A model adds terms of its parameters alone by `GaussianModel.penalty`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

from gsbench.config_key import group, joins, key
from gsbench.errors import InputError
from gsbench.train.hooks import Hook, LossTerm

if TYPE_CHECKING:
    from torch import Tensor

    from gsbench.config import Config
    from gsbench.models import CameraTime, GaussianModel
    from gsbench.scenes import View


@dataclass
class PenaltyConfig:
    """Set one loss term."""

    weight: float = key(0.0, "factor of the term", low=0, absent=0)
    start: int = key(0, "first step", low=0, absent=0)
    stop: int | None = key(None, "first step without it", low=0)


@dataclass
class PenaltiesConfig:
    """Add terms to the loss."""

    opacity: PenaltyConfig = group(PenaltyConfig, "mean opacity")
    size: PenaltyConfig = group(PenaltyConfig, "mean scale in space, in parts of the scene's extent")


@joins("train")
@dataclass
class PenaltiesKey:
    """The key of this hook."""

    penalties: PenaltiesConfig = group(PenaltiesConfig)


# The penalties [] of a model, by their names in `PenaltiesConfig`.
PENALTIES: dict[str, Callable[[GaussianModel], Tensor]] = {
    "opacity": lambda model: model.splats["opacities"].sigmoid().mean(),
    "size": lambda model: model.spatial_scales().mean() / model.extent,
}


class Penalties(Hook):
    """Add the penalties that have a weight to the loss."""

    name = "penalties"

    @classmethod
    def check(cls, config: Config) -> None:
        for name, penalty in _settings(config).items():
            if penalty.stop is not None and penalty.stop <= penalty.start:
                raise InputError(
                    f"train.penalties.{name}: expected stop above start, got {penalty.start} to {penalty.stop}"
                )

    def loss_terms(self, step: int, views: Sequence[View]) -> Sequence[LossTerm]:
        model, within = self.training.model, self.training.schedule.within

        def term(penalty: Callable[[GaussianModel], Tensor]) -> Callable[[CameraTime, int], Tensor]:
            return lambda *_: penalty(model)

        return [
            (penalty.weight, term(PENALTIES[name]))
            for name, penalty in _settings(self.training.config).items()
            if penalty.weight and within(step, penalty.start, penalty.stop)
        ]


def _settings(config: Config) -> dict[str, PenaltyConfig]:
    return vars(cast(PenaltiesKey, config.train).penalties)
