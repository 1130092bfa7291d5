"""Render an image in float64, and bound for each pixel the error of the same image in float32.

The Gaussians are given twice: computed in float64, and computed in float32. The reference projects those of float64,
the kernels project those of float32, and what rounding does to each projected Gaussian is the difference. A kernel
blends the exact image and carries the differences, the rounding of blending itself, and the jumps of undecided branches
to the pixels (`gsbench/kernels/cpu/exact.cpp`).
"""

from typing import NamedTuple

import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.library import library_of
from gsbench.kernels.raster import Splats, Viewport, bin_tiles, project
from gsbench.raster import EPS2D, FAR, NEAR, reference
from gsbench.raster.checks import check_arguments, check_values

U = 2.0**-24  # the unit roundoff of float32
RANKS = 1 << 24  # integers that float32 counts exactly
BEYOND = 32.0  # pixels outside of the image where boxes end; and the margin that covers the rounding of boxes
MARGIN = 0.05

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
    exact: Gaussians,
    single: Gaussians,
    viewmat: Tensor,  # [4, 4]
    K: Tensor,  # [3, 3]
    width: int,
    height: int,
    *,
    background: Tensor | None = None,  # [D]
    near: float = NEAR,
    far: float = FAR,
    eps2d: float = EPS2D,
    antialias: bool = False,
) -> ExactImage:
    """Render Gaussians in float64, and bound the error of `rasterize` on the same Gaussians in float32.

    Args:
        exact: the Gaussians in float64, as in `gsbench.raster.rasterize`.
        single: the same Gaussians computed in float32.
        viewmat: world to camera, [4, 4] float32, as all further tensors; taken as exact.
        K: intrinsics, [3, 3].
        width: the width of the image, pixels.
        height: the height of the image, pixels.
        background: the background colour, [D]; None: black.
        near: Gaussians whose mean is nearer than this depth are culled.
        far: Gaussians whose mean is farther than this depth are culled.
        eps2d: the number that is added to the diagonal of the projected covariances, pixels^2.
        antialias: whether to scale opacities for the area that `eps2d` adds.

    Raises:
        InputError: an argument is not what `rasterize` takes, the two sets of Gaussians differ in shape, or the CPU
            kernels are not installed.
    """
    library = library_of("cpu")
    viewport = Viewport(width, height, near, far, eps2d, antialias)
    colors = exact[3]
    background = viewmat.new_zeros(colors.shape[-1]) if background is None else background
    for gaussians, dtype in ((exact, torch.float64), (single, torch.float32)):
        _check(gaussians, dtype, viewmat, K, background, viewport)
    N, D = colors.shape
    if len(single[0]) != N or N >= RANKS:
        raise InputError(f"expected as many Gaussians in float32 as in float64, fewer than {RANKS}, got "
                         f"{len(single[0])} and {N}")  # fmt: skip
    true = _exact_splats(exact, viewmat.double(), K.double(), viewport)
    means, factors, opacities, single_colors, shapes = single
    rounded = project(means, factors, opacities, viewmat[None], K[None], viewport, shapes)
    table = _single_table(rounded, true[:, 7], viewport)
    boxes = _boxes(true, rounded, viewport)
    bins, _ = bin_tiles(boxes, viewport, torch.zeros(1, dtype=torch.int64))
    errors = (single_colors.double() - colors).abs()
    out = ExactImage(
        torch.empty(height, width, D, dtype=torch.float64),
        torch.empty(height, width, dtype=torch.float64),
        torch.empty(height, width, dtype=torch.int32),
        torch.empty(height, width, dtype=torch.uint8),
    )
    kept = {"exact": true[:, :8].contiguous(), "single": table, "colors": colors.contiguous(), "color_errors": errors,
            "background": background.double(), "means2d": boxes.means2d, "half_sizes": boxes.half_sizes,
            "offsets": bins.offsets, "ids": bins.ids}  # fmt: skip
    kept |= {f"out.{name}": x for name, x in out._asdict().items()}
    numbers = {"N": N, "D": D, "beta": shapes is not None, "width": width, "height": height}
    library.call("exact_image", {name: x.data_ptr() for name, x in kept.items()} | numbers, viewmat)
    return out


def _check(
    gaussians: Gaussians, dtype: torch.dtype, viewmat: Tensor, K: Tensor, background: Tensor, viewport: Viewport
) -> None:
    means, factors, opacities, colors, shapes = gaussians
    if means.dtype != dtype or means.device.type != "cpu":
        raise InputError(f"expected Gaussians of {dtype} on the CPU, got {means.dtype} on {means.device}")
    views = viewmat[None].to(dtype), K[None].to(dtype)
    check_arguments(means, factors, opacities, colors, *views, viewport.width, viewport.height, background.to(dtype),
                    viewport.near, viewport.far, viewport.eps2d, shapes)  # fmt: skip
    check_values(means, factors, opacities, colors, *views, background.to(dtype), shapes)


def _exact_splats(exact: Gaussians, viewmat: Tensor, K: Tensor, viewport: Viewport) -> Tensor:
    """Project in float64: [N, 10] with x, y, p, q, r of math/projection.h, opacity, exponent, depth and half sizes."""
    means, factors, opacities, _, shapes = exact
    splats = reference.project(means, factors, opacities, viewmat, K, *viewport, shapes)
    # The kernels take the other triangular root: u = q dx + r dy, w = p dx, and power = (w^2 + u^2) ln 2.
    a, b, c = splats.conics.unbind(-1)
    r = torch.hypot(b, c)
    roots = torch.stack([a * c / r, a * b / r, r], -1) * (0.5 / torch.tensor(2.0).double().log()).sqrt()
    drawn = splats.half_sizes[:, :1] > 0
    opacities = torch.where(drawn, splats.opacities[:, None], 0.0)
    exponents = torch.ones_like(opacities) if shapes is None else shapes[:, None]
    return torch.cat([splats.means2d, roots, opacities, exponents, splats.depths[:, None], splats.half_sizes], -1)


def _single_table(rounded: Splats, depths: Tensor, viewport: Viewport) -> Tensor:
    """Collect what float32 makes of each projected Gaussian, [N, 11] float64; the columns are those of `ExactArgs`."""
    own, half = rounded.depths[0].double(), rounded.half_sizes[0].double()
    errors = (own - depths).abs() + 2 * U * own.abs()
    sure = (half[:, 0] > 0) & (own - errors > viewport.near) & (own + errors < viewport.far)
    exponents = torch.ones_like(own) if rounded.shapes is None else rounded.shapes.double()
    rest = torch.stack([exponents, half[:, 0], half[:, 1], sure.double(), errors], -1)
    return torch.cat([rounded.means2d[0].double(), rounded.roots[0].double(), rest], -1)


def _boxes(true: Tensor, rounded: Splats, viewport: Viewport) -> Splats:
    """Return boxes [1, N, 2] that contain those of float64 and of float32, with the exact order as depths [1, N]."""
    centers, depths, halves = true[:, :2], true[:, 7], true[:, 8:]
    own, own_half = rounded.means2d[0].double(), rounded.half_sizes[0].double()
    drawn, own_drawn = halves[:, :1] > 0, own_half[:, :1] > 0
    last = torch.tensor([viewport.width, viewport.height]).double() + BEYOND
    low = torch.minimum(torch.where(drawn, centers - halves, last), torch.where(own_drawn, own - own_half, last))
    high = torch.maximum(torch.where(drawn, centers + halves, -BEYOND), torch.where(own_drawn, own + own_half, -BEYOND))
    low, high = low.clamp(min=-BEYOND), torch.minimum(high, last)
    half = torch.where((low < high).all(-1, keepdim=True), (high - low) / 2 + MARGIN, 0.0)
    ranks = torch.empty_like(rounded.depths[0])
    ranks[torch.argsort(depths, stable=True)] = torch.arange(1, len(ranks) + 1).to(ranks)
    return Splats(((low + high) / 2).float()[None], rounded.roots, ranks[None], half.float()[None])
