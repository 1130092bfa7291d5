"""Model a moving scene by 7DGS less direction: Gaussians over position and time, to measure what direction is worth.

4DGS is over the same variables, but has another factor and colours that change with time, and learns at other rates.
This model differs from 7DGS in nothing but direction.
"""

from gsbench.models.registry import register
from gsbench.models.triangular import TimedModel


@register("7dgs_nodir")
class Gaussians7DWithoutDirectionModel(TimedModel):
    """Gaussians conditioned on q = {t}."""

    observes = ("time",)
    centers = ("means", "times")
    geometry = ("log_diagonal", "shape", "motion")
