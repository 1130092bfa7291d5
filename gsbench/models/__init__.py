"""Model scenes by Gaussians of three to seven dimensions; every model returns its 3D slice at a query."""

from gsbench.models.base import GaussianModel, Gaussians3D
from gsbench.models.query import Query
from gsbench.models.registry import build, find, register

__all__ = ["GaussianModel", "Gaussians3D", "Query", "build", "find", "register"]
