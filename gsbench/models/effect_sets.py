"""Record what each Gaussian of a model depends on: time, direction and AGR (the neural refinement).

If a Gaussian does not depend on time, for example, its parameters of motion change no image. Such parameters are
constant, do not learn, and are not stored.
"""

from typing import NamedTuple

import torch
from torch import Tensor

NAMES = ("refined", "conditioned", "static")  # groups of Gaussians


class EffectSets(NamedTuple):
    """Record what each Gaussian depends on.

    Gaussians are sorted: first those that AGR, the neural refinement, changes (refined), then those that change with
    time or direction but not through AGR (conditioned), then the static ones.
    """

    refined: int  # AGR changes the first `refined` Gaussians
    conditioned: int  # the first `conditioned` >= `refined` Gaussians change with time or direction
    orders: Tensor | None  # [N] int32: SH degree and frequencies of each colour, as in `ColorOrder`; None: all
    intervals: Tensor | None = None  # [refined, 2]: the first and last time at which AGR changes a row; None: always

    @property
    def is_conditioned(self) -> Tensor:
        """Which Gaussians change with time or direction, [N] bool."""
        assert self.orders is not None
        return torch.arange(len(self.orders), device=self.orders.device) < self.conditioned

    def by_name(self, rows: int) -> dict[str, int]:
        """Return the number of Gaussians in each group of NAMES, for a model of `rows` Gaussians."""
        counts = (self.refined, self.conditioned - self.refined, rows - self.conditioned)
        return dict(zip(NAMES, counts, strict=True))
