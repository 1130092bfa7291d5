"""One picture of a model: slice it, draw the slice."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torch import Tensor

from gsbench.models.base import GaussianModel, Gaussians3D
from gsbench.raster import RasterOutput, rasterize
from gsbench.scenes.scene import Camera

if TYPE_CHECKING:  # the configuration needs hydra, which building and drawing a model does not
    from gsbench.config import RasterConfig


def draw(gaussians: Gaussians3D, camera: Camera, background: Tensor, config: RasterConfig) -> RasterOutput:
    """Draw one slice from one camera, before a background colour [3]."""
    return rasterize(
        *gaussians,
        camera.viewmat[None],
        camera.K[None],
        camera.width,
        camera.height,
        background=background,
        backend=config.backend,
        antialias=config.antialias,
    )


def render(
    model: GaussianModel, camera: Camera, time: float | None, background: Tensor, config: RasterConfig
) -> Tensor:
    """The picture [H, W, 3] of a model from a camera at a time."""
    return draw(model.slice(camera.center, time), camera, background, config).image[0]
