"""Rasterize Gaussians in torch, for any dtype and device, with gradients for all inputs.

The kernels for CPU and CUDA are tested against this code. Its three steps are those of 3DGS (Kerbl et al. 2023):
project the Gaussians (EWA splatting, Zwicker et al. 2001), sort them into tiles, and blend.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from gsbench.kernels.headers import ALPHA_MAX, ALPHA_MIN, RIM_MIN, TRANSMITTANCE_MIN
from gsbench.kernels.raster import LOWER, RasterInputs, Viewport
from gsbench.process.memory import require
from gsbench.raster.interface import RasterInfo, RasterOutput, check_values

TILE = 8  # pixels; in small tiles fewer pixels are evaluated for Gaussians that do not reach them
NUMBERS = 300  # numbers in memory for each Gaussian and camera, measured without gradients
CHUNK = 1 << 21  # (Gaussian, pixel) pairs that are blended at once, which limits memory and fits caches


class CameraSplats(NamedTuple):
    """Hold the Gaussians of a scene after projection to the image plane of one camera."""

    means2d: Tensor  # [N, 2] pixels
    conics: Tensor  # [N, 3] a, b, c: the inverse of the 2D covariance is U^T U with U = [a b; 0 c]
    opacities: Tensor  # [N]
    depths: Tensor  # [N]
    half_sizes: Tensor  # [N, 2] pixels: alpha < ALPHA_MIN outside of means2d +- half_sizes; 0: culled
    beta_exponents: Tensor | None = None  # [N] exponents of Beta profiles; None: Gaussians


def draw(inputs: RasterInputs, viewport: Viewport) -> RasterOutput:
    """Render images for all cameras, one after the other; see `gsbench.raster.rasterize`.

    Raises:
        InputError: a value is out of range, or the CPU memory does not suffice.
    """
    means, factors, opacities, colors, viewmats, Ks, background, beta_exponents = inputs
    C = len(viewmats)
    if means.device.type == "cpu":
        N = means.shape[-2]
        require(means.element_size() * C * N * NUMBERS, f"images of {C} cameras with {N} Gaussians", LOWER)
    check_values(inputs)
    if colors.dim() == 2:
        colors = colors.expand(C, *colors.shape)
    shared = means, factors, opacities, beta_exponents
    # for each camera these four, without the dimension of cameras
    sets = [shared] * C if means.dim() == 2 else zip(*([None] * C if x is None else x for x in shared), strict=True)
    splats = [
        project(mean, factor, opacity, viewmat, K, viewport, exponent)
        for (mean, factor, opacity, exponent), viewmat, K in zip(sets, viewmats, Ks, strict=True)
    ]
    means2d = torch.stack([s.means2d for s in splats])  # all images are computed from it, so it gets a gradient
    images, alphas, pairs = [], [], 0
    for splat, mean2d, color in zip(splats, means2d, colors, strict=True):
        tiles, gaussians = bin_tiles(splat, viewport.width, viewport.height)
        image, alpha = blend(splat._replace(means2d=mean2d), color, tiles, gaussians, viewport.width, viewport.height)
        images.append(image + (1 - alpha) * background)
        alphas.append(alpha)
        pairs += len(tiles)
    info = RasterInfo(
        half_sizes=torch.stack([s.half_sizes for s in splats]),
        means2d=means2d,
        depths=torch.stack([s.depths for s in splats]),
        pairs=pairs,
    )
    return RasterOutput(torch.stack(images), torch.stack(alphas), info)


def project(
    means: Tensor,  # [N, 3]
    factors: Tensor,  # [N, 3, 3]
    opacities: Tensor,  # [N]
    viewmat: Tensor,  # [4, 4]
    K: Tensor,  # [3, 3]
    viewport: Viewport,
    beta_exponents: Tensor | None = None,  # [N]
) -> CameraSplats:
    """Project Gaussians to an image by the affine approximation at each mean (EWA splatting, eq. 29)."""
    width, height, near, far, eps2d, antialias = viewport
    rotation, translation = viewmat[:3, :3], viewmat[:3, 3]
    means_c = means @ rotation.T + translation
    drawn = (means_c[:, 2] > near) & (means_c[:, 2] < far)
    # Culled Gaussians go through all lines below too, so they get a harmless depth and a zero gradient.
    x, y, z = torch.where(drawn[:, None], means_c, means_c.new_tensor([0.0, 0.0, 1.0])).unbind(-1)
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    means2d = torch.stack([fx * x / z + cx, fy * y / z + cy], -1)

    # The Jacobian is evaluated at most 15 % of the image size outside of the image (3DGS, forward.cu), because the
    # affine approximation diverges far outside.
    margin_x, margin_y = 0.15 * width / fx, 0.15 * height / fy
    u = (x / z).clamp(-cx / fx - margin_x, (width - cx) / fx + margin_x)
    v = (y / z).clamp(-cy / fy - margin_y, (height - cy) / fy + margin_y)
    zero = torch.zeros_like(z)
    J = torch.stack([fx / z, zero, -fx * u / z, zero, fy / z, -fy * v / z], -1).unflatten(-1, (2, 3))
    M = J @ rotation @ factors  # [N, 2, 3]: the 2D covariance is M M^T; no 3D covariance is computed
    # The unit is the size of the splat: in pixels, det of a splat of 10^9 pixels would overflow in float32.
    size = (M.detach().square().sum((-2, -1)) + eps2d).sqrt()
    size = torch.where(size > 0, size, 1.0)
    m1, m2 = (M / size[:, None, None]).unbind(-2)
    eps = eps2d / size.square()

    xx, xy, yy = (m1 * m1).sum(-1), (m1 * m2).sum(-1), (m2 * m2).sum(-1)
    # det(M M^T + e I) by Lagrange's identity, |m1|^2 |m2|^2 - (m1 m2)^2 = |m1 x m2|^2, which avoids cancellation for
    # long thin splats.
    area2 = torch.linalg.cross(m1, m2).square().sum(-1)
    det = area2 + eps * (xx + yy) + eps**2
    drawn = drawn & (det > 0)
    det = torch.where(drawn, det, 1.0)
    # With the factor U of the conic, power = |U d|^2 / 2 is a sum of squares. The quadratic form of 3DGS suffers from
    # cancellation: along a splat 400 pixels long, images in float32 had errors of 2e-3.
    yy = torch.where(drawn, yy + eps, 1.0)
    conics = torch.stack([yy, -xy, det.sqrt()], -1) / (yy * det).sqrt()[:, None] / size[:, None]
    if antialias:
        ratio = torch.where(area2 > 0, area2, 1.0) / det
        opacities = torch.where(area2 > 0, opacities * ratio.sqrt(), 0.0)

    # alpha >= 1/255 only where r^2 <= 2 ln(255 opacity); of a Beta profile where r^2 <= 1 - (255 opacity)^(-1/b). The
    # bounding box of this ellipse has the half sizes r sqrt(cov_xx), r sqrt(cov_yy). A hundredth of a pixel is added
    # for rounding.
    most = (255 * opacities.detach()).clamp(min=1).log()
    reach = 2 * most if beta_exponents is None else -torch.expm1(-most / beta_exponents.detach())
    half_sizes = (reach[:, None] * torch.stack([xx + eps, yy], -1).detach()).sqrt() * size[:, None] + 0.01
    inside = ((means2d + half_sizes > 0) & (means2d - half_sizes < means2d.new_tensor([width, height]))).all(-1)
    drawn = drawn & (opacities >= ALPHA_MIN) & inside
    half_sizes = torch.where(drawn[:, None], half_sizes, 0.0)
    return CameraSplats(means2d, conics, opacities, means_c[:, 2], half_sizes, beta_exponents)


@torch.no_grad()
def bin_tiles(splats: CameraSplats, width: int, height: int) -> tuple[Tensor, Tensor]:
    """List the P tile intersections of an image, sorted by tile, then by depth, then by the index of the Gaussian.

    Returns:
        The tile [P] and the Gaussian [P] of each intersection.
    """
    order = torch.argsort(splats.depths, stable=True)
    order = order[splats.half_sizes[order].amax(-1) > 0]  # the Gaussians that are drawn, by depth
    center, half = splats.means2d[order], splats.half_sizes[order]
    size = center.new_tensor([width, height])
    # The bounds are clamped as floats, because those of a huge Gaussian would overflow integers.
    low = (torch.minimum((center - half).clamp(min=0), size) / TILE).floor().long()
    high = (torch.minimum((center + half).clamp(min=0), size) / TILE).ceil().long()
    columns, rows = (high - low).clamp(min=1).unbind(-1)
    count = columns * rows
    owner = torch.repeat_interleave(torch.arange(len(order), device=order.device), count)  # [P] indices into `order`
    nth = torch.arange(len(owner), device=order.device) - (count.cumsum(0) - count)[owner]  # 0, 1, .. of each Gaussian
    across = -(-width // TILE)
    down = -(-height // TILE)
    tile_x = (low[owner, 0] + nth % columns[owner]).clamp(max=across - 1)
    tile_y = (low[owner, 1] + nth // columns[owner]).clamp(max=down - 1)
    tiles, by_tile = torch.sort(tile_y * across + tile_x, stable=True)  # stable sort keeps the depth order in a tile
    return tiles, order[owner[by_tile]]


def blend(
    splats: CameraSplats,
    colors: Tensor,  # [N, D]
    tiles: Tensor,  # [P]
    gaussians: Tensor,  # [P]
    width: int,
    height: int,
) -> tuple[Tensor, Tensor]:
    """Blend the Gaussians of each tile front to back (3DGS, eq. 3).

    Tiles with similar numbers of Gaussians are processed together, padded to the same number by Gaussians of zero
    opacity.

    Returns:
        The image without the background, [H, W, D], and its alpha, [H, W, 1].
    """
    across, down = -(-width // TILE), -(-height // TILE)
    D = colors.shape[-1]
    # A table with a row for each Gaussian and a row of zeros for padding, so that one gather reads all parameters.
    table = torch.cat([splats.means2d, splats.conics, splats.opacities[:, None], colors], -1)
    if splats.beta_exponents is not None:
        table = torch.cat([table, splats.beta_exponents[:, None]], -1)
    table = torch.cat([table, table.new_zeros(1, table.shape[1])])

    lengths = torch.bincount(tiles, minlength=across * down)  # [across * down] Gaussians of each tile
    starts = lengths.cumsum(0) - lengths  # where the list of each tile begins in `gaussians`
    by_length = torch.argsort(lengths, descending=True, stable=True)
    longest = lengths[by_length].tolist()
    pieces, first = [], 0
    while first < len(longest) and longest[first]:
        last = min(len(longest), first + max(1, CHUNK // (longest[first] * TILE * TILE)))
        chosen = by_length[first:last]
        nth = torch.arange(longest[first], device=tiles.device)
        padding = nth >= lengths[chosen, None]  # [chosen tiles, longest list]
        index = gaussians[(starts[chosen, None] + nth).clamp(max=len(gaussians) - 1)]
        index = index.masked_fill(padding, len(table) - 1)
        # index_select, not table[index]: the backward pass of the latter adds rows in random order.
        rows = table.index_select(0, index.flatten()).unflatten(0, index.shape)
        pieces.append(_blend_tiles(rows, D, chosen % across * TILE, chosen // across * TILE))
        first = last
    empty = table[-1, 0].expand(across * down - first, TILE * TILE, D + 1)  # zeros, but in the graph
    canvas = torch.cat([*pieces, empty])[torch.argsort(by_length)]  # back into the tiles' own order
    canvas = canvas.reshape(down, across, TILE, TILE, D + 1).transpose(1, 2).reshape(down * TILE, across * TILE, D + 1)
    canvas = canvas[:height, :width]
    return canvas[..., :D], canvas[..., D:]


def _blend_tiles(
    # [T, K, 6 + D]: mean2d, conic, opacity, colour of the K Gaussians of each of T tiles, in depth order; with the
    # exponents of Beta profiles, [T, K, 7 + D]
    rows: Tensor,
    D: int,
    left: Tensor,  # [T] pixels
    top: Tensor,  # [T] pixels
) -> Tensor:  # [T, TILE * TILE, D + 1]: colour and alpha
    """Blend K Gaussians in all pixels of T tiles, by the rules of `gsbench.raster.rasterize`."""
    offsets = torch.arange(TILE, device=rows.device) + 0.5  # pixel centres
    dx = (left[:, None, None] + offsets) - rows[..., 0:1]  # [T, K, TILE]
    dy = (top[:, None, None] + offsets) - rows[..., 1:2]
    a, b, c, opacity = rows[..., 2:6, None].unbind(-2)
    # |U d|^2 of each pixel (y, x), [T, K, TILE, TILE]
    r2 = ((b * dy)[..., :, None] + (a * dx)[..., None, :]).square() + (c * dy).square()[..., :, None]
    exponent = rows[..., 6 + D :, None]  # [T, K, 0 or 1, 1]
    profile = _beta(r2, exponent) if exponent.shape[-2] else torch.exp(-0.5 * r2)
    alpha = (opacity[..., None] * profile).clamp(max=ALPHA_MAX).flatten(-2)
    alpha = torch.where(alpha >= ALPHA_MIN, alpha, 0.0)
    after = torch.cumprod(1 - alpha, 1)  # transmittance behind each Gaussian
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], 1)
    weight = torch.where(after >= TRANSMITTANCE_MIN, alpha * before, 0.0)  # [T, K, TILE * TILE]
    color = torch.cat([rows[..., 6 : 6 + D], torch.ones_like(rows[..., :1])], -1)
    return weight.transpose(1, 2) @ color


def _beta(r2: Tensor, exponent: Tensor) -> Tensor:
    """Return the Beta profile (1 - r^2)^b inside of r = 1, and zero outside, where it has no gradient.

    In the value and in the gradient, 1 - r^2 is held above RIM_MIN.
    """
    inside = r2 < 1
    r2 = torch.where(inside, r2, 0.0)
    rest = 1 - r2
    held = rest + (RIM_MIN - rest).clamp(min=0).detach()  # detached: the gradient is that of the held value
    log_rest = torch.where(r2 < 0.5, torch.log1p(-r2), held.log())  # log1p keeps digits that large exponents need
    return torch.where(inside, torch.exp(exponent * log_rest), 0.0)
