"""Render exact images by brute force in float64: evaluate every Gaussian at every pixel, without tiles or bounds.

The code follows the definition of the image (3DGS: Kerbl et al. 2023; EWA: Zwicker et al. 2001) and shares nothing with
the rasterizers that it tests. Gradients come from autograd.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

PRODUCTS = 1 << 21  # (Gaussian, pixel) pairs in one chunk, to limit memory
Arguments = dict[str, Any]  # of `gsbench.raster.rasterize`
RIM = 1e-3  # a pixel with |1 - r^2| below this is at the rim of a Beta profile
# What may be of one camera each, and its dimensions where it is of all.
DIFFERENTIABLE = {"means": 2, "factors": 3, "opacities": 1, "colors": 2, "beta_exponents": 1}


@dataclass(frozen=True)
class Picture:
    """An exact image, and how close each pixel is to a threshold of alpha or transmittance. A pixel that is close to a
    threshold may change by a visible amount in float32, because a Gaussian may be skipped there."""

    image: Tensor  # [C, H, W, D]
    alpha: Tensor  # [C, H, W, 1]
    touched: Tensor  # [C, N, H, W] bool: whether the Gaussian's alpha is at least 1/255 at this pixel
    slack: Tensor  # [C, H, W] relative distance to the nearest threshold; if it is small, float32 may differ


class _Splats(NamedTuple):
    """Gaussians projected to the image plane of one camera, sorted front to back."""

    order: Tensor  # [M] their indices, without those outside near and far
    centers: Tensor  # [M, 2] pixels
    covs: Tensor  # [M, 2, 2] pixels^2
    opacities: Tensor  # [M]
    colors: Tensor  # [M, D]
    beta_exponents: Tensor | None  # [M] exponents of Beta profiles; None: Gaussians


def render(
    means: Tensor,
    factors: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    *,
    offsets2d: Tensor | None = None,
    background: Tensor | None = None,
    **options: Any,
) -> Picture:
    """Render exact images from the arguments of `gsbench.raster.rasterize` in float64. `offsets2d` [C, N, 2] is added
    to the projected means, in pixels."""
    C, N, D = len(viewmats), means.shape[-2], colors.shape[-1]
    gaussians = {"means": means, "factors": factors, "opacities": opacities, "colors": colors}
    if (exponents := options.pop("beta_exponents", None)) is not None:
        gaussians["beta_exponents"] = exponents
    background = torch.zeros(D).double() if background is None else background
    image, alpha = means.new_zeros(C, height * width, D), means.new_zeros(C, height * width, 1)
    touched, slack = torch.zeros(C, N, height * width, dtype=torch.bool), means.new_zeros(C, height * width)
    for c in range(C):
        moved = None if offsets2d is None else offsets2d[c]
        place = {"viewmat": viewmats[c], "K": Ks[c], "width": width, "height": height}
        splats = _project(**_of_camera(gaussians, c), **place, offsets=moved, **options)
        for at, pixels in _pixels(width, height, N):
            image[c, at], alpha[c, at], some, slack[c, at] = _blend(splats, pixels, background)
            touched[c, splats.order[:, None], at] = some
    shape = (C, height, width)
    return Picture(image.view(*shape, D), alpha.view(*shape, 1), touched.view(C, N, height, width), slack.view(shape))


def differentiate(arguments: Arguments, weight: Tensor, weight_alpha: Tensor) -> dict[str, Tensor]:
    """Compute exact gradients of the loss sum(weight [C, H, W, D] image + weight_alpha [C, H, W, 1] alpha)."""
    inputs = {name: arguments[name].detach().requires_grad_() for name in DIFFERENTIABLE if name in arguments}
    rest = {name: value for name, value in arguments.items() if name not in DIFFERENTIABLE}
    viewmats, Ks, width, height = (rest.pop(name) for name in ("viewmats", "Ks", "width", "height"))
    background = rest.pop("background", None)
    background = weight.new_zeros(weight.shape[-1]) if background is None else background
    for c in range(len(viewmats)):
        for at, pixels in _pixels(width, height, inputs["means"].shape[-2]):
            splats = _project(**_of_camera(inputs, c), viewmat=viewmats[c], K=Ks[c], width=width, height=height, **rest)
            image, alpha, _, _ = _blend(splats, pixels, background)
            loss = (image * weight[c].flatten(0, 1)[at]).sum() + (alpha * weight_alpha[c].flatten(0, 1)[at]).sum()
            if loss.requires_grad:
                loss.backward()
    return {name: torch.zeros_like(x) if x.grad is None else x.grad for name, x in inputs.items()}


def _of_camera(gaussians: Arguments, camera: int) -> Arguments:
    return {name: x if x.dim() == DIFFERENTIABLE[name] else x[camera] for name, x in gaussians.items()}


def _pixels(width: int, height: int, N: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield the indices [P] and the centres [P, 2] of all pixels in chunks, to limit memory."""
    for at in torch.arange(width * height).split(max(1, PRODUCTS // max(1, N))):
        yield at, torch.stack([at % width, at // width], -1) + 0.5


def _project(
    means: Tensor,
    factors: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    offsets: Tensor | None = None,
    near: float = 0.01,
    far: float = 1e10,
    eps2d: float = 0.3,
    antialias: bool = False,
    beta_exponents: Tensor | None = None,
) -> _Splats:
    R = viewmat[:3, :3]
    camera = means @ R.T + viewmat[:3, 3]
    order = torch.sort(camera[:, 2].detach(), stable=True).indices
    order = order[(camera[order, 2] > near) & (camera[order, 2] < far)]
    x, y, z = camera[order].T
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    centers = torch.stack([fx * x / z + cx, fy * y / z + cy], -1)
    # The Jacobian is taken at the mean, moved to at most 15 % of the image outside of it (3DGS).
    size = means.new_tensor([width, height])
    u, v = ((centers.clamp(-0.15 * size, 1.15 * size) - K[:2, 2]) / torch.stack([fx, fy])).T
    J = means.new_zeros(len(order), 2, 3)
    J[:, 0, 0], J[:, 0, 2], J[:, 1, 1], J[:, 1, 2] = fx / z, -fx * u / z, fy / z, -fy * v / z
    cov3 = R @ factors[order] @ factors[order].mT @ R.T
    covs = J @ cov3 @ J.mT
    blurred = covs + eps2d * torch.eye(2).double()
    opacities = opacities[order]
    if antialias:
        opacities = opacities * (torch.linalg.det(covs).clamp(min=0) / torch.linalg.det(blurred)).sqrt()
    centers = centers if offsets is None else centers + offsets[order]
    exponents = None if beta_exponents is None else beta_exponents[order]
    return _Splats(order, centers, blurred, opacities, colors[order], exponents)


def _blend(splats: _Splats, pixels: Tensor, background: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Blend all Gaussians front to back at P pixels. Return the image [P, D], the alpha [P, 1], which Gaussians
    contribute [M, P], and each pixel's relative distance [P] to the nearest threshold of alpha or transmittance."""
    dx, dy = (pixels[None] - splats.centers[:, None]).unbind(-1)
    xx, xy, yy = (splats.covs[:, i, j, None] for i, j in ((0, 0), (0, 1), (1, 1)))
    power = 0.5 * (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / (xx * yy - xy * xy)
    falloff = torch.exp(-power) if splats.beta_exponents is None else _beta(2 * power, splats.beta_exponents[:, None])
    a = (splats.opacities[:, None] * falloff).clamp(max=0.999)
    touched = a >= 1 / 255
    after = torch.where(touched, 1 - a, 1.0).cumprod(0)
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
    weight = torch.where(touched & (after >= 1e-4), a * before, 0.0)
    alpha = weight.sum(0)[:, None]
    image = weight.T @ splats.colors + (1 - alpha) * background
    going = before >= 1e-4  # the first Gaussian that would take the transmittance below this ends the pixel
    distance = torch.where(going, (255 * a - 1).abs(), torch.inf)
    if splats.beta_exponents is not None:  # a Beta profile may end, or change too fast for float32, at its rim
        visible = 255 * splats.opacities[:, None] * RIM ** splats.beta_exponents[:, None] > 1
        distance = torch.where(going & visible, torch.minimum(distance, (1 - 2 * power).abs()), distance)
    distance = torch.where(going & touched, torch.minimum(distance, (after / 1e-4 - 1).abs()), distance)
    slack = distance.amin(0) if len(distance) else torch.full((len(pixels),), torch.inf).double()
    return image, alpha, touched & going, slack.detach()


def _beta(r2: Tensor, exponents: Tensor) -> Tensor:
    """Return (1 - r^2)^b where r < 1, else 0. In the value and in the gradient, 1 - r^2 is held above 1e-6."""
    left = torch.where(r2 < 1, 1 - r2, 1.0)
    held = left + (1e-6 - left).clamp(min=0).detach()
    return torch.where(r2 < 1, held**exponents, 0.0)
