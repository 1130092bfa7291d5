"""Compute the photometric training loss of 3DGS, (1 - w) L1 + w (1 - SSIM) (3DGS, eq. 7)."""

import functools

import torch
import torch.nn.functional as F
from torch import Tensor

from gsbench.kernels.backends import AUTO, Backend
from gsbench.kernels.loss import l1_ssim
from gsbench.scenes.scene import to_floats

WINDOW = 11
SIGMA = 1.5


def photometric(image: Tensor, target: Tensor, ssim_weight: float, backend: Backend = AUTO) -> Tensor:
    """Compute the loss (1 - ssim_weight) L1 + ssim_weight (1 - SSIM) of an image and its target, [H, W, 3] each.

    The target has floats in [0, 1], or 8 bits. Of images [C, H, W, 3] the losses are [C].
    """
    if backend.serves(image):
        return l1_ssim(image, target, ssim_weight)
    if image.dim() == 4:
        return torch.stack([photometric(*pair, ssim_weight, backend) for pair in zip(image, target, strict=True)])
    target = to_floats(target)
    loss = F.l1_loss(image, target)
    if ssim_weight == 0:
        return loss
    return (1 - ssim_weight) * loss + ssim_weight * (1 - structural_similarity(image, target))


def structural_similarity(a: Tensor, b: Tensor) -> Tensor:
    """Compute the mean SSIM with a zero-padded 11 x 11 Gaussian window, as the loss of 3DGS does.

    The SSIM in tables of results is `gsbench.measure.quality.ssim` (Wang et al. 2004), not this one.
    """
    a, b = (x.permute(2, 0, 1) for x in (a, b))
    moments = _blur(torch.cat([a, b, a * a, b * b, a * b]))
    mean_a, mean_b, aa, bb, ab = moments.split(len(a))
    variances, covariance = aa - mean_a**2 + bb - mean_b**2, ab - mean_a * mean_b
    C1, C2 = 0.01**2, 0.03**2  # (Wang et al. 2004, section III-B) for colours in [0, 1]
    similarity = (2 * mean_a * mean_b + C1) * (2 * covariance + C2)
    return (similarity / ((mean_a**2 + mean_b**2 + C1) * (variances + C2))).mean()


def _blur(planes: Tensor) -> Tensor:  # [P, H, W]
    """Convolve images [P, H, W] with the zero-padded Gaussian window, by a banded matrix on the left and on the right.

    For small images on a CPU this is many times faster than torch's convolutions, in the forward and in the backward
    pass.
    """
    height, width = planes.shape[-2:]
    return _band(height, planes.device, planes.dtype) @ planes @ _band(width, planes.device, planes.dtype)


@functools.cache
def _band(size: int, device: torch.device, dtype: torch.dtype) -> Tensor:  # [size, size], symmetric
    """Return the matrix whose product with a column of pixels is its convolution with the Gaussian window."""
    offset = torch.arange(size, device=device)[:, None] - torch.arange(size, device=device)
    window = torch.exp(-((torch.arange(WINDOW, device=device, dtype=dtype) - WINDOW // 2) ** 2) / (2 * SIGMA**2))
    weight = torch.exp(-(offset.to(dtype) ** 2) / (2 * SIGMA**2)) / window.sum()
    return torch.where(offset.abs() <= WINDOW // 2, weight, 0.0)
