"""Define what the rasterizer returns, and check what it takes: shapes, dtypes, devices and values."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.operation import MOST_KNOWN
from gsbench.kernels.raster import LOWER, RasterInputs, Viewport
from gsbench.kernels.tensors import check_tensor
from gsbench.process.memory import require

_known: set[tuple[object, ...]] = set()  # shapes and dtypes that passed the checks, since a training repeats them


@dataclass(frozen=True)
class RasterInfo:
    """Hold the results of the rasterizer that density control needs: 2D means, sizes and depths of the splats."""

    half_sizes: Tensor  # [C, N, 2] pixels: half width and height of the splat's bounding rectangle; 0: culled
    means2d: Tensor  # [C, N, 2] pixels, in the autograd graph; density control uses its gradient
    depths: Tensor  # [C, N] z of the means in camera space
    pairs: int  # number of tile intersections

    @property
    def drawn(self) -> Tensor:
        """Which Gaussians are not culled in each of C images, [C, N] bool."""
        return self.half_sizes.detach()[..., 0] > 0

    @property
    def radii(self) -> Tensor:
        """The radii of the splats in pixels, rounded up, [C, N] int32; 0 for a culled Gaussian."""
        return self.half_sizes.detach().amax(-1).ceil_().int()


@dataclass(frozen=True)
class RasterOutput:
    """Hold the rendered images, their alpha, and further results for density control."""

    image: Tensor  # [C, H, W, D]
    alpha: Tensor  # [C, H, W, 1]
    info: RasterInfo


def check_arguments(inputs: RasterInputs, viewport: Viewport) -> None:
    """Raise InputError if a shape, dtype or device, or the image size, is not what `rasterize` requires."""
    _check_viewport(viewport)
    call = (
        viewport.width,
        viewport.height,
        *[(x.shape, x.dtype, x.device, x.layout) if isinstance(x, Tensor) else type(x) for x in inputs],
    )
    if call in _known:
        return
    tensors = {name: x for name, x in inputs._asdict().items() if name != "beta_exponents" or x is not None}
    for name, tensor in tensors.items():
        check_tensor(tensor, name)
        if tensor.dim() == 0:
            raise InputError(f"{name}: expected a tensor of at least one dimension, got one of shape []")
    means, colors, C, D = inputs.means, inputs.colors, len(inputs.viewmats), inputs.colors.shape[-1]
    N = means.shape[-2] if means.dim() == 3 else len(means)
    rows = [C, N] if means.dim() == 3 else [N]
    shape_of_colors = [N, D] if colors.dim() == 2 else [C, N, D]
    shapes = [[*rows, 3], [*rows, 3, 3], rows, shape_of_colors, [C, 4, 4], [C, 3, 3], [D], rows]
    for (name, tensor), shape in zip(tensors.items(), shapes, strict=False):  # exponents may be left out
        if list(tensor.shape) != shape:
            raise InputError(f"{name}: expected shape {shape}, got {list(tensor.shape)}")
        if tensor.dtype != means.dtype:
            raise InputError(f"{name}: expected {means.dtype} as means are, got {tensor.dtype}")
        if tensor.device != means.device:
            raise InputError(f"{name}: expected on {means.device} as means are, got {tensor.device}")
    if D < 1 or C < 1:
        raise InputError(f"colors, viewmats: expected at least one channel and one camera, got D={D}, C={C}")
    if means.device.type == "cpu":
        size = f"{C} images of {viewport.width}x{viewport.height} with {D} channels and {N} Gaussians"
        # image and alpha, and about 30 numbers of each Gaussian
        require(means.element_size() * (C * viewport.width * viewport.height * (D + 1) + C * N * 30), size, LOWER)
    if len(_known) >= MOST_KNOWN:
        _known.clear()
    _known.add(call)


def _check_viewport(viewport: Viewport) -> None:
    """Raise InputError unless width and height are at least 1, 0 < near < far, and eps2d >= 0."""
    width, height, near, far, eps2d, _ = viewport
    if not all(type(size) is int and size >= 1 for size in (width, height)):
        raise InputError(
            f"expected an image of at least 1x1 whole pixels, got width={width!r:.40}, height={height!r:.40}"
        )
    numbers = all(isinstance(x, float | int) for x in (near, far, eps2d))
    if not numbers or not 0 < near < far or not 0 <= eps2d < math.inf:
        raise InputError(
            f"expected 0 < near < far and eps2d >= 0, got near={near!r:.40}, far={far!r:.40}, eps2d={eps2d!r:.40}"
        )


def check_values(inputs: RasterInputs) -> None:
    """Raise InputError unless values are finite, opacities in [0, 1], and focal lengths and exponents positive."""
    for name, tensor in inputs._asdict().items():
        # The sum needs one pass. A finite sum contains no NaN, so single values are checked only if it is not finite.
        if tensor is not None and not torch.isfinite(tensor.detach().sum()) and not torch.isfinite(tensor).all():
            row = int((~torch.isfinite(tensor)).flatten().nonzero()[0])
            raise InputError(f"{name}: expected finite values, got {tensor.flatten()[row].item()} at flat index {row}")
    low, high = inputs.opacities.detach().aminmax() if inputs.opacities.numel() else (0, 0)
    if low < 0 or high > 1:
        raise InputError(f"opacities: expected values in [0, 1], got {low} to {high}")
    exponents, Ks = inputs.beta_exponents, inputs.Ks.detach()
    if exponents is not None and exponents.numel() and (least := exponents.detach().min()) <= 0:
        raise InputError(
            f"beta_exponents: expected exponents above 0, got {least}: exponentiate raw parameters, or use softplus"
        )
    if (Ks[:, [0, 1], [0, 1]] <= 0).any():
        raise InputError("Ks: expected positive focal lengths at [0, 0] and [1, 1]")
    rest = Ks[:, [0, 1, 2, 2, 2], [1, 0, 0, 1, 2]]  # all entries but fx, fy, cx and cy
    if (rest != rest.new_tensor([0.0, 0.0, 0.0, 0.0, 1.0])).any():
        raise InputError("Ks: expected [fx 0 cx; 0 fy cy; 0 0 1]: skew is not drawn, undistort the images without it")
