"""The rasterizer's steps on the GPU, with gradients: `project` Gaussians to splats, `blend` splats to pictures.

They are `torch.autograd.Function`s and not `torch.library` operations, which take three times as long to call: at
400x400 the call is what a picture costs.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from gsbench.errors import InputError
from gsbench.kernels.arrays import plain
from gsbench.kernels.cuda import allocate, cuda, pointers, stream

TILE = 16  # as launch.h has it
MAX_ITEMS = (1 << 31) - 1  # splats, and pairs of a tile and a splat, are numbered by int32
GEOMETRY = 6  # of a splat: x, y, p, q, r, opacity
PAIRS = "lists of each tile's Gaussians"
# Backward with a splat a lane, or with a pixel a lane: the same gradients; docs/gpu.md says why it is the latter.
BACKWARD_BY_SPLAT = False


class View(NamedTuple):
    """How Gaussians are looked at: what `rasterize` is told beside the tensors."""

    width: int
    height: int
    near: float
    far: float
    eps2d: float
    antialias: bool


class Splats(NamedTuple):
    """Gaussians as C cameras see them, in rows."""

    means2d: Tensor  # [C, N, 2] pixels
    roots: Tensor  # [C, N, 4]: p, q, r of the inverse 2D covariance's triangular root (math/projection.h); the opacity
    depths: Tensor  # [C, N]
    half_sizes: Tensor  # [C, N, 2] pixels, beyond which alpha < 1/255; without a gradient


def project(means: Tensor, factors: Tensor, opacities: Tensor, viewmats: Tensor, Ks: Tensor, view: View) -> Splats:
    """Project Gaussians."""
    return Splats(*_Project.apply(means, factors, opacities, viewmats, Ks, view))


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[Tensor, ...]:
        *tensors, view = inputs
        means, factors, opacities, viewmats, Ks = plain(*tensors)
        C, N = len(viewmats), len(means)
        out = tuple(allocate("projected Gaussians", means, C, N, *row) for row in ((2,), (4,), (), (2,)))
        cuda().project(N, *pointers(means, factors, opacities), C, *pointers(viewmats, Ks), *view,
                       *pointers(*out), stream(means))  # fmt: skip
        ctx.save_for_backward(means, factors, opacities, viewmats, Ks)
        ctx.view = view
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(out[3])
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        means, factors, opacities, viewmats, Ks = ctx.saved_tensors
        C, N = len(viewmats), len(means)
        given = [None if g is None else g.contiguous() for g in grads[:3]]
        out = [allocate("gradients of Gaussians", x, *x.shape) for x in (means, factors, opacities)]
        g_viewmats = torch.zeros_like(viewmats) if ctx.needs_input_grad[3] else None
        cuda().project_backward(N, *pointers(means, factors, opacities), C, *pointers(viewmats, Ks), *ctx.view,
                                *pointers(*given, *out, g_viewmats), stream(means))  # fmt: skip
        return *out, g_viewmats, None, None


class Bins(NamedTuple):
    """Each tile's splats, front to back."""

    offsets: Tensor  # [C * tiles + 1] int32: tile t's list is ids[offsets[t] : offsets[t + 1]]
    ids: Tensor  # [pairs] int32, of the C * N splats


def bin_tiles(splats: Splats, view: View, flags: Tensor) -> tuple[Bins, int]:
    """Sort splats by depth and list each tile's; ties keep their order. Returns `flags` [1] int64 as an int, too.

    This waits for the device, once, for the number of pairs; `flags` comes along.

    Raises:
        InputError: more pairs than int32 counts.
    """
    order, ends = _count(splats, view, flags)
    *total, flagged = ends[-2:].tolist()
    pairs = total[0] if total else 0
    if pairs > MAX_ITEMS:
        raise InputError(f"{pairs} pairs of a tile and a Gaussian are more than {MAX_ITEMS}: "
                         "draw fewer cameras at once, a smaller picture, or fewer large Gaussians")  # fmt: skip
    return _fill(splats, view, order, ends, _room(splats, pairs)), flagged


def bin_within(splats: Splats, view: View, flags: Tensor, room: int) -> tuple[Bins, Tensor]:
    """`bin_tiles` that waits for nothing, where there is room for a number of pairs; others are left out.

    Returns how many there were, if there are Gaussians, and `flags`: [2] int64.
    """
    order, ends = _count(splats, view, flags)
    lists = _room(splats, room)
    lists[0].fill_(-1)  # no tile: what is not filled sorts behind all others
    return _fill(splats, view, order, ends, lists), ends[-2:]


def _count(splats: Splats, view: View, flags: Tensor) -> tuple[Tensor, Tensor]:
    """Splats by depth [C * N] int32; the running sum of the tiles they reach, then `flags`, [C * N + 1] int64."""
    (C, N), like = splats.depths.shape, splats.depths
    keys, indices, sorted_keys, order = allocate("depths to sort", like, 4, C * N, dtype=torch.int32).unbind()
    ends = allocate("numbers of tiles", like, C * N + 1, dtype=torch.int64)
    scratch = _scratch(C * N, like)
    cuda().count_tiles(N, C, *pointers(*splats), view.width, view.height,
                       *pointers(keys, indices, sorted_keys, order, ends, scratch), len(scratch),
                       stream(like))  # fmt: skip
    ends[-1:].copy_(flags)
    return order, ends


def _room(splats: Splats, pairs: int) -> tuple[Tensor, ...]:
    """For tiles, splats, sorted tiles, sorted splats: [pairs] int32. The last, of its own, lives until backward."""
    rows = allocate(PAIRS, splats.depths, 3, pairs, dtype=torch.int32)
    return *rows.unbind(), allocate(PAIRS, splats.depths, pairs, dtype=torch.int32)


def _fill(splats: Splats, view: View, order: Tensor, ends: Tensor, lists: tuple[Tensor, ...]) -> Bins:
    """List and sort the pairs that `lists` have room for."""
    (C, N), like, ids = splats.depths.shape, splats.depths, lists[-1]
    tiles = C * -(-view.width // TILE) * -(-view.height // TILE)
    offsets = allocate("lists of tiles", like, tiles + 1, dtype=torch.int32)
    scratch = _scratch(len(ids), like)
    cuda().fill_tiles(N, C, *pointers(*splats), view.width, view.height, *pointers(order, ends), len(ids),
                      *pointers(*lists, offsets, scratch), len(scratch), stream(like))  # fmt: skip
    return Bins(offsets, ids)


def _scratch(items: int, like: Tensor) -> Tensor:
    """What sorting and summing so many items need."""
    return allocate("scratch space to sort", like, cuda().scratch_bytes(items), dtype=torch.uint8)


def blend(splats: Splats, colors: Tensor, background: Tensor, bins: Bins, view: View) -> tuple[Tensor, Tensor]:
    """Blend each tile's splats: image [C, H, W, D], alpha [C, H, W, 1]; colours are [1, N, D] for all or [C, N, D]."""
    out: tuple[Tensor, Tensor] = _Blend.apply(splats.means2d, splats.roots, colors, background, bins, view)
    return out


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[Tensor, Tensor]:
        *tensors, bins, view = inputs
        means2d, roots, colors, background = plain(*tensors)
        (C, N, _), D = means2d.shape, colors.shape[-1]
        shape = C, view.height, view.width
        image, alpha = (allocate("pictures", means2d, *shape, channels) for channels in (D, 1))
        transmittance, stop = (allocate("pictures", means2d, *shape, dtype=t) for t in (torch.float32, torch.int32))
        ctx.sizes = N, C, D, C > 1 and len(colors) == C
        ctx.view = view
        cuda().blend(*ctx.sizes, *pointers(means2d, roots, colors, background, *bins), view.width, view.height,
                     *pointers(image, alpha, transmittance, stop), stream(means2d))  # fmt: skip
        ctx.save_for_backward(means2d, roots, colors, background, *bins, transmittance, stop)
        ctx.set_materialize_grads(False)
        return image, alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        means2d, roots, colors, background, *bins, transmittance, stop = ctx.saved_tensors
        N, C, D, _ = ctx.sizes
        g_image, g_alpha = (None if g is None else g.contiguous() for g in grads)
        sums = allocate("sums over pixels", means2d, C * N, GEOMETRY + D).zero_()
        out = [allocate("gradients of projected Gaussians", x, *x.shape) for x in (means2d, roots, colors)]
        cuda().blend_backward(*ctx.sizes, *pointers(means2d, roots, colors, background, *bins), ctx.view.width,
                              ctx.view.height, *pointers(transmittance, stop, g_image, g_alpha, sums, *out),
                              BACKWARD_BY_SPLAT, stream(means2d))  # fmt: skip
        g_background = None
        if ctx.needs_input_grad[3] and g_image is not None:
            g_background = (g_image * transmittance[..., None]).sum((0, 1, 2))
        return *out, g_background, None, None
