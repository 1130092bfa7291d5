"""L1 and SSIM on the GPU, the gradient computed along with them."""

import torch
from torch import Tensor

from gsbench.kernels.cuda import cuda, plain, pointers, stream


def l1_ssim(
    image: Tensor,  # [H, W, 3]
    target: Tensor,  # [H, W, 3]
    ssim_weight: float,
    with_gradient: bool,
) -> tuple[Tensor, Tensor | None]:
    """(1 - w) L1 + w (1 - SSIM), [], and its gradient by `image`, [H, W, 3], where one is wanted."""
    image, target = plain(image, target)
    height, width, channels = image.shape
    parts = image.new_empty(cuda().similarity_blocks(height, width))
    grad = torch.empty_like(image) if with_gradient else None
    scratch = image.new_empty(3, channels, height, width) if with_gradient else None
    cuda().l1_ssim(height, width, *pointers(image, target), ssim_weight, *pointers(parts, scratch, grad),
                   stream(image))  # fmt: skip
    return parts.sum(), grad
