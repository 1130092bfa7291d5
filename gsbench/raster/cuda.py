"""The rasterizer on the GPU: the picture of `reference`, in float32, by the kernels of `gsbench.kernels.cuda`."""

import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.arrays import plain
from gsbench.kernels.cuda import available, cuda, pointers, stream
from gsbench.kernels.cuda.raster import MAX_ITEMS, View, bin_tiles, blend, project
from gsbench.raster import RasterInfo, RasterOutput, check_values


def draw(
    means: Tensor, factors: Tensor, opacities: Tensor, colors: Tensor, viewmats: Tensor, Ks: Tensor,
    width: int, height: int, background: Tensor, near: float, far: float, eps2d: float, antialias: bool,
) -> RasterOutput:  # fmt: skip
    """Draw every camera; arguments as `gsbench.raster.rasterize`, colours [C, N, D].

    Waits for the device once, for the number of pairs to sort. Gradients are sums in the order threads come by, so two
    runs differ in the last bits. Intrinsics have no gradient here.

    Raises:
        InputError: not float32 on a GPU, a gradient by `Ks` is asked for, or a value is out of range.
        torch.OutOfMemoryError: naming the buffer, its size and what to lower.
    """
    if means.dtype != torch.float32 or not means.is_cuda or not available():
        raise InputError(f"raster backend 'cuda': expected float32 tensors on a CUDA device, got {means.dtype} on "
                         f"{means.device}; backend 'reference' takes any")  # fmt: skip
    with torch.cuda.device(means.device):
        return splat(means, factors, opacities, colors, viewmats, Ks, background,
                     View(width, height, near, far, eps2d, antialias))  # fmt: skip


def splat(
    means: Tensor, factors: Tensor, opacities: Tensor, colors: Tensor, viewmats: Tensor, Ks: Tensor,
    background: Tensor, view: View,
) -> RasterOutput:  # fmt: skip
    """`draw` where the kernels can run."""
    if Ks.requires_grad:
        raise InputError("raster backend 'cuda' has no gradient by Ks: detach them, or use backend 'reference'")
    C, N, D = colors.shape
    if C * N > MAX_ITEMS:
        raise InputError(f"raster backend 'cuda': expected at most {MAX_ITEMS} Gaussians times cameras, got {C * N}")
    if C == 1 or colors.stride(0) == 0:  # one set of colours, seen by every camera
        colors = colors[:1]
    flags = torch.zeros(1, dtype=torch.int64, device=means.device)
    values = plain(means, factors, opacities, colors, viewmats, Ks, background)
    cuda().flag_values(N, C, colors.numel(), D, *pointers(*values, flags), stream(means))

    means2d, roots, depths, half_sizes = project(means, factors, opacities, viewmats, Ks, view)
    bins, flagged = bin_tiles(means2d, roots, depths, half_sizes, view.width, view.height, flags)
    if flagged:  # looked at on the device, so that only a bad picture waits for the words
        check_values(means, factors, opacities, colors, viewmats, Ks, background)
    image, alpha = blend(means2d, roots, colors, background, bins, view)
    radii = half_sizes.amax(-1).ceil_().int()
    return RasterOutput(image, alpha, RasterInfo(radii, means2d, depths, len(bins.ids)))
