"""Rasterize Gaussians: check the arguments of `rasterize` and call the backend."""

from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.backends import CPU, CUDA, Backend, resolve
from gsbench.kernels.raster import Viewport
from gsbench.raster import native, reference
from gsbench.raster.checks import check_arguments, check_shapes, check_values
from gsbench.raster.output import RasterInfo, RasterOutput

__all__ = ["EPS2D", "FAR", "NEAR", "RasterInfo", "RasterOutput", "rasterize"]

NEAR, FAR = 0.01, 1e10  # depths between which a mean is drawn, unless told
EPS2D = 0.3  # added to the diagonal of projected covariances, unless told, pixels^2


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
    backend: str | Backend = "auto",
    antialias: bool = False,
    shapes: Tensor | None = None,  # [N]
) -> RasterOutput:
    """Render N Gaussians to C images by the rules of 3DGS (Kerbl et al. 2023, section 4 and appendix C).

    The covariance of a Gaussian is F F^T for any square `factors` F, so it is always semi-definite.
    Gaussians are blended front to back by camera depth (ties: lower index first). A Gaussian has
    `alpha = min(0.999, opacity * exp(-power))`, and is skipped if that is below 1/255. The Gaussian that would bring
    the transmittance below 1e-4 ends the pixel.

    Args:
        means: centres [N, 3], world units.
        factors: F of cov = F F^T [N, 3, 3], world units.
        opacities: in [0, 1], [N].
        colors: any number D of channels, one set for all cameras [N, D] or one for each [C, N, D].
        viewmats: world to camera [C, 4, 4], rigid, OpenCV axes (x right, y down, z forward).
        Ks: intrinsics [fx 0 cx; 0 fy cy; 0 0 1] in pixels, [C, 3, 3]; the first pixel's centre is (0.5, 0.5).
        width: of the image, pixels.
        height: of the image, pixels.
        background: colour behind everything [D]; None is black.
        near: Gaussians whose mean is nearer are culled.
        far: Gaussians whose mean is farther are culled.
        eps2d: added to the diagonal of the projected covariance, pixels^2.
        backend: or its name: `reference` (torch), `cpu`, `cuda` (kernels), `auto` (the fastest installed one).
        antialias: scale opacities by the area that `eps2d` added (Mip-Splatting's 2D filter).
        shapes: b > 0 of each alpha profile, [N]: alpha = min(0.999, opacity * beta(r; b)) with beta(r; b) = (1 - r^2)^b
            for r < 1 and zero elsewhere; r^2 = d^T cov2d^-1 d of the pixel's offset d (Universal Beta Splatting). None
            is the Gaussian, of power r^2 / 2. No backend has built another profile yet: each refuses shapes.

    Returns:
        The image [C, H, W, D], its alpha [C, H, W, 1], and `RasterInfo` for density control.

    Raises:
        InputError: a shape, dtype, device or value is not as above, or the backend is unknown, not installed or without
            what is asked for.

    Example:
        A red ball of radius 0.1, two units in front of the camera.

        >>> import torch
        >>> from gsbench import rasterize
        >>> mean, factor = torch.tensor([[0.0, 0.0, 2.0]]), 0.1 * torch.eye(3)[None]
        >>> opacity, red = torch.tensor([0.9]), torch.tensor([[1.0, 0.0, 0.0]])
        >>> K = torch.tensor([[[32.0, 0.0, 16.0], [0.0, 32.0, 16.0], [0.0, 0.0, 1.0]]])
        >>> drawn = rasterize(mean, factor, opacity, red, torch.eye(4)[None], K, 32, 32)
        >>> drawn.image.shape
        torch.Size([1, 32, 32, 3])
        >>> [round(value, 2) for value in drawn.image[0, 16, 16].tolist()]
        [0.82, 0.0, 0.0]
    """
    if not isinstance(backend, str | Backend) or not isinstance(antialias, bool):
        raise InputError(f"backend, antialias: expected a name or a Backend, and True or False, got {backend!r:.40} "
                         f"and {antialias!r:.40}")  # fmt: skip
    check_shapes(shapes, backend if isinstance(backend, str) else backend.name)
    check_arguments(means, factors, opacities, colors, viewmats, Ks, width, height, background, near, far, eps2d)
    if background is None:
        background = colors.new_zeros(colors.shape[-1])
    chosen = resolve(backend, means.device.type) if isinstance(backend, str) else backend
    inputs = means, factors, opacities, colors, viewmats, Ks, background
    viewport = Viewport(width, height, near, far, eps2d, antialias)
    if chosen.serves(means):
        return native.draw(*inputs, viewport)
    if backend != "auto" and chosen in (CPU, CUDA):
        raise InputError(f"raster backend '{chosen.name}': expected float32 tensors on device '{chosen.name}', got "
                         f"{means.dtype} on {means.device}; backend 'reference' takes any")  # fmt: skip
    check_values(*inputs)
    return reference.draw(*inputs, viewport)
