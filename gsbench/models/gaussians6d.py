"""6DGS: Gaussians over position and direction, for effects that depend on the view (Gao et al. 2024)."""

from gsbench.models.registry import register
from gsbench.models.triangular import TriangularModel


@register("6dgs")
class Gaussians6DModel(TriangularModel):
    """Observes d; q = {d}."""

    observes = ("direction",)
    centers = ("means", "directions")
