"""Define regularisers that are added to the photometric loss, each with a weight and a range of steps.

    loss = (1 - w) L1 + w (1 - SSIM) + sum_k weight_k penalty_k(model, query)

A penalty is a function of the model and of the camera centre and time of a view. It is computed for every view of a
batch. To add a penalty, write its function and add its name to PENALTIES and to `gsbench.config.PenaltiesConfig`.
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
    """Return the mean opacity of all Gaussians, [], a regulariser of 3DGS-MCMC."""
    return torch.sigmoid(model.splats["opacities"]).mean()


def mean_size(model: GaussianModel, _query: Query) -> Tensor:
    """Return the mean scale in space over Gaussians and axes, divided by the radius of the scene, [] (3DGS-MCMC)."""
    return model.spatial_scales().mean() / model.extent


PENALTIES: dict[str, Penalty] = {"opacity": mean_opacity, "size": mean_size}


def check_penalties(config: PenaltiesConfig) -> None:
    """Raise InputError if the last step of a penalty is not after its first step."""
    for name in PENALTIES:
        one: PenaltyConfig = getattr(config, name)
        if one.stop is not None and one.stop <= one.start:
            raise InputError(f"train.penalties.{name}: expected stop above start, got {one.start} to {one.stop}")


def penalties_at(step: int, config: PenaltiesConfig, schedule: Schedule) -> list[tuple[float, Penalty]]:
    """Return the pairs (weight, penalty) of the penalties that are active at a step, counted from 0."""
    asked = [(getattr(config, name), penalty) for name, penalty in PENALTIES.items()]
    return [(one.weight, penalty) for one, penalty in asked
            if one.weight and schedule.within(step, one.start, one.stop)]  # fmt: skip
