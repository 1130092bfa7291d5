"""Rasterize by kernels on the CPU and on a GPU: the images of `reference`, in float32 and much faster."""

from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.raster import (
    LOWER,
    MAX_PAIRS,
    TILE_PIXELS,
    Viewport,
    bin_tiles,
    bin_within,
    blend,
    count_tiles,
    flag_values,
    project,
)
from gsbench.process.memory import require
from gsbench.raster.checks import check_values
from gsbench.raster.output import RasterInfo, RasterOutput

MAX_GAUSSIANS = 1 << 24  # on the CPU, where positions in a tile's list are kept as float


def draw(
    means: Tensor, factors: Tensor, opacities: Tensor, colors: Tensor, viewmats: Tensor, Ks: Tensor,
    background: Tensor, viewport: Viewport,
) -> RasterOutput:  # fmt: skip
    """Render every camera; arguments as in `gsbench.raster.rasterize`. Intrinsics have no gradient here.

    On the CPU the same inputs give the same bits, for any number of threads. On a GPU threads add gradients in any
    order, and the call waits once for the device, to read the number of intersections.

    Raises:
        InputError: `Ks` requires a gradient, a value is out of range, or memory does not suffice.
        torch.OutOfMemoryError: on a GPU, naming the buffer, its size and what to lower.
    """
    device = means.device.type
    if Ks.requires_grad:
        raise InputError(f"raster backend '{device}' has no gradient by Ks: detach them, or use backend 'reference'")
    C, N, D = viewmats.shape[0], means.shape[0], colors.shape[-1]
    if device == "cpu":
        _check_room(C, N, D, viewport)
    if C * N > MAX_PAIRS:
        raise InputError(f"raster backend '{device}': expected at most {MAX_PAIRS} Gaussians times cameras, got "
                         f"{C * N}")  # fmt: skip
    flags = flag_values(means, factors, opacities, colors, viewmats, Ks, background)
    splats = project(means, factors, opacities, viewmats, Ks, viewport)
    bins, flagged = bin_tiles(splats, viewport, flags)
    if flagged:  # looked at by the kernel, so that only a bad value waits for the words
        check_values(means, factors, opacities, colors, viewmats, Ks, background)
    image, alpha = blend(splats, colors, background, bins, viewport)
    return RasterOutput(image, alpha, RasterInfo(splats.half_sizes, splats.means2d, splats.depths, len(bins.ids)))


def draw_within(
    means: Tensor, factors: Tensor, opacities: Tensor, colors: Tensor, viewmats: Tensor, Ks: Tensor,
    background: Tensor, viewport: Viewport, room: int,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Return the image [C, H, W, D] without waiting for a GPU, with memory for `room` intersections.

    The second result, [2] int64, has the number of intersections, and a flag that is not zero if a value was out of
    range. The caller must compare the number with `room`.
    """
    flags = flag_values(means, factors, opacities, colors, viewmats, Ks, background)
    splats = project(means, factors, opacities, viewmats, Ks, viewport)
    bins, needed = bin_within(splats, viewport, flags, room)
    return blend(splats, colors, background, bins, viewport)[0], needed


def _check_room(C: int, N: int, D: int, viewport: Viewport) -> None:
    """Raise InputError if there are too many Gaussians to count, or if memory does not suffice."""
    if N >= MAX_GAUSSIANS:
        raise InputError(f"raster backend 'cpu': expected fewer than {MAX_GAUSSIANS} Gaussians, got {N}")
    pixels = C * count_tiles(viewport.width, viewport.height) * TILE_PIXELS
    size = f"{C} images of {viewport.width}x{viewport.height} with {N} Gaussians"
    require(4 * (pixels * (2 * D + 4) + C * N * 20), size, LOWER)
