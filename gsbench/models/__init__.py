"""What is fitted: Gaussians of any dimension. A slice is the only thing a model must provide."""

from gsbench.models.base import GaussianModel, Gaussians3D, Phase
from gsbench.models.query import Query
from gsbench.models.registry import build, register

__all__ = ["GaussianModel", "Gaussians3D", "Phase", "Query", "build", "register"]
