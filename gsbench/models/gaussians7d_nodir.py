"""Model a moving scene by 7DGS less direction: Gaussians over position and time, to measure what direction is worth.

4DGS is over the same variables, but has another factor and colours that change with time, and learns at other rates.
This model differs from 7DGS in nothing but direction.
"""

from typing import Any

from gsbench.models.registry import register
from gsbench.models.triangular import TriangularModel


@register("7dgs_nodir")
class Gaussians7DWithoutDirectionModel(TriangularModel):
    """Gaussians conditioned on q = {t}."""

    observes = ("time",)
    centers = ("means", "times")
    geometry = ("log_diagonal", "shape", "motion")

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
