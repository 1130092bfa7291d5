"""Model moving, view-dependent scenes by 7DGS: Gaussians over position, time and direction (Gao et al. 2025)."""

from typing import Any

from gsbench.models.registry import register
from gsbench.models.triangular import DirectionalModel


@register("7dgs")
class Gaussians7DModel(DirectionalModel):
    """Gaussians conditioned on q = {t, d}."""

    observes = ("time", "direction")
    centers = ("means", "times", "directions")

    def __init__(self, *, lambda_t: float, **options: Any) -> None:
        """Make an empty model.

        Args:
            lambda_t: initial sensitivity of f_temp.
            options: as `DirectionalModel`.

        Raises:
            InputError: an option is out of its range.
        """
        super().__init__(**options)
        self.modulate("time", lambda_t)
