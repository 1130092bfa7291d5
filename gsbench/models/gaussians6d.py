"""Model view-dependent effects by 6DGS: Gaussians over position and direction (Gao et al. 2024)."""

from gsbench.models.registry import register
from gsbench.models.triangular import TriangularModel


@register("6dgs")
class Gaussians6DModel(TriangularModel):
    """Gaussians conditioned on q = {d}."""

    observes = ("direction",)
    centers = ("means", "directions")
