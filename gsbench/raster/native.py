"""Rasterize in float32 by the kernels for CPU and CUDA; the images equal those of the PyTorch code."""

from gsbench.errors import InputError
from gsbench.kernels import recording
from gsbench.kernels.library import library_of
from gsbench.kernels.raster import (
    LOWER,
    MAX_PAIRS,
    TILE_PIXELS,
    RasterInputs,
    Viewport,
    bin_tiles,
    blend,
    count_tiles,
    draw_on_gpu,
    flag_values,
    project,
)
from gsbench.process.memory import require
from gsbench.raster.interface import RasterInfo, RasterOutput, check_values

MAX_GAUSSIANS = 1 << 24  # limit of the CPU kernel, which stores positions in the list of a tile as floats


def draw(inputs: RasterInputs, viewport: Viewport) -> RasterOutput:
    """Render images for all cameras by the CPU or CUDA kernels; see `gsbench.raster.rasterize`.

    On a CPU the results have the same bits for any number of threads. On a GPU gradients are added in random order, and
    the call waits for the image, to read the number of tile intersections and whether a value was out of range.

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
        # float32 of each pixel: image, alpha, their gradients, transmittance and stop; and about 20 of each splat
        numbers = C * count_tiles(viewport.width, viewport.height) * TILE_PIXELS * (2 * inputs.colors.shape[-1] + 4)
        size = f"{C} images of {viewport.width}x{viewport.height} with {N} Gaussians"
        require(4 * (numbers + C * N * 20), size, LOWER)
    if C * N > MAX_PAIRS:
        raise InputError(
            f"raster backend '{device}': expected at most {MAX_PAIRS} Gaussians times cameras, got {C * N}"
        )
    if library_of(device).has("draw"):
        drawing, pairs, flagged = draw_on_gpu(inputs, viewport)
        if flagged:  # the kernel met a bad value: find out which one, for the error message
            check_values(inputs)
        splats, image, alpha = drawing.record()
    else:
        flags = flag_values(inputs)
        splats = project(inputs, viewport)
        bins = bin_tiles(splats, viewport)
        pairs = len(bins.ids)
        if recording.read(flags, lambda values: values == [0])[0]:  # not zero: a bad value, as above
            check_values(inputs)
        image, alpha = blend(splats, inputs.colors, inputs.background, bins, viewport)
    return RasterOutput(image, alpha, RasterInfo(splats.half_sizes, splats.means2d, splats.depths, pairs))
