"""Model a moving scene by 7DGS without direction: Gaussians over position and time, to test direction.

4DGS also has position and time, but another covariance factor, colours that change with time, and other learning rates.
This model differs from 7DGS only in direction.
"""

from gsbench.models.observing import TimedModel
from gsbench.models.registry import register


@register("7dgs_nodir")
class Gaussians7DWithoutDirectionModel(TimedModel, gates=True):
    """7DGS without direction: Gaussians over position and time, conditioned on a time."""

    observes = ("time",)
    centers = ("means", "times")
    geometry = ("log_diagonal", "shape", "motion")
