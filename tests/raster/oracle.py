"""The picture by brute force: numpy float64, every Gaussian at every pixel, no tiles, no bounds, no code shared.

Written from the rules of the picture (3DGS: Kerbl et al. 2023; EWA: Zwicker et al. 2001) and not from the rasterizer.
"""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Picture:
    """What the oracle saw."""

    image: np.ndarray  # [C, H, W, D]
    alpha: np.ndarray  # [C, H, W, 1]
    touched: np.ndarray  # [C, N, H, W] bool: the Gaussian's alpha is at least 1/255 here
    slack: np.ndarray  # [C, H, W] relative distance of the closest decision to its threshold: small ones may flip


def paint(
    means, factors, opacities, colors, viewmats, Ks, width, height, *,
    background=None, near=0.01, far=1e10, eps2d=0.3, antialias=False, offsets2d=None,
) -> Picture:  # fmt: skip
    """Draw what `gsbench.raster.rasterize` is asked to, from arrays; `offsets2d` [C, N, 2] moves projected means."""
    C, N, D = len(viewmats), len(means), colors.shape[-1]
    colors = np.broadcast_to(colors, (C, N, D))
    background = np.zeros(D) if background is None else background
    image, alpha = np.zeros((C, height, width, D)), np.zeros((C, height, width, 1))
    touched, slack = np.zeros((C, N, height, width), bool), np.full((C, height, width), np.inf)
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    for c in range(C):
        R, t = viewmats[c][:3, :3], viewmats[c][:3, 3]
        depths = np.array([R[2] @ mean + t[2] for mean in means])
        light = np.ones((height, width))  # transmittance
        ended = np.zeros((height, width), bool)
        for i in sorted(range(N), key=lambda i: (depths[i], i)):
            if not near < depths[i] < far:
                continue
            center, cov = splat(R @ means[i] + t, R @ factors[i], Ks[c], width, height)
            blurred = cov + eps2d * np.eye(2)
            opacity = opacities[i]
            if antialias:
                opacity = opacity * np.sqrt(max(np.linalg.det(cov), 0) / np.linalg.det(blurred))
            if offsets2d is not None:
                center = center + offsets2d[c, i]
            dx, dy = columns - center[0], rows - center[1]
            conic = np.linalg.inv(blurred)
            power = 0.5 * (conic[0, 0] * dx * dx + 2 * conic[0, 1] * dx * dy + conic[1, 1] * dy * dy)
            a = np.minimum(0.999, opacity * np.exp(-power))
            touched[c, i] = a >= 1 / 255
            after = light * (1 - a)
            ends = touched[c, i] & (after < 1e-4)
            blended = touched[c, i] & ~ended & ~ends
            weight = np.where(blended, a * light, 0)
            image[c] += weight[..., None] * colors[c, i]
            alpha[c] += weight[..., None]
            slack[c] = np.where(ended, slack[c], np.minimum(slack[c], np.abs(255 * a - 1)))
            slack[c] = np.where(ended | ~touched[c, i], slack[c], np.minimum(slack[c], np.abs(after / 1e-4 - 1)))
            ended |= ends
            light = np.where(blended, after, light)
        image[c] += light[..., None] * background
    return Picture(image, alpha, touched, slack)


def splat(mean, factor, K, width, height) -> tuple[np.ndarray, np.ndarray]:
    """Centre [2] and covariance [2, 2] on the picture of one Gaussian in camera space, nothing added to it.

    The Jacobian of the projection is taken at the mean, moved to at most 15 % of the picture outside of it.
    """
    x, y, z = mean
    center = np.array([K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]])
    nearest = np.clip(center, [-0.15 * width, -0.15 * height], [1.15 * width, 1.15 * height])
    u, v = (nearest[0] - K[0, 2]) / K[0, 0], (nearest[1] - K[1, 2]) / K[1, 1]
    J = np.array([[K[0, 0] / z, 0, -K[0, 0] * u / z], [0, K[1, 1] / z, -K[1, 1] * v / z]])
    return center, J @ factor @ factor.T @ J.T
