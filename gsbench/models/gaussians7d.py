"""Model moving, view-dependent scenes by 7DGS: Gaussians over position, time and direction (Gao et al. 2025)."""

from gsbench.models.registry import register
from gsbench.models.triangular import DirectionalModel, TimedModel


@register("7dgs")
class Gaussians7DModel(TimedModel, DirectionalModel):
    """7DGS: Gaussians over position, time and direction, conditioned on a time and the direction from the camera."""

    observes = ("time", "direction")
    centers = ("means", "times", "directions")
