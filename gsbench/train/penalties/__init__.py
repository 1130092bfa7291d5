"""Define regularisers that are added to the photometric loss, each with a weight and a range of steps.

    loss = (1 - w) L1 + w (1 - SSIM) + sum_k weight_k penalty_k(view)

It is computed for every view of a batch. To add a penalty, derive a class from `Penalty` and add its name to PENALTIES
and to `gsbench.config.PenaltiesConfig`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.models import GaussianModel, Query
from gsbench.scenes import View
from gsbench.train.penalties.base import Penalty
from gsbench.train.penalties.strain import Strain
from gsbench.train.rows import Rows

if TYPE_CHECKING:  # config.py needs hydra, which a machine that checks kernels may lack
    from gsbench.config import PenaltiesConfig, PenaltyConfig
    from gsbench.schedule import Schedule


class MeanOpacity(Penalty):
    """The mean opacity of all Gaussians, a regulariser of 3DGS-MCMC."""

    def __call__(self, query: Query, index: int) -> Tensor:
        """Return the mean opacity, []; it is the same for every view."""
        return torch.sigmoid(self.model.splats["opacities"]).mean()


class MeanSize(Penalty):
    """The mean scale in space over Gaussians and axes, divided by the radius of the scene (3DGS-MCMC)."""

    def __call__(self, query: Query, index: int) -> Tensor:
        """Return the mean scale, []; it is the same for every view."""
        return self.model.spatial_scales().mean() / self.model.extent


PENALTIES: dict[str, type[Penalty]] = {"opacity": MeanOpacity, "size": MeanSize, "strain": Strain}


def check_penalties(config: PenaltiesConfig) -> None:
    """Raise InputError if the last step of a penalty is not after its first step."""
    for name in PENALTIES:
        one: PenaltyConfig = getattr(config, name)
        if one.stop is not None and one.stop <= one.start:
            raise InputError(f"train.penalties.{name}: expected stop above start, got {one.start} to {one.stop}")


def check_observed(model: GaussianModel, config: PenaltiesConfig) -> None:
    """Raise InputError if a penalty with a weight needs time or direction, and the model does not observe it."""
    for name, kind in PENALTIES.items():
        missing = [x for x in kind.needs if x not in model.observes]
        if getattr(config, name).weight and missing:
            raise InputError(f"train.penalties.{name}: expected a model that observes {missing[0]}, "
                             f"{type(model).__name__} does not: set train.penalties.{name}.weight=0")  # fmt: skip


class Penalties:
    """Hold the penalties of a training that have a weight."""

    def __init__(self, rows: Rows, config: PenaltiesConfig, schedule: Schedule, seed: int, views: list[View]) -> None:
        """Make the penalties of a training.

        Args:
            rows: the Gaussians of the training.
            config: the weight and the steps of each penalty.
            schedule: the schedule of the training, which scales these steps.
            seed: the seed of the run.
            views: the training views.

        Raises:
            InputError: the model does not observe what a penalty needs.
        """
        check_observed(rows.model, config)
        self.config = config
        self.schedule = schedule
        frames = len({view.time for view in views})
        self.made = {name: kind(rows.model, seed, frames) for name, kind in PENALTIES.items()
                     if getattr(config, name).weight}  # fmt: skip
        for penalty in self.made.values():
            rows.add(penalty)

    def at(self, step: int, views: Sequence[View]) -> list[tuple[float, Penalty]]:
        """Prepare the penalties that are active at a step, counted from 0, and return them as (weight, penalty).

        Args:
            step: the number of the step.
            views: the views of the batch.
        """
        active = []
        for name, penalty in self.made.items():
            one: PenaltyConfig = getattr(self.config, name)
            if self.schedule.within(step, one.start, one.stop):
                penalty.prepare(step, Query.of(views[0].camera, views[0].time))
                active.append((one.weight, penalty))
        return active

    def state_dict(self) -> dict[str, Any]:
        """Return the state of each penalty, for the checkpoint."""
        return {name: penalty.state_dict() for name, penalty in self.made.items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the state of each penalty from a checkpoint."""
        for name, penalty in self.made.items():
            penalty.load_state_dict(state.get(name, {}))
