"""Define the data types of the rasterizer's results."""

from dataclasses import dataclass

from torch import Tensor


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
