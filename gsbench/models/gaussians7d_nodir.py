"""Model a moving scene by 7DGS less direction: Gaussians over position and time, to measure what direction is worth.

4DGS has the same variables, but another factor, colours that change with time, and other rates. This model differs from
7DGS only in direction.
"""

from gsbench.models.registry import register
from gsbench.models.triangular import TimedModel


@register("7dgs_nodir")
class Gaussians7DWithoutDirectionModel(TimedModel):
    """Gaussians over position and time, which are sliced at a time, for any direction of view."""

    observes = ("time",)
    centers = ("means", "times")
    geometry = ("log_diagonal", "shape", "motion")
