"""The training loss against scikit-image, finite differences and its own definition."""

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor

from gsbench.train.losses import photometric, structural_similarity


def pair(height: int, width: int) -> tuple[Tensor, Tensor]:
    random = torch.Generator().manual_seed(height * 1000 + width)
    return tuple(torch.rand(2, height, width, 3, generator=random, dtype=torch.float64))


def ssim_by_scipy(a: np.ndarray, b: np.ndarray) -> float:
    def blur(image: np.ndarray) -> np.ndarray:
        return gaussian_filter(image, (1.5, 1.5, 0), radius=(5, 5, 0), mode="constant")  # 11 x 11, zero padded

    ma, mb, aa, bb, ab = map(blur, (a, b, a**2, b**2, a * b))
    top = (2 * ma * mb + 1e-4) * (2 * (ab - ma * mb) + 9e-4)
    return float(np.mean(top / ((ma**2 + mb**2 + 1e-4) * (aa - ma**2 + bb - mb**2 + 9e-4))))


@pytest.mark.parametrize("size", [(11, 11), (17, 33), (1, 1), (5, 40)])
def test_ssim_is_the_definition(size):
    """Catches a wrong window, padding or constant: the filter of scipy is the truth."""
    a, b = pair(*size)
    assert structural_similarity(a, b).item() == pytest.approx(ssim_by_scipy(a.numpy(), b.numpy()), rel=1e-10)


def test_weights():
    """Catches swapped or missing weights: (1 - w) L1 + w (1 - SSIM), 3DGS eq. 7."""
    a, b = pair(20, 24)
    l1, ssim = (a - b).abs().mean().item(), structural_similarity(a, b).item()
    for w in (0.0, 0.2, 1.0):
        assert photometric(a, b, w).item() == pytest.approx((1 - w) * l1 + w * (1 - ssim), rel=1e-12)


def test_gradient():
    """Catches a detached term: the gradient is that of finite differences."""
    a, b = pair(12, 13)
    assert torch.autograd.gradcheck(lambda x: photometric(x, b, 0.2), (a.requires_grad_(),))
