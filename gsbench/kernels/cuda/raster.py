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


def project(
    means: Tensor, factors: Tensor, opacities: Tensor, viewmats: Tensor, Ks: Tensor, view: View
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Project Gaussians: means2d [C, N, 2], roots [C, N, 4], depths [C, N], half_sizes [C, N, 2].

    `roots` are p, q, r of the inverse 2D covariance's triangular root (math/projection.h), and the opacity;
    `half_sizes`, beyond which alpha < 1/255, have no gradient.
    """
    out: tuple[Tensor, Tensor, Tensor, Tensor] = _Project.apply(means, factors, opacities, viewmats, Ks, view)
    return out


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


def bin_tiles(
    means2d: Tensor, roots: Tensor, depths: Tensor, half_sizes: Tensor, width: int, height: int, flags: Tensor
) -> tuple[Bins, int]:
    """Sort splats by depth and list each tile's; ties keep their order. Returns `flags` [1] int64 as an int, too.

    This waits for the device, once, for the number of pairs; `flags` comes along.

    Raises:
        InputError: more pairs than int32 counts.
    """
    C, N = depths.shape
    splats = plain(means2d, roots, depths, half_sizes)
    arguments = (N, C, *pointers(*splats), width, height)
    keys, indices, sorted_keys, order = allocate("depths to sort", depths, 4, C * N, dtype=torch.int32).unbind()
    ends = allocate("numbers of tiles", depths, C * N + 1, dtype=torch.int64)
    scratch = _scratch(C * N, depths)
    cuda().count_tiles(*arguments, *pointers(keys, indices, sorted_keys, order, ends, scratch), len(scratch),
                       stream(depths))  # fmt: skip
    ends[-1:].copy_(flags)
    *total, flagged = ends[-2:].tolist()
    pairs = total[0] if total else 0
    if pairs > MAX_ITEMS:
        raise InputError(f"{pairs} pairs of a tile and a Gaussian are more than {MAX_ITEMS}: "
                         "draw fewer cameras at once, a smaller picture, or fewer large Gaussians")  # fmt: skip
    # Three are let go when this returns; the fourth, of its own, lives until backward.
    tiles, unsorted, sorted_tiles = allocate(PAIRS, depths, 3, pairs, dtype=torch.int32).unbind()
    ids = allocate(PAIRS, depths, pairs, dtype=torch.int32)
    offsets = allocate("lists of tiles", depths, C * -(-width // TILE) * -(-height // TILE) + 1, dtype=torch.int32)
    scratch = _scratch(pairs, depths)
    cuda().fill_tiles(*arguments, *pointers(order, ends), pairs,
                      *pointers(tiles, unsorted, sorted_tiles, ids, offsets, scratch), len(scratch),
                      stream(depths))  # fmt: skip
    return Bins(offsets, ids), flagged


def _scratch(items: int, like: Tensor) -> Tensor:
    """What sorting and summing so many items need."""
    return allocate("scratch space to sort", like, cuda().scratch_bytes(items), dtype=torch.uint8)


def blend(
    means2d: Tensor, roots: Tensor, colors: Tensor, background: Tensor, bins: Bins, view: View
) -> tuple[Tensor, Tensor]:
    """Blend each tile's splats: image [C, H, W, D], alpha [C, H, W, 1]; colours are [1, N, D] for all or [C, N, D]."""
    out: tuple[Tensor, Tensor] = _Blend.apply(means2d, roots, colors, background, bins, view)
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
