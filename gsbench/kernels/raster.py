"""Torch operations of the rasterizer: project (differentiable) -> bin -> blend (differentiable), on the CPU.

The last step's results before the picture are the operations' own: `roots` [C, N, 3] (p, q, r of the inverse 2D
covariance's triangular root, see math/projection.h), `half_sizes` [C, N, 2] (where alpha >= 1/255), `offsets`
[C * tiles + 1] and `ids` [pairs] (each tile's Gaussians front to back).
"""

from typing import Any

import torch
from torch import Tensor
from torch.library import custom_op

from gsbench.errors import InputError
from gsbench.kernels import native, threads
from gsbench.kernels.arrays import plain, rows_like
from gsbench.kernels.memory import require

TILE = 16  # as kernels.h has it
TILE_PIXELS = TILE * TILE
MAX_GAUSSIANS = 1 << 24  # positions in a tile's list are kept as float
MAX_PAIRS = (1 << 31) - 1


def count_tiles(width: int, height: int) -> int:
    """Tiles of one picture."""
    return -(-width // TILE) * -(-height // TILE)


@custom_op("gsbench::project", mutates_args=())
def project(
    means: Tensor, factors: Tensor, opacities: Tensor, viewmats: Tensor, Ks: Tensor,
    width: int, height: int, near: float, far: float, eps2d: float, antialias: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """Project Gaussians: means2d [C, N, 2], roots [C, N, 3], opacities [C, N], depths [C, N], half_sizes [C, N, 2]."""
    C, N = len(viewmats), len(means)
    shapes = ((C, N, 2), (C, N, 3), (C, N), (C, N), (C, N, 2))
    out = tuple(means.new_empty(shape) for shape in shapes)
    native().project(*plain(means, factors, opacities, viewmats, Ks),
                     width, height, near, far, eps2d, antialias, threads(), *out)  # fmt: skip
    return out[0], out[1], out[2], out[3], out[4]


@project.register_fake
def _(means: Tensor, _factors: Tensor, _opacities: Tensor, viewmats: Tensor, *_: Any) -> tuple[Tensor, ...]:
    C, N = len(viewmats), len(means)
    return tuple(means.new_empty(shape) for shape in ((C, N, 2), (C, N, 3), (C, N), (C, N), (C, N, 2)))


@custom_op("gsbench::project_backward", mutates_args=())
def project_backward(
    means: Tensor, factors: Tensor, opacities: Tensor, viewmats: Tensor, Ks: Tensor,
    width: int, height: int, near: float, far: float, eps2d: float, antialias: bool,
    g_means2d: Tensor, g_roots: Tensor, g_opacities: Tensor, g_depths: Tensor, cameras: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """Gradients of means, factors, opacities and, if `cameras`, viewmats (else empty)."""
    out = (rows_like(means), rows_like(factors), rows_like(opacities),
           viewmats.new_empty(len(viewmats) if cameras else 0, 4, 4))  # fmt: skip
    native().project_backward(
        *plain(means, factors, opacities, viewmats, Ks), width, height, near, far, eps2d, antialias, threads(),
        *plain(g_means2d, g_roots, g_opacities, g_depths), *out,
    )  # fmt: skip
    return out


@project_backward.register_fake
def _(means: Tensor, factors: Tensor, opacities: Tensor, viewmats: Tensor, *rest: Any) -> tuple[Tensor, ...]:
    cameras = viewmats.new_empty(len(viewmats) if rest[-1] else 0, 4, 4)
    return rows_like(means), rows_like(factors), rows_like(opacities), cameras


def _project_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    ctx.save_for_backward(*inputs[:5])
    ctx.rest = inputs[5:]
    ctx.set_materialize_grads(False)
    ctx.mark_non_differentiable(output[4])


def _project_gradient(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
    means, factors, opacities, viewmats, Ks = ctx.saved_tensors
    C, N = len(viewmats), len(means)
    given = [means.new_zeros(shape) if g is None else g
             for g, shape in zip(grads[:4], ((C, N, 2), (C, N, 3), (C, N), (C, N)), strict=True)]  # fmt: skip
    cameras = ctx.needs_input_grad[3]
    out = project_backward(means, factors, opacities, viewmats, Ks, *ctx.rest, *given, cameras)
    return *out[:3], out[3] if cameras else None, *(None,) * 7


project.register_autograd(_project_gradient, setup_context=_project_context)


@custom_op("gsbench::bin_tiles", mutates_args=())
def bin_tiles(means2d: Tensor, depths: Tensor, half_sizes: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
    """Each tile's Gaussians, front to back, ties by index: offsets [C * tiles + 1] int64, ids [pairs] int32."""
    splats = plain(means2d, depths, half_sizes)
    offsets = means2d.new_empty(len(means2d) * count_tiles(width, height) + 1, dtype=torch.int64)
    pairs = native().count_tiles(*splats, width, height, threads(), offsets)
    if pairs > MAX_PAIRS:
        raise InputError(f"{pairs} pairs of a tile and a Gaussian are more than {MAX_PAIRS}: "
                         "draw fewer cameras at once, a smaller picture, or fewer large Gaussians")  # fmt: skip
    require(4 * pairs, f"the lists of {pairs} pairs of a tile and a Gaussian")
    ids = means2d.new_empty(pairs, dtype=torch.int32)
    native().fill_tiles(*splats, width, height, threads(), offsets, ids)
    return offsets, ids


@bin_tiles.register_fake
def _(means2d: Tensor, _depths: Tensor, _half: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
    pairs = torch.library.get_ctx().new_dynamic_size()
    offsets = means2d.new_empty(len(means2d) * count_tiles(width, height) + 1, dtype=torch.int64)
    return offsets, means2d.new_empty(pairs, dtype=torch.int32)


@custom_op("gsbench::blend", mutates_args=())
def blend(
    means2d: Tensor, roots: Tensor, opacities: Tensor, half_sizes: Tensor, colors: Tensor, background: Tensor,
    offsets: Tensor, ids: Tensor, width: int, height: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """Blend each tile's Gaussians: image [C, H, W, D], alpha [C, H, W, 1], and the tiles' state for backward.

    `colors` are [1, N, D] for all cameras or [C, N, D].
    """
    out = _blend_outputs(means2d, colors, width, height)
    native().blend(*plain(means2d, roots, opacities, half_sizes, colors, background),
                   offsets, ids, width, height, threads(), *out)  # fmt: skip
    return out


@blend.register_fake
def _(means2d: Tensor, _roots: Tensor, _opacities: Tensor, _half: Tensor, colors: Tensor, *rest: Any) -> Any:
    return _blend_outputs(means2d, colors, rest[-2], rest[-1])


def _blend_outputs(means2d: Tensor, colors: Tensor, width: int, height: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    C, D = len(means2d), colors.shape[-1]
    state = C * count_tiles(width, height) * TILE_PIXELS
    return (means2d.new_empty(C, height, width, D), means2d.new_empty(C, height, width, 1),
            means2d.new_empty(state), means2d.new_empty(state))  # fmt: skip


@custom_op("gsbench::blend_backward", mutates_args=())
def blend_backward(
    means2d: Tensor, roots: Tensor, opacities: Tensor, half_sizes: Tensor, colors: Tensor, background: Tensor,
    offsets: Tensor, ids: Tensor, width: int, height: int,
    transmittance: Tensor, stop: Tensor, g_image: Tensor, g_alpha: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """Gradients of means2d, roots, opacities, colors and background."""
    inputs = means2d, roots, opacities, colors, background
    out = tuple(rows_like(x) for x in inputs)
    require(4 * len(ids) * (6 + colors.shape[-1]), f"the gradients of {len(ids)} pairs of a tile and a Gaussian")
    native().blend_backward(*plain(means2d, roots, opacities, half_sizes, colors, background), offsets, ids,
                            width, height, threads(), *plain(transmittance, stop, g_image, g_alpha), *out)  # fmt: skip
    return out[0], out[1], out[2], out[3], out[4]


@blend_backward.register_fake
def _(means2d: Tensor, roots: Tensor, opacities: Tensor, _half: Tensor, colors: Tensor, background: Tensor,
      *_: Any) -> tuple[Tensor, ...]:  # fmt: skip
    return tuple(rows_like(x) for x in (means2d, roots, opacities, colors, background))


def _blend_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    ctx.save_for_backward(*inputs[:8], output[2], output[3])
    ctx.size = inputs[8:]
    ctx.shapes = output[0].shape, output[1].shape
    ctx.set_materialize_grads(False)
    ctx.mark_non_differentiable(output[2], output[3])


def _blend_gradient(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
    *inputs, transmittance, stop = ctx.saved_tensors
    given = [inputs[0].new_zeros(shape) if g is None else g
             for g, shape in zip(grads[:2], ctx.shapes, strict=True)]  # fmt: skip
    g = blend_backward(*inputs, *ctx.size, transmittance, stop, *given)
    return g[0], g[1], g[2], None, g[3], g[4], None, None, None, None


blend.register_autograd(_blend_gradient, setup_context=_blend_context)
