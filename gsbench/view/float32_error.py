"""Bound the error of float32 in each pixel of a frame, and say why where there is no such bound."""

import time
from typing import NamedTuple

import torch
from torch import Tensor

from gsbench.errors import InputError, one_line
from gsbench.measure.images import STEPS, Pixels, rounding_image
from gsbench.models import GaussianModel, Query
from gsbench.models.sliced import Gaussians3D
from gsbench.models.twins import exact_view
from gsbench.scenes import Camera


class Float32Error(NamedTuple):
    """The bound on the error of float32 in a frame: its image, and a summary in steps of 8 bits, 1/255."""

    image: Pixels  # [H, W, 3] RGB, on the scale of `gsbench.measure.images.rounding_image`
    largest: float  # bound of a pixel
    median: float  # bound of the pixels that show a Gaussian
    undecided: float  # share of the pixels in which rounding may decide what is blended, or in which order
    seconds: float  # that it took


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


@torch.inference_mode()
def float32_error(
    exact: GaussianModel,  # the model in float64, used by one thread at a time
    single: Gaussians3D,  # the slice of the float32 model that the image shows
    query: Query,  # the viewpoint and the time of that slice, float64
    camera: Camera,
    background: Tensor,  # [3] float32
    antialias: bool,
) -> Float32Error:
    """Bound the error of each pixel of a float32 image.

    Raises:
        InputError: the model does not compute in float64, or a Gaussian has a value that is not finite.
    """
    start = time.perf_counter()
    try:
        gaussians = exact.slice(query)
    except InputError:
        raise
    except Exception as error:  # a user's model may compute in float32 alone, and fail in any way
        raise InputError(f"the model does not compute in float64: {one_line(error)}") from None
    view = exact_view(gaussians, single, camera, background, antialias)
    bound = STEPS * view.bound
    return Float32Error(
        rounding_image(bound.numpy()),
        largest=float(bound.max()),
        median=STEPS * view.median_bound,
        undecided=float(view.undecided.double().mean()),
        seconds=time.perf_counter() - start,
    )
