"""The training loss on the GPU: (1 - w) L1 + w (1 - SSIM) of two pictures, its gradient computed along with it."""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from gsbench.kernels.arrays import plain
from gsbench.kernels.cuda import allocate, cuda, on_device, pointers, stream


@on_device
def l1_ssim(
    image: Tensor,  # [H, W, 3] float32
    target: Tensor,  # [H, W, 3] float32
    ssim_weight: float,
) -> Tensor:  # []
    """The same value as `gsbench.train.losses.photometric`, differentiable in `image`."""
    loss: Tensor = _L1SSIM.apply(image, target, ssim_weight)
    return loss


class _L1SSIM(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> Tensor:
        image, target = plain(*inputs[:2])
        height, width, channels = image.shape
        parts = image.new_empty(cuda().similarity_blocks(height, width))
        grad = scratch = None
        if ctx.needs_input_grad[0]:
            grad = allocate("the gradient of the loss", image, *image.shape)
            scratch = allocate("derivatives of SSIM", image, 3, channels, height, width)
            ctx.save_for_backward(grad)
        cuda().l1_ssim(height, width, *pointers(image, target), inputs[2], *pointers(parts, scratch, grad),
                       stream(image))  # fmt: skip
        return parts.sum()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None]:
        (grad,) = ctx.saved_tensors
        return grads[0] * grad, None, None
