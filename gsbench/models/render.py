"""Render an image of a model: slice it at a query and rasterize the slice."""

from torch import Tensor

from gsbench.kernels.backends import Backend
from gsbench.models.base import GaussianModel, Gaussians3D
from gsbench.models.query import Query
from gsbench.raster import RasterOutput, rasterize
from gsbench.scenes.scene import Camera


def rasterize_slice(
    gaussians: Gaussians3D, camera: Camera, background: Tensor, backend: Backend, antialias: bool = False
) -> RasterOutput:
    """Rasterize one slice for one camera.

    Args:
        gaussians: the slice.
        camera: sees it.
        background: colour [3].
        backend: of the rasterizer.
        antialias: see `gsbench.raster.rasterize`.
    """
    return rasterize(
        gaussians.means,
        gaussians.factors,
        gaussians.opacities,
        gaussians.colors,
        camera.viewmat[None],
        camera.K[None],
        camera.width,
        camera.height,
        background=background,
        backend=backend,
        antialias=antialias,
        shapes=gaussians.shapes,
    )


def render(
    model: GaussianModel, camera: Camera, time: float | None, background: Tensor, antialias: bool = False
) -> Tensor:
    """Render the image [H, W, 3] of a model by the model's own backend.

    Args:
        model: initialised.
        camera: sees it.
        time: in [0, 1]; None if the scene has no time.
        background: colour [3].
        antialias: see `gsbench.raster.rasterize`.
    """
    seen = model.slice(Query.of(camera, time))
    return rasterize_slice(seen, camera, background, model.backend, antialias).image[0]
