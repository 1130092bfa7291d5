"""Model scenes by Gaussians of 3 to 7 dimensions. Each model returns 3D Gaussians for a camera centre and a time."""

from gsbench.models.base import GaussianModel
from gsbench.models.query import Query
from gsbench.models.registry import build, find, register
from gsbench.models.sliced import Gaussians3D

__all__ = ["GaussianModel", "Gaussians3D", "Query", "build", "find", "register"]
