"""Check the shapes, dtypes, devices and values of the arguments of the rasterizer."""

import math

import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.operation import MOST_KNOWN
from gsbench.kernels.raster import LOWER
from gsbench.kernels.tensors import check_tensor
from gsbench.process.memory import require

_known: set[tuple[object, ...]] = set()  # shapes and dtypes that passed the checks, since a training repeats them


def check_arguments(
    means: Tensor, factors: Tensor, opacities: Tensor, colors: Tensor, viewmats: Tensor, Ks: Tensor,
    width: int, height: int, background: Tensor | None, near: float, far: float, eps2d: float,
    shapes: Tensor | None = None,
) -> None:  # fmt: skip
    """Raise InputError if a shape, dtype or device, or the image size, is not what `rasterize` requires."""
    _check_viewport(width, height, near, far, eps2d)
    given = means, factors, opacities, colors, viewmats, Ks, background, shapes
    call = width, height, *[(x.shape, x.dtype, x.device, x.layout) if isinstance(x, Tensor) else type(x) for x in given]
    if call in _known:
        return
    tensors = {"means": means, "factors": factors, "opacities": opacities, "colors": colors,
               "viewmats": viewmats, "Ks": Ks}  # fmt: skip
    tensors |= {name: x for name, x in (("background", background), ("shapes", shapes)) if x is not None}
    for name, tensor in tensors.items():
        check_tensor(tensor, name)
        if tensor.dim() == 0:
            raise InputError(f"{name}: expected a tensor of at least one dimension, got one of shape []")
    N, C, D = len(means), len(viewmats), colors.shape[-1]
    sizes = {"means": (N, 3), "factors": (N, 3, 3), "opacities": (N,), "viewmats": (C, 4, 4), "Ks": (C, 3, 3),
             "colors": (N, D) if colors.dim() == 2 else (C, N, D), "background": (D,), "shapes": (N,)}  # fmt: skip
    for name, tensor in tensors.items():
        if tuple(tensor.shape) != sizes[name]:
            raise InputError(f"{name}: expected shape {list(sizes[name])}, got {list(tensor.shape)}")
        if tensor.dtype != means.dtype:
            raise InputError(f"{name}: expected {means.dtype} as means are, got {tensor.dtype}")
        if tensor.device != means.device:
            raise InputError(f"{name}: expected on {means.device} as means are, got {tensor.device}")
    if D < 1 or C < 1:
        raise InputError(f"colors, viewmats: expected at least one channel and one camera, got D={D}, C={C}")
    if means.device.type == "cpu":
        size = f"{C} images of {width}x{height} with {D} channels and {N} Gaussians"
        require(means.element_size() * (C * width * height * (D + 1) + C * N * 30), size, LOWER)
    if len(_known) >= MOST_KNOWN:
        _known.clear()
    _known.add(call)


def _check_viewport(width: int, height: int, near: float, far: float, eps2d: float) -> None:
    """Raise InputError unless width and height are at least 1, 0 < near < far, and eps2d >= 0."""
    if not all(type(size) is int and size >= 1 for size in (width, height)):
        raise InputError(f"expected an image of at least 1x1 whole pixels, got width={width!r:.40}, "
                         f"height={height!r:.40}")  # fmt: skip
    numbers = all(isinstance(x, float | int) for x in (near, far, eps2d))
    if not numbers or not 0 < near < far or not 0 <= eps2d < math.inf:
        raise InputError(f"expected 0 < near < far and eps2d >= 0, got near={near!r:.40}, far={far!r:.40}, "
                         f"eps2d={eps2d!r:.40}")  # fmt: skip


def check_values(
    means: Tensor, factors: Tensor, opacities: Tensor, colors: Tensor, viewmats: Tensor, Ks: Tensor, background: Tensor,
    shapes: Tensor | None = None,
) -> None:  # fmt: skip
    """Raise InputError unless values are finite, opacities in [0, 1], and focal lengths and shapes positive."""
    tensors = {"means": means, "factors": factors, "opacities": opacities, "colors": colors,
               "viewmats": viewmats, "Ks": Ks, "background": background}  # fmt: skip
    if shapes is not None:
        tensors["shapes"] = shapes
    for name, tensor in tensors.items():
        # The sum needs one pass. A finite sum contains no NaN, so single values are checked only if it is not finite.
        if not torch.isfinite(tensor.detach().sum()) and not torch.isfinite(tensor).all():
            row = int((~torch.isfinite(tensor)).flatten().nonzero()[0])
            raise InputError(f"{name}: expected finite values, got {tensor.flatten()[row].item()} at flat index {row}")
    low, high = opacities.detach().aminmax() if len(means) else (0, 0)
    if low < 0 or high > 1:
        raise InputError(f"opacities: expected values in [0, 1], got {low} to {high}")
    if shapes is not None and len(shapes) and (least := shapes.detach().min()) <= 0:
        raise InputError(
            f"shapes: expected exponents above 0, got {least}: exponentiate raw parameters, or use softplus"
        )
    if (Ks.detach()[:, [0, 1], [0, 1]] <= 0).any():
        raise InputError("Ks: expected positive focal lengths at [0, 0] and [1, 1]")
    rest = Ks.detach()[:, [0, 1, 2, 2, 2], [1, 0, 0, 1, 2]]
    if (rest != rest.new_tensor([0.0, 0.0, 0.0, 0.0, 1.0])).any():
        raise InputError("Ks: expected [fx 0 cx; 0 fy cy; 0 0 1]: skew is not drawn, undistort the images without it")
