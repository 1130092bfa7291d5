"""Render a view of a model twice: in float32 by the CPU kernels, and in float64."""

import copy
from typing import NamedTuple

import torch
from torch import Tensor

from gsbench.models.base import GaussianModel
from gsbench.models.query import Query
from gsbench.models.render import rasterize_slice
from gsbench.models.sliced import Gaussians3D
from gsbench.raster.exact import ExactImage, exact_image
from gsbench.scenes.scene import Camera


class Twins(NamedTuple):
    """The images of one view in float32 and in float64, and the 3D Gaussians in float64."""

    image: Tensor  # [H, W, 3] float32
    gaussians: Gaussians3D  # float64
    exact: ExactImage


def exact_model(model: GaussianModel) -> GaussianModel:
    """Return a copy of a float32 model on the CPU that computes in float64."""
    return copy.deepcopy(model).double()


def doubled(camera: Camera) -> Camera:
    """Return a camera whose matrices are float64; its position is computed in float64 too."""
    return Camera(camera.viewmat.double(), camera.K.double(), camera.width, camera.height)


@torch.inference_mode()
def render_twins(
    model: GaussianModel,
    exact: GaussianModel,
    camera: Camera,
    time: float | None,
    background: Tensor,  # [3] float32
    antialias: bool,
) -> Twins:
    """Render a view of `model` in float32, and of its copy `exact` in float64.

    Raises:
        InputError: the CPU kernels are not installed, or a Gaussian has a value that is not finite.
    """
    single = model.slice(Query.of(camera, time))
    image = rasterize_slice(single, camera, background, model.backend, antialias).image[0]
    gaussians = exact.slice(Query.of(doubled(camera), time))
    return Twins(image, gaussians, exact_view(gaussians, single, camera, background, antialias))


def exact_view(
    exact: Gaussians3D,  # float64
    single: Gaussians3D,  # float32
    camera: Camera,
    background: Tensor,  # [3] float32
    antialias: bool,
) -> ExactImage:
    """Render 3D Gaussians in float64, and bound the error of their image in float32; see `exact_image`."""
    return exact_image(exact, single, camera.viewmat, camera.K, camera.width, camera.height,
                       background=background, antialias=antialias)  # fmt: skip
