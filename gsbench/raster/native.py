"""Rasterize in float32 by the kernels for CPU and CUDA; the images equal those of the PyTorch code."""

from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.raster import (
    LOWER,
    MAX_PAIRS,
    TILE_PIXELS,
    RasterInputs,
    Viewport,
    bin_tiles,
    bin_within,
    blend,
    count_tiles,
    flag_values,
    project,
)
from gsbench.process.memory import require
from gsbench.raster.interface import RasterInfo, RasterOutput, check_values

MAX_GAUSSIANS = 1 << 24  # limit of the CPU kernel, which stores positions in the list of a tile as floats


def draw(inputs: RasterInputs, viewport: Viewport) -> RasterOutput:
    """Render images for all cameras by the CPU or CUDA kernels; see `gsbench.raster.rasterize`.

    On a CPU the results have the same bits for any number of threads. On a GPU gradients are added in random order, and
    the call synchronises once, to read the number of tile intersections.

    Raises:
        InputError: the intrinsics `Ks` require a gradient, a value is out of range, or the CPU memory does not suffice.
        torch.OutOfMemoryError: the GPU memory does not suffice.
    """
    device = inputs.means.device.type
    if inputs.Ks.requires_grad:
        raise InputError(f"raster backend '{device}' has no gradient by Ks: detach them, or use backend 'reference'")
    C, N = len(inputs.viewmats), inputs.means.shape[-2]
    if device == "cpu":
        if N >= MAX_GAUSSIANS:
            raise InputError(f"raster backend 'cpu': expected fewer than {MAX_GAUSSIANS} Gaussians, got {N}")
        numbers = C * count_tiles(viewport.width, viewport.height) * TILE_PIXELS * (2 * inputs.colors.shape[-1] + 4)
        size = f"{C} images of {viewport.width}x{viewport.height} with {N} Gaussians"
        require(4 * (numbers + C * N * 20), size, LOWER)
    if C * N > MAX_PAIRS:
        raise InputError(
            f"raster backend '{device}': expected at most {MAX_PAIRS} Gaussians times cameras, got {C * N}"
        )
    flags = flag_values(inputs)
    splats = project(inputs, viewport)
    bins, flagged = bin_tiles(splats, viewport, flags)
    if flagged:  # the kernel met a bad value: find out which one, for the error message
        check_values(inputs)
    image, alpha = blend(splats, inputs.colors, inputs.background, bins, viewport)
    return RasterOutput(image, alpha, RasterInfo(splats.half_sizes, splats.means2d, splats.depths, len(bins.ids)))


def draw_within(inputs: RasterInputs, viewport: Viewport, room: int) -> tuple[Tensor, Tensor]:
    """Render images [C, H, W, D] without a GPU synchronisation, with memory for `room` tile intersections.

    The second result, [2] int64, is the number of intersections, and a flag that is not zero if an input is out of
    range. If the number is larger than `room`, the image is incomplete.
    """
    flags = flag_values(inputs)
    splats = project(inputs, viewport)
    bins, needed = bin_within(splats, viewport, flags, room)
    return blend(splats, inputs.colors, inputs.background, bins, viewport)[0], needed
