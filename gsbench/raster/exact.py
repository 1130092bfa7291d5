"""Render an image in float64, and bound for each pixel the error of the same image in float32.

The Gaussians are given twice: computed in float64, and computed in float32. The kernels project both, and what rounding
does to each projected Gaussian is the difference. A kernel blends the exact image and carries the differences, the
rounding of blending itself, and the jumps of undecided branches to the pixels (`gsbench/kernels/cpu/exact.cpp`).
"""

from typing import NamedTuple

import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.library import Library, library_of
from gsbench.kernels.operation import address
from gsbench.kernels.raster import RasterInputs, Splats, Viewport, bin_tiles, project
from gsbench.raster import EPS2D, FAR, NEAR
from gsbench.raster.interface import check_arguments, check_values

U = 2.0**-24  # the unit roundoff of float32
RECORD = 16  # doubles of a Gaussian that is projected in float64 and float32
BOXES = ("means2d", "half_sizes", "depths")

# What rounding may decide: whether a Gaussian is blended whose alpha is near 1/255, or that may be culled; where a
# pixel ends; and the order of Gaussians of equal depth (`Branch` of gsbench/kernels/cpu/kernels.h).
SKIPPED, STOPPED, ORDERED = 1, 2, 4

# Means [N, 3], factors [N, 3, 3], opacities [N], colours [N, D], and exponents of Beta profiles [N] or None.
Gaussians = tuple[Tensor, Tensor, Tensor, Tensor, Tensor | None]


class ExactImage(NamedTuple):
    """An image in float64, and what is known of the same image in float32."""

    image: Tensor  # [H, W, D] float64
    bound: Tensor  # [H, W] float64: no channel of the image by the CPU kernels is farther than this from `image`
    culprit: Tensor  # [H, W] int32: the Gaussian with the largest share of the bound; -1: none
    branches: Tensor  # [H, W] uint8: what rounding may decide here, a sum of SKIPPED, STOPPED and ORDERED

    @property
    def undecided(self) -> Tensor:
        """Whether rounding may decide which Gaussians are blended in a pixel, or their order, [H, W] bool."""
        return self.branches > 0

    @property
    def median_bound(self) -> float:
        """The median bound of the pixels that show a Gaussian; 0 if none does."""
        covered = self.bound[self.culprit >= 0]
        return float(covered.median()) if len(covered) else 0.0


@torch.no_grad()
def exact_image(
    exact: Gaussians,  # in float64
    single: Gaussians,  # the same, computed in float32
    viewmat: Tensor,  # [4, 4] float32, taken as exact, as all further tensors
    K: Tensor,  # [3, 3]
    width: int,
    height: int,
    *,
    background: Tensor | None = None,  # [D]; None: black
    near: float = NEAR,
    far: float = FAR,
    eps2d: float = EPS2D,
    antialias: bool = False,
) -> ExactImage:
    """Render Gaussians in float64, and bound the error of `gsbench.raster.rasterize` on the same ones in float32.

    Raises:
        InputError: an argument is not what `rasterize` takes, the two sets of Gaussians differ in shape, or the CPU
            kernels are not installed.
    """
    library = library_of("cpu")
    viewport = Viewport(width, height, near, far, eps2d, antialias)
    background = viewmat.new_zeros(exact[3].shape[-1]) if background is None else background
    views = viewmat[None], K[None], background
    doubles, rounded = (
        _checked(gaussians, views, dtype, viewport)
        for gaussians, dtype in ((exact, torch.float64), (single, torch.float32))
    )
    N, D = doubles.colors.shape
    if len(rounded.means) != N:
        raise InputError(f"expected as many Gaussians in float32 as in float64, got {len(rounded.means)} and {N}")
    records, boxes = _exact_splats(library, doubles, project(rounded, viewport), viewmat, K, viewport)
    bins = bin_tiles(boxes, viewport)
    out = ExactImage(
        torch.empty(height, width, D, dtype=torch.float64),
        torch.empty(height, width, dtype=torch.float64),
        torch.empty(height, width, dtype=torch.int32),
        torch.empty(height, width, dtype=torch.uint8),
    )
    kept = {
        "records": records,
        "colors": doubles.colors.contiguous(),
        "single_colors": rounded.colors.contiguous(),
        "background": background.contiguous(),
        "offsets": bins.offsets,
        "ids": bins.ids,
    }
    kept |= {f"out.{name}": x for name, x in out._asdict().items()}
    numbers = {"D": D, "beta": rounded.beta_exponents is not None, "width": width, "height": height}
    library.call("exact_image", {name: x.data_ptr() for name, x in kept.items()} | numbers, viewmat)
    return out


def _checked(
    gaussians: Gaussians, views: tuple[Tensor, Tensor, Tensor], dtype: torch.dtype, viewport: Viewport
) -> RasterInputs:
    """Return Gaussians, viewmats, Ks and background as inputs of the rasterizer; raise InputError if they are wrong."""
    means, factors, opacities, colors, beta_exponents = gaussians
    if means.dtype != dtype or means.device.type != "cpu":
        raise InputError(f"expected Gaussians of {dtype} on the CPU, got {means.dtype} on {means.device}")
    viewmats, Ks, background = (x.to(dtype) for x in views)
    inputs = RasterInputs(means, factors, opacities, colors, viewmats, Ks, background, beta_exponents)
    check_arguments(inputs, viewport)
    check_values(inputs)
    return inputs


def _exact_splats(
    library: Library, exact: RasterInputs, rounded: Splats, viewmat: Tensor, K: Tensor, viewport: Viewport
) -> tuple[Tensor, Splats]:
    """Project in float64: return an `ExactRecord` of kernels.h for each Gaussian, and boxes [1, N, 2].

    The boxes contain those of float64 and of float32; their depths are exact ones, rounded to float32.
    """
    records = torch.empty(len(exact.means), RECORD, dtype=torch.float64)
    boxes = rounded._replace(**{name: torch.empty_like(getattr(rounded, name)) for name in BOXES})
    kept = {
        "means": exact.means,
        "factors": exact.factors,
        "opacities": exact.opacities,
        "shapes": exact.beta_exponents,
        "viewmats": viewmat,
        "Ks": K,
        "means2d": rounded.means2d,
        "roots": rounded.roots,
        "depths": rounded.depths,
        "half_sizes": rounded.half_sizes,
        "single_shapes": rounded.beta_exponents,
    }
    kept = {name: None if x is None else x.contiguous() for name, x in kept.items()}
    kept |= {"out.records": records} | {f"out.{name}": getattr(boxes, name) for name in BOXES}
    slots = {name: address(x) for name, x in kept.items()} | {"N": len(exact.means)} | viewport._asdict()
    library.call("exact_splats", slots, viewmat)
    return records, boxes
