"""Define the interface of a densification rule, which adds and removes Gaussians during a training."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gsbench.config import DensifyConfig
from gsbench.train.rows import Rows


class Scores(NamedTuple):
    """Hold how much each Gaussian contributes to the pixels with large errors in some training views."""

    importance: Tensor  # [N] mean over the views of its summed blend weight on these pixels, pixels
    badness: Tensor  # [N] in [0, 1]: the same sums, weighted by the losses of the views; 1: the largest


# Draws training views by a generator, renders them and returns the scores of all present Gaussians.
Score = Callable[[torch.Generator], Scores]


class DensificationRule(ABC):
    """The base class of rules; a rule works with all models, since a model itself splits Gaussians."""

    adds_noise = False  # whether the training calls `add_noise` after every step

    def __init__(
        self, rows: Rows, config: DensifyConfig, min_opacity: float, views: int, score: Score | None = None
    ) -> None:
        """Prepare the rule for a training of an initialised model.

        Args:
            rows: the Gaussians of the model; the rule adds and removes Gaussians through this object.
            config: the thresholds of densification.
            min_opacity: the opacity below which a Gaussian may be pruned.
            views: the number of training views, which is the length of an epoch.
            score: renders training views to score the Gaussians, for rules that call it in `densify`.
        """
        self.rows = rows
        self.model = rows.model
        self.config = config
        self.min_opacity = min_opacity
        self.views = views
        self.score = score
        self.start()
        rows.add(self.reindex)

    def start(self) -> None:
        """Make what the rule accumulates, before the first step."""

    @abstractmethod
    def densify(self, generator: torch.Generator, has_reset: bool, most: int) -> int:
        """Do one round of densification: add and remove Gaussians.

        Args:
            generator: the source of all random numbers of this round.
            has_reset: whether opacities were reset earlier in the training.
            most: the number of Gaussians that the model may have after this round (`Schedule.most_gaussians`).

        Returns:
            The number of Gaussians that were not added, because the model would have more than allowed.
        """

    def accumulate(
        self,
        drawn: Tensor,  # [C, N] bool: which Gaussians were not culled
        g_means2d: Tensor,  # [C, N, 2] gradient of the loss, a mean over the batch, per pixel
        width: int,  # of the image, pixels
        height: int,
        views: int,  # in the batch
        skip: Tensor,  # []: not 0 if the step is bad; then CUDA kernels must change nothing
    ) -> None:
        """Accumulate the gradients of the 2D means in C views of a batch; by default they are not used.

        This is recorded and repeated, so it must change tensors in place, and no other state.
        """

    def add_noise(self, rate: float, generator: torch.Generator) -> None:
        """Move means by noise after a step, where `adds_noise`; `rate` is the learning rate of means, world units."""

    def reset_opacities(self) -> None:
        """Lower all opacities, if the rule does this; the training calls this method at fixed intervals."""

    def reindex(self, rows: Tensor, fresh: Tensor) -> None:
        """Reorder per-Gaussian state after Gaussians were added or removed, see `gsbench.train.hooks.Hook.reindex`."""

    def state_dict(self) -> dict[str, Any]:
        """Return what the rule has accumulated, for the checkpoint."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a `state_dict`; raise InputError if the number of Gaussians differs."""
