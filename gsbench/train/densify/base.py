"""Define the interface of a rule of densification.

A rule sees every view's gradients (`accumulate`), and changes rows in rounds (`densify`). It edits Gaussians by
`Rows.select` and the model's own `split`, so it does not depend on the parameters of a model.
"""

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import torch
from torch import Tensor

from gsbench.config import DensifyConfig
from gsbench.train.rows import Rows

# Of the runs of the 7DGS paper the largest has 1.41 million, of those here 0.55. A Gaussian of 7DGS has 84 numbers,
# four times with its gradient and moments: 2.7 GB for so many.
MOST_GAUSSIANS = 2_000_000


class Densification(ABC):
    """A rule that adds and removes Gaussians during a training."""

    kind: ClassVar[str]  # its name in train.densify.kind

    def __init__(self, rows: Rows, config: DensifyConfig, min_opacity: float, views: int) -> None:
        """Prepare the rule for a training, and follow its rows.

        Args:
            rows: the rows (Gaussians) of the initialised model.
            config: the thresholds of densification.
            min_opacity: Gaussians of lower opacity may be pruned.
            views: the number of training views, which make an epoch.
        """
        self.rows = rows
        self.model = rows.model
        self.config = config
        self.min_opacity = min_opacity
        self.views = views
        rows.add(self)

    @abstractmethod
    def accumulate(
        self,
        drawn: Tensor,  # [C, N] bool
        g_means2d: Tensor,  # [C, N, 2] per pixel
        width: int,
        height: int,
        views: int,
    ) -> None:
        """Accumulate the gradients of one view of a batch.

        Args:
            drawn: which Gaussians were not culled.
            g_means2d: gradient of the loss, a mean over `views`, by the 2D means.
            width: width of the image, pixels.
            height: height of the image, pixels.
            views: number of views in the batch.
        """

    @abstractmethod
    def densify(self, generator: torch.Generator, has_reset: bool) -> int:
        """Do one round of densification: add and remove Gaussians.

        Args:
            generator: gives all random numbers of this round.
            has_reset: whether opacities were reset earlier in the training.

        Returns:
            How many Gaussians were refused because there would be too many.
        """

    @abstractmethod
    def reset_opacities(self) -> None:
        """Lower all opacities, if the rule does so; called at the steps that `Schedule.resets` names."""

    @abstractmethod
    def follow(self, rows: Tensor, fresh: Tensor) -> None:
        """Keep the accumulated values of `rows`; see `gsbench.train.rows.Follower`."""

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """Return the accumulated values, for the checkpoint."""

    @abstractmethod
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from the `state_dict` of a checkpoint; raises InputError if it is not of this many Gaussians."""
