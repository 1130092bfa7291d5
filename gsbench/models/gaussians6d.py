"""Model view-dependent effects by 6DGS: Gaussians over position and direction (Gao et al. 2024)."""

from gsbench.models.observing import DirectionalModel
from gsbench.models.registry import register


@register("6dgs")
class Gaussians6DModel(DirectionalModel, gates=True):
    """6DGS: Gaussians over position and direction, conditioned on the direction from the camera to the Gaussian."""

    observes = ("direction",)
    centers = ("means", "directions")
