"""Add penalties to the loss of a step: a list of (model, query) -> scalar, each with a weight and a window of steps.

    loss = (1 - w) L1 + w (1 - SSIM) + sum_k weight_k penalty_k(model, query)

A penalty is computed for every view of a batch, on the tape of that view. To add one, write a function and name it in
PENALTIES and in `gsbench.config.PenaltiesConfig`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.models import GaussianModel, Query

if TYPE_CHECKING:  # config.py needs hydra, which a machine that checks kernels may lack
    from gsbench.config import PenaltiesConfig, PenaltyConfig
    from gsbench.schedule import Schedule

Penalty = Callable[[GaussianModel, Query], Tensor]


def mean_opacity(model: GaussianModel, _query: Query) -> Tensor:
    """Return the mean opacity of all Gaussians, [] in (0, 1) (a regulariser of 3DGS-MCMC)."""
    return torch.sigmoid(model.splats["opacities"]).mean()


def mean_size(model: GaussianModel, _query: Query) -> Tensor:
    """Return the mean of the Gaussians' largest standard deviations in parts of the scene's extent, []."""
    return model.scales().mean() / model.extent


PENALTIES: dict[str, Penalty] = {"opacity": mean_opacity, "size": mean_size}


def check_penalties(config: PenaltiesConfig) -> None:
    """Raise InputError for a penalty whose window is empty."""
    for name in PENALTIES:
        one: PenaltyConfig = getattr(config, name)
        if one.stop is not None and one.stop <= one.start:
            raise InputError(f"train.penalties.{name}: expected stop above start, got {one.start} to {one.stop}")


def penalties_at(step: int, config: PenaltiesConfig, schedule: Schedule) -> list[tuple[float, Penalty]]:
    """List (weight, penalty) of those whose window holds a step, counted from 0."""
    asked = [(getattr(config, name), penalty) for name, penalty in PENALTIES.items()]
    return [(one.weight, penalty) for one, penalty in asked
            if one.weight and schedule.within(step, one.start, one.stop)]  # fmt: skip
