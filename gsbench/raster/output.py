"""What the rasterizer returns."""

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class RasterInfo:
    """What the rasterizer knows beside the image."""

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
        """Half the side of the square that holds every pixel drawn, [C, N] int32, pixels; 0: not drawn."""
        return self.half_sizes.detach().amax(-1).ceil_().int()


@dataclass(frozen=True)
class RasterOutput:
    """An image, how much of it is covered, and `RasterInfo`."""

    image: Tensor  # [C, H, W, D]
    alpha: Tensor  # [C, H, W, 1]
    info: RasterInfo
