"""Define the results of the rasterizer."""

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class RasterInfo:
    """The results of the rasterizer for density control."""

    half_sizes: Tensor  # [C, N, 2] pixels: half the sides of the rectangle that holds every pixel drawn; 0: not drawn
    means2d: Tensor  # [C, N, 2] pixels, in the autograd graph: its gradient drives densification
    depths: Tensor  # [C, N] camera-space z of the means
    pairs: int  # (tile, Gaussian) pairs blended

    @property
    def drawn(self) -> Tensor:
        """Tell which Gaussians reach a pixel at an alpha of 1/255 or more, [C, N] bool."""
        return self.half_sizes.detach()[..., 0] > 0

    @property
    def radii(self) -> Tensor:
        """Return half the side of the square around each splat, [C, N] int32, pixels; 0 if the Gaussian is culled."""
        return self.half_sizes.detach().amax(-1).ceil_().int()


@dataclass(frozen=True)
class RasterOutput:
    """An image, its alpha, and `RasterInfo`."""

    image: Tensor  # [C, H, W, D]
    alpha: Tensor  # [C, H, W, 1]
    info: RasterInfo
