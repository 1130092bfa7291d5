"""How it is drawn: `rasterize`, the one door to every backend, and the checks made at it."""

import functools
import importlib
import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from gsbench import kernels
from gsbench.errors import InputError, did_you_mean
from gsbench.kernels import cuda as cuda_kernels  # `cuda` is this package's own module

NEAR, FAR = 0.01, 1e10  # depths between which a mean is drawn, unless told
EPS2D = 0.3  # added to the diagonal of projected covariances, unless told, pixels^2

# A backend is a module with a function `draw` of this door's (checked) arguments.
_MODULES = {"reference": "gsbench.raster.reference", "cpu": "gsbench.raster.native", "cuda": "gsbench.raster.cuda"}


@dataclass(frozen=True)
class RasterInfo:
    """What the rasterizer knows beside the picture."""

    radii: Tensor  # [C, N] int32, pixels: half the side of the square that holds every pixel drawn; 0: not drawn
    means2d: Tensor  # [C, N, 2] pixels, in the autograd graph: its gradient drives densification
    depths: Tensor  # [C, N] camera-space z of the means
    pairs: int  # (tile, Gaussian) pairs blended


@dataclass(frozen=True)
class RasterOutput:
    """A picture, how much of it is covered, and `RasterInfo`."""

    image: Tensor  # [C, H, W, D]
    alpha: Tensor  # [C, H, W, 1]
    info: RasterInfo


def rasterize(
    means: Tensor,  # [N, 3]
    factors: Tensor,  # [N, 3, 3]
    opacities: Tensor,  # [N]
    colors: Tensor,  # [N, D] or [C, N, D]
    viewmats: Tensor,  # [C, 4, 4]
    Ks: Tensor,  # [C, 3, 3]
    width: int,
    height: int,
    *,
    background: Tensor | None = None,  # [D]
    near: float = NEAR,
    far: float = FAR,
    eps2d: float = EPS2D,
    backend: str = "auto",
    antialias: bool = False,
) -> RasterOutput:
    """Splat N Gaussians into C pictures by 3DGS' rules (Kerbl et al. 2023, section 4 and appendix C).

    The covariance of a Gaussian is F F^T for any square `factors` F, so it is semi-definite by construction.
    Blending is front to back in order of camera depth (ties: lower index first); a Gaussian adds
    `alpha = min(0.999, opacity * exp(-power))` where that is at least 1/255, until the next one would bring the
    transmittance below 1e-4.

    Args:
        means: centres, world units.
        factors: F of cov = F F^T, world units.
        opacities: in [0, 1].
        colors: any number D of channels, one set for all cameras or one a camera.
        viewmats: world to camera, rigid, OpenCV axes (x right, y down, z forward).
        Ks: intrinsics [fx 0 cx; 0 fy cy; 0 0 1] in pixels; the first pixel's centre is (0.5, 0.5).
        width: of the picture, pixels.
        height: of the picture, pixels.
        background: colour behind everything; None is black.
        near: Gaussians whose mean is nearer than this are not drawn.
        far: nor are those farther than this.
        eps2d: added to the diagonal of the projected covariance, pixels^2.
        backend: `reference` (torch), `cpu` and `cuda` (native), or `auto`, the fastest that serves the tensors' device.
        antialias: scale opacities by the area that `eps2d` added (Mip-Splatting's 2D filter).

    Raises:
        InputError: a shape, dtype, device or value is not as above, or the backend is unknown or not installed.
    """
    _check(means, factors, opacities, colors, viewmats, Ks, width, height, background, near, far, eps2d)
    if colors.dim() == 2:
        colors = colors.expand(len(viewmats), *colors.shape)
    if background is None:
        background = colors.new_zeros(colors.shape[-1])
    backend = choose_backend(backend, means.device.type, means.dtype)
    if backend != "cuda":  # which looks at the values itself, without waiting for the device
        check_values(means, factors, opacities, colors, viewmats, Ks, background)
    draw = _backend(backend)
    return draw(means, factors, opacities, colors, viewmats, Ks, width, height, background, near, far, eps2d, antialias)


def choose_backend(backend: str, device: str = "cpu", dtype: torch.dtype = torch.float32) -> str:
    """Resolve `auto` to the fastest backend installed for a device and dtype; check any other name.

    Raises:
        InputError: no such backend, it is not installed, or it does not draw on that device.
    """
    if backend == "auto":
        native = {"cpu": kernels.available, "cuda": cuda_kernels.available}.get(device)
        if native is None or dtype != torch.float32:
            return "reference"
        if cuda_kernels.built() and not cuda_kernels.available():
            _warn_once("no CUDA device was found: the CUDA kernels of this installation are idle, the CPU draws")
        if device == "cuda" and not cuda_kernels.built():
            _warn_once("the CUDA kernels are not built in this installation: the GPU draws by the reference backend, "
                       "which is slow; see docs/gpu.md")  # fmt: skip
        return device if native() else "reference"
    if backend not in _MODULES:
        raise InputError(f"raster backend '{backend}' is not known. {did_you_mean(backend, ['auto', *_MODULES])}")
    if backend == "cpu" and not kernels.available():
        raise InputError("raster backend 'cpu' is not built in this installation: reinstall with a C++20 compiler, "
                         "or use raster.backend=reference")  # fmt: skip
    if backend == "cuda" and not cuda_kernels.available():
        why = "no CUDA device was found" if cuda_kernels.built() else "it is not built here, see docs/gpu.md"
        raise InputError(f"raster backend 'cuda': {why}; use raster.backend=auto or reference")
    if backend in ("cpu", "cuda") and device in ("cpu", "cuda") and backend != device:
        raise InputError(f"raster backend '{backend}' does not draw on device '{device}': use device={backend}, "
                         "or raster.backend=auto or reference")  # fmt: skip
    return backend


@functools.cache
def _warn_once(why: str) -> None:
    """Say what `auto` falls back to, once a process."""
    warnings.warn(f"raster backend 'auto': {why}", stacklevel=3)


@functools.cache
def _backend(name: str) -> Callable[..., RasterOutput]:
    draw: Callable[..., RasterOutput] = importlib.import_module(_MODULES[name]).draw
    return draw


def _check(
    means: Tensor, factors: Tensor, opacities: Tensor, colors: Tensor, viewmats: Tensor, Ks: Tensor,
    width: int, height: int, background: Tensor | None, near: float, far: float, eps2d: float,
) -> None:  # fmt: skip
    """Raise InputError unless everything is as `rasterize` says."""
    tensors = {"means": means, "factors": factors, "opacities": opacities, "colors": colors,
               "viewmats": viewmats, "Ks": Ks}  # fmt: skip
    if background is not None:
        tensors["background"] = background
    for name, tensor in tensors.items():
        if not isinstance(tensor, Tensor) or tensor.dim() == 0:
            what = "one of shape []" if isinstance(tensor, Tensor) else type(tensor).__name__
            raise InputError(f"{name}: expected a tensor of at least one dimension, got {what}")
    N, C, D = len(means), len(viewmats), colors.shape[-1]
    shapes = {"means": (N, 3), "factors": (N, 3, 3), "opacities": (N,), "viewmats": (C, 4, 4), "Ks": (C, 3, 3),
              "colors": (N, D) if colors.dim() == 2 else (C, N, D), "background": (D,)}  # fmt: skip
    for name, tensor in tensors.items():
        if tuple(tensor.shape) != shapes[name]:
            raise InputError(f"{name}: expected shape {list(shapes[name])}, got {list(tensor.shape)}")
        if tensor.dtype != means.dtype or not tensor.is_floating_point():
            raise InputError(f"{name}: expected {means.dtype} as means are (a float type), got {tensor.dtype}")
        if tensor.device != means.device:
            raise InputError(f"{name}: expected on {means.device} as means are, got {tensor.device}")
    if D < 1 or C < 1:
        raise InputError(f"colors, viewmats: expected at least one channel and one camera, got D={D}, C={C}")
    if not all(isinstance(size, int) and size >= 1 for size in (width, height)):
        raise InputError(f"expected a picture of at least 1x1 whole pixels, got width={width}, height={height}")
    if not 0 < near < far or not 0 <= eps2d < math.inf:
        raise InputError(f"expected 0 < near < far and eps2d >= 0, got near={near}, far={far}, eps2d={eps2d}")


def check_values(
    means: Tensor, factors: Tensor, opacities: Tensor, colors: Tensor, viewmats: Tensor, Ks: Tensor, background: Tensor,
) -> None:  # fmt: skip
    """Raise InputError unless every value is finite, opacities are in [0, 1] and focal lengths positive."""
    tensors = {"means": means, "factors": factors, "opacities": opacities, "colors": colors,
               "viewmats": viewmats, "Ks": Ks, "background": background}  # fmt: skip
    for name, tensor in tensors.items():
        # A sum is one pass; only when it is not finite is each value looked at (a finite sum hides no NaN).
        if not torch.isfinite(tensor.detach().sum()) and not torch.isfinite(tensor).all():
            row = int((~torch.isfinite(tensor)).flatten().nonzero()[0])
            raise InputError(f"{name}: expected finite values, got {tensor.flatten()[row].item()} at flat index {row}")
    low, high = opacities.detach().aminmax() if len(means) else (0, 0)
    if low < 0 or high > 1:
        raise InputError(f"opacities: expected values in [0, 1], got {low} to {high}")
    if (Ks.detach()[:, [0, 1], [0, 1]] <= 0).any():
        raise InputError("Ks: expected positive focal lengths at [0, 0] and [1, 1]")
    rest = Ks.detach()[:, [0, 1, 2, 2, 2], [1, 0, 0, 1, 2]]
    if (rest != rest.new_tensor([0.0, 0.0, 0.0, 0.0, 1.0])).any():
        raise InputError("Ks: expected [fx 0 cx; 0 fy cy; 0 0 1]: skew is not drawn, undistort the images without it")
