"""The rasterizer on the native CPU kernels: the picture of `reference`, in float32 and much faster."""

import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.memory import require
from gsbench.kernels.raster import MAX_GAUSSIANS, TILE_PIXELS, bin_tiles, blend, count_tiles, project
from gsbench.raster import RasterInfo, RasterOutput


def draw(
    means: Tensor, factors: Tensor, opacities: Tensor, colors: Tensor, viewmats: Tensor, Ks: Tensor,
    width: int, height: int, background: Tensor, near: float, far: float, eps2d: float, antialias: bool,
) -> RasterOutput:  # fmt: skip
    """Draw every camera; arguments as `gsbench.raster.rasterize`, colours [C, N, D].

    Same inputs, same bits, for any number of threads. Intrinsics have no gradient here.

    Raises:
        InputError: not float32 on the CPU, a gradient by `Ks` is asked for, or memory would not suffice.
    """
    if means.dtype != torch.float32 or means.device.type != "cpu":
        raise InputError(f"raster backend 'cpu': expected float32 tensors on the CPU, got {means.dtype} on "
                         f"{means.device}; backend 'reference' takes any")  # fmt: skip
    if Ks.requires_grad:
        raise InputError("raster backend 'cpu' has no gradient by Ks: detach them, or use backend 'reference'")
    C, N, D = colors.shape
    if N >= MAX_GAUSSIANS:
        raise InputError(f"raster backend 'cpu': expected fewer than {MAX_GAUSSIANS} Gaussians, got {N}")
    pixels = C * count_tiles(width, height) * TILE_PIXELS
    require(4 * (pixels * (2 * D + 4) + C * N * 20), f"{C} pictures of {width}x{height} with {N} Gaussians")

    shared = C == 1 or colors.stride(0) == 0  # one set of colours, seen by every camera
    means2d, roots, opacities, depths, half_sizes = project(
        means, factors, opacities, viewmats, Ks, width, height, near, far, eps2d, antialias
    )
    offsets, ids = bin_tiles(means2d, depths, half_sizes, width, height)
    image, alpha, _, _ = blend(means2d, roots, opacities, half_sizes, colors[:1] if shared else colors, background,
                               offsets, ids, width, height)  # fmt: skip
    radii = half_sizes.amax(-1).ceil_().int()
    return RasterOutput(image, alpha, RasterInfo(radii, means2d, depths, len(ids)))
