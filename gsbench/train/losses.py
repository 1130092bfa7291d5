"""Compute the training loss (1 - w) L1 + w (1 - SSIM) of an image (3DGS eq. 7)."""

import functools

import torch
import torch.nn.functional as F
from torch import Tensor

from gsbench.kernels.backends import AUTO, Backend
from gsbench.kernels.loss import l1_ssim

WINDOW = 11
SIGMA = 1.5


def photometric(image: Tensor, target: Tensor, ssim_weight: float, backend: Backend = AUTO) -> Tensor:
    """Compute the training loss [] of an image and its target, both [H, W, 3] or [1, H, W, 3] in [0, 1]."""
    if backend.serves(image):
        return l1_ssim(image, target, ssim_weight)
    loss = F.l1_loss(image, target)
    if ssim_weight == 0:
        return loss
    return (1 - ssim_weight) * loss + ssim_weight * (1 - structural_similarity(image, target))


def structural_similarity(a: Tensor, b: Tensor) -> Tensor:
    """Compute the mean SSIM in a zero-padded 11 x 11 Gaussian window, as 3DGS does for its loss.

    Results are measured by `gsbench.measure.quality.ssim` instead (Wang et al. 2004).
    """
    a, b = (x.reshape(x.shape[-3:]).permute(2, 0, 1) for x in (a, b))
    moments = _blur(torch.cat([a, b, a * a, b * b, a * b]))
    mean_a, mean_b, aa, bb, ab = moments.split(len(a))
    variances, covariance = aa - mean_a**2 + bb - mean_b**2, ab - mean_a * mean_b
    C1, C2 = 0.01**2, 0.03**2
    similarity = (2 * mean_a * mean_b + C1) * (2 * covariance + C2)
    return (similarity / ((mean_a**2 + mean_b**2 + C1) * (variances + C2))).mean()


def _blur(planes: Tensor) -> Tensor:  # [P, H, W]
    """Blur by the zero-padded Gaussian window. It is separable: a product with a banded matrix from either side.

    For small images on the CPU this, and its gradient, is many times faster than torch's convolutions.
    """
    height, width = planes.shape[-2:]
    return _band(height, planes.device, planes.dtype) @ planes @ _band(width, planes.device, planes.dtype)


@functools.cache
def _band(size: int, device: torch.device, dtype: torch.dtype) -> Tensor:  # [size, size], symmetric
    offset = torch.arange(size, device=device)[:, None] - torch.arange(size, device=device)
    window = torch.exp(-((torch.arange(WINDOW, device=device, dtype=dtype) - WINDOW // 2) ** 2) / (2 * SIGMA**2))
    weight = torch.exp(-(offset.to(dtype) ** 2) / (2 * SIGMA**2)) / window.sum()
    return torch.where(offset.abs() <= WINDOW // 2, weight, 0.0)
