"""Render an image of a model: compute its 3D Gaussians for a camera and a time, and rasterize these."""

from torch import Tensor

from gsbench.kernels.backends import Backend
from gsbench.models.base import GaussianModel
from gsbench.models.query import Query
from gsbench.models.sliced import Gaussians3D
from gsbench.raster import RasterOutput, rasterize
from gsbench.scenes.scene import Camera


def rasterize_slice(
    gaussians: Gaussians3D, camera: Camera, background: Tensor, backend: Backend, antialias: bool = False
) -> RasterOutput:
    """Rasterize the 3D Gaussians of a model (with colours) for one camera.

    Args:
        gaussians: the 3D Gaussians.
        camera: the camera of the image.
        background: the background colour, [3].
        backend: the implementation of the rasterizer.
        antialias: whether to scale opacities by the 2D filter of Mip-Splatting, as in `gsbench.raster.rasterize`.
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
    """Render the image [H, W, 3] of a model for a camera and a time.

    Args:
        model: a model with Gaussians; its backend renders.
        camera: the camera.
        time: the time in [0, 1]; None if the scene has no time.
        background: the background colour, [3].
        antialias: whether to scale opacities by the 2D filter of Mip-Splatting, as in `gsbench.raster.rasterize`.
    """
    seen = model.slice(Query.of(camera, time))
    return rasterize_slice(seen, camera, background, model.backend, antialias).image[0]
