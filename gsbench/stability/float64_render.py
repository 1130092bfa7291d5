"""Render a view of a model in float32 by the CPU kernels, and in float64 with a bound on the error of float32."""

import copy
from typing import NamedTuple

import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.models import CameraTime, GaussianModel
from gsbench.models.gaussian_batch import Gaussians3D
from gsbench.models.render import rasterize_slice
from gsbench.raster.exact import ExactImage, exact_image
from gsbench.scenes.scene import Camera


class RenderedTwice(NamedTuple):
    """The images of one view in float32 and in float64, and the 3D Gaussians in float64."""

    image: Tensor  # [H, W, 3] float32
    gaussians: Gaussians3D  # float64
    exact: ExactImage


def check_exactness(model: GaussianModel) -> None:
    """Raise InputError if the images of a model have no bound on the error of float32: they need the CPU kernels."""
    means = model.splats["means"]
    if means.device.type != "cpu":
        raise InputError(f"expected a model on the CPU, whose kernels have a float64 twin, got one on "
                         f"{means.device}: start the viewer with --device cpu")  # fmt: skip
    if not model.backend.serves(means):
        raise InputError("expected the CPU kernels, which have a float64 twin, but they are not built in this "
                         "installation: reinstall with a C++20 compiler",
                         docs="install.md#without-a-compiler")  # fmt: skip


def float64_model(model: GaussianModel) -> GaussianModel:
    """Return a copy of a float32 model on the CPU that computes in float64."""
    return copy.deepcopy(model).double()


def float64_camera(camera: Camera) -> Camera:
    """Return a camera whose matrices are float64; its position is computed in float64 too."""
    return Camera(camera.viewmat.double(), camera.K.double(), camera.width, camera.height)


@torch.inference_mode()
def render_twice(
    model: GaussianModel,
    double: GaussianModel,  # its `float64_model`
    camera: Camera,
    time: float | None,
    background: Tensor,  # [3] float32
    antialias: bool,
) -> RenderedTwice:
    """Render a view of a model in float32, and of its copy in float64.

    Raises:
        InputError: the CPU kernels are not installed, or a Gaussian has a value that is not finite.
    """
    single = model.slice(CameraTime.of(camera, time))
    image = rasterize_slice(single, camera, background, model.backend, antialias).image[0]
    gaussians = double.slice(CameraTime.of(float64_camera(camera), time))
    return RenderedTwice(image, gaussians, float64_image(gaussians, single, camera, background, antialias))


def float64_image(
    gaussians: Gaussians3D,  # float64
    single: Gaussians3D,  # the same in float32
    camera: Camera,
    background: Tensor,  # [3] float32
    antialias: bool,
) -> ExactImage:
    """Render 3D Gaussians in float64, and bound the error of their image in float32; see `exact_image`."""
    return exact_image(gaussians, single, camera.viewmat, camera.K, camera.width, camera.height,
                       background=background, antialias=antialias)  # fmt: skip
