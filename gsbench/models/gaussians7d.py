"""Model moving, view-dependent scenes by 7DGS: Gaussians over position, time and direction (Gao et al. 2025)."""

from typing import Any

import torch
from torch import Tensor

from gsbench.models.registry import register
from gsbench.models.triangular import TriangularModel


@register("7dgs")
class Gaussians7DModel(TriangularModel):
    """Gaussians conditioned on q = {t, d}."""

    observes = ("time", "direction")
    centers = ("means", "times", "directions")

    def __init__(self, *, lambda_t: float, **options: Any) -> None:
        """Make an empty model.

        Args:
            lambda_t: initial sensitivity of f_temp.
            options: as `TriangularModel`.

        Raises:
            InputError: an option is out of its range.
        """
        super().__init__(**options)
        self.modulate("time", lambda_t)

    @torch.no_grad()
    def long_in_time(self) -> Tensor:
        """Test |S_pt| > 0.05 extent and sqrt(S_t) > 0.25 T (7DGS, section 4.4)."""
        return self.moves_long(self.factors(dict(self.splats.items())))
