"""Define `rasterize`, which checks its arguments and renders Gaussians by the torch, CPU or CUDA backend."""

from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.backends import CPU, CUDA, Backend, resolve
from gsbench.kernels.raster import EPS2D, FAR, NEAR, RasterInputs, Viewport
from gsbench.kernels.tensors import check_tensor
from gsbench.raster import native, reference
from gsbench.raster.interface import RasterInfo, RasterOutput, check_arguments

__all__ = ["EPS2D", "FAR", "NEAR", "RasterInfo", "RasterOutput", "rasterize"]


def rasterize(
    means: Tensor,  # [N, 3] or [C, N, 3]
    factors: Tensor,  # [N, 3, 3] or [C, N, 3, 3]
    opacities: Tensor,  # [N] or [C, N]
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
    beta_exponents: Tensor | None = None,  # [N] or [C, N]
) -> RasterOutput:
    """Render N Gaussians to C images by the rules of 3DGS (Kerbl et al. 2023, section 4 and appendix C).

    The covariance of a Gaussian is F F^T, where F is any square matrix in `factors`.

    Gaussians are blended front to back by camera depth; of equal depths the lower index comes first. The alpha of a
    Gaussian in a pixel is `min(0.999, opacity * exp(-r2 / 2))`. Here r2 = d^T S^-1 d, with the offset d from the centre
    and the projected covariance S (with `eps2d`), in pixels. With exponents b of Beta profiles alpha is
    `min(0.999, opacity * (1 - r2)^b)` where r2 < 1, and zero elsewhere; 1 - r2 is held above 1e-6. Alphas below 1/255
    are skipped. A pixel stops before the Gaussian that would reduce its transmittance below 1e-4.

    Args:
        means: the means, [N, 3] for all cameras or [C, N, 3] for each camera, world units. Factors, opacities and
            exponents are then for each camera too.
        factors: the factors F of the covariances F F^T, [N, 3, 3], world units.
        opacities: the opacities in [0, 1], [N].
        colors: D colour channels, [N, D] for all cameras or [C, N, D] for each camera.
        viewmats: rigid world-to-camera matrices with OpenCV axes (x right, y down, z forward), [C, 4, 4].
        Ks: intrinsics [fx 0 cx; 0 fy cy; 0 0 1] in pixels, [C, 3, 3]; the centre of the first pixel is (0.5, 0.5).
        width: the width of the images, pixels.
        height: the height of the images, pixels.
        background: the background colour, [D]; None: black.
        near: Gaussians whose mean is nearer than this depth are culled.
        far: Gaussians whose mean is farther than this depth are culled.
        eps2d: the number that is added to the diagonal of the projected covariances, pixels^2.
        backend: `reference` (torch), `cpu` or `cuda` (kernels), or `auto` (the fastest installed one).
        antialias: whether to scale opacities for the area that `eps2d` adds, as the 2D filter of Mip-Splatting does.
        beta_exponents: the exponents b > 0 of the Beta profiles (Universal Beta Splatting), [N]; None: Gaussians.

    Returns:
        The images [C, H, W, D], their alpha [C, H, W, 1], and `RasterInfo` for density control.

    Raises:
        InputError: a shape, dtype, device or value is not as above, or the backend is unknown or not installed.

    Example:
        A red ball of radius 0.1 is two units in front of the camera.

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
        raise InputError(
            f"backend, antialias: expected a name or a Backend, and True or False, got {backend!r:.40} "
            f"and {antialias!r:.40}"
        )
    if background is None:
        check_tensor(colors, "colors")
        background = colors.new_zeros(colors.shape[-1:])
    inputs = RasterInputs(means, factors, opacities, colors, viewmats, Ks, background, beta_exponents)
    viewport = Viewport(width, height, near, far, eps2d, antialias)
    check_arguments(inputs, viewport)
    chosen = resolve(backend, means.device.type) if isinstance(backend, str) else backend
    if chosen.serves(means):
        return native.draw(inputs, viewport)
    if backend != "auto" and chosen in (CPU, CUDA):
        raise InputError(
            f"raster backend '{chosen.name}': expected float32 tensors on device '{chosen.name}', got "
            f"{means.dtype} on {means.device}; backend 'reference' takes any"
        )
    return reference.draw(inputs, viewport)
