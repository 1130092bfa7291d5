"""Model scenes by Gaussians of 3 to 7 dimensions. Each model returns 3D Gaussians for a camera centre and a time."""

from gsbench.models.base import GaussianModel
from gsbench.models.camera_time import CameraTime
from gsbench.models.gaussian_batch import Gaussians3D
from gsbench.models.registry import build, find, register

__all__ = ["CameraTime", "GaussianModel", "Gaussians3D", "build", "find", "register"]
