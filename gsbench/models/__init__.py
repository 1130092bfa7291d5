"""What is fitted: Gaussians of any dimension. A slice is the only thing a model must provide."""

from gsbench.models.base import GaussianModel, Gaussians3D, Stage, build, register

__all__ = ["GaussianModel", "Gaussians3D", "Stage", "build", "register"]
