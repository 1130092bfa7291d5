"""Render one image of a model: slice it, rasterize the slice."""

from torch import Tensor

from gsbench.backends import Backend
from gsbench.models.base import GaussianModel, Gaussians3D
from gsbench.models.query import Query
from gsbench.raster import RasterOutput, rasterize
from gsbench.scenes.scene import Camera


def rasterize_slice(
    gaussians: Gaussians3D, camera: Camera, background: Tensor, backend: Backend, antialias: bool = False
) -> RasterOutput:
    """Rasterize one slice for one camera, before a background colour [3]."""
    return rasterize(
        *gaussians,
        camera.viewmat[None],
        camera.K[None],
        camera.width,
        camera.height,
        background=background,
        backend=backend,
        antialias=antialias,
    )


def render(
    model: GaussianModel, camera: Camera, time: float | None, background: Tensor, antialias: bool = False
) -> Tensor:
    """The image [H, W, 3] of a model from a camera at a time, by the model's own backend."""
    seen = model.slice(Query.of(camera, time))
    return rasterize_slice(seen, camera, background, model.backend, antialias).image[0]
