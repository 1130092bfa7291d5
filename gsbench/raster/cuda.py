"""The rasterizer on the GPU: the picture of `reference`, in float32, by the kernels of `gsbench.kernels.cuda`."""

import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.arrays import plain
from gsbench.kernels.cuda import available, cuda, pointers, stream
from gsbench.kernels.cuda.raster import MAX_ITEMS, View, bin_tiles, bin_within, blend, project
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
    C, N, _ = colors.shape
    if C * N > MAX_ITEMS:
        raise InputError(f"raster backend 'cuda': expected at most {MAX_ITEMS} Gaussians times cameras, got {C * N}")
    colors = _one_set(colors)
    flags = _flags(means, factors, opacities, colors, viewmats, Ks, background)
    splats = project(means, factors, opacities, viewmats, Ks, view)
    bins, flagged = bin_tiles(splats, view, flags)
    if flagged:  # looked at on the device, so that only a bad picture waits for the words
        check_values(means, factors, opacities, colors, viewmats, Ks, background)
    image, alpha = blend(splats, colors, background, bins, view)
    radii = splats.half_sizes.amax(-1).ceil_().int()
    return RasterOutput(image, alpha, RasterInfo(radii, splats.means2d, splats.depths, len(bins.ids)))


def splat_within(
    means: Tensor, factors: Tensor, opacities: Tensor, colors: Tensor, viewmats: Tensor, Ks: Tensor,
    background: Tensor, view: View, room: int,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """The image [C, H, W, D] without waiting for the device, where `room` pairs of a tile and a Gaussian are enough.

    Whether they were is for the caller to see: the second tensor, [2] int64, is how many there were, and not zero where
    a value was out of range.
    """
    colors = _one_set(colors)
    flags = _flags(means, factors, opacities, colors, viewmats, Ks, background)
    splats = project(means, factors, opacities, viewmats, Ks, view)
    bins, needed = bin_within(splats, view, flags, room)
    return blend(splats, colors, background, bins, view)[0], needed


def _one_set(colors: Tensor) -> Tensor:
    """Colours [C, N, D], or [1, N, D] where every camera sees the same."""
    return colors[:1] if len(colors) == 1 or colors.stride(0) == 0 else colors


def _flags(*values: Tensor) -> Tensor:
    """Not zero where a value is not finite or out of range, [1] int64: found out by the device, and not waited for.

    `values` are means, factors, opacities, colors, viewmats, Ks, background.
    """
    means, _, _, colors, viewmats, *_ = values
    flags, rows = torch.zeros(1, dtype=torch.int64, device=means.device), plain(*values)
    cuda().flag_values(len(means), len(viewmats), colors.numel(), colors.shape[-1], *pointers(*rows, flags),
                       stream(means))  # fmt: skip
    return flags
