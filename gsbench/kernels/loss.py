"""The training loss as one torch operation: (1 - w) L1 + w (1 - SSIM) of two pictures, with its gradient."""

from typing import Any

import torch
from torch import Tensor
from torch.library import custom_op

from gsbench.errors import InputError
from gsbench.kernels import native, threads
from gsbench.kernels.cuda import loss as on_cuda


def l1_ssim(
    image: Tensor,  # [H, W, 3]
    target: Tensor,  # [H, W, 3]
    ssim_weight: float,
) -> Tensor:  # []
    """The loss 3DGS trains with (eq. 7), differentiable in `image`: 11 x 11 Gaussian window, sigma 1.5, zero padded.

    Same value as `gsbench.train.losses.photometric`; the gradient is computed along with it, where one is wanted.

    Raises:
        InputError: not two float32 pictures of one size on one device, or a gradient by `target` is asked for.
    """
    for name, tensor in {"image": image, "target": target}.items():
        if tensor.dim() != 3 or tensor.shape[-1] != 3 or tensor.shape != image.shape or not tensor.numel():
            raise InputError(f"l1_ssim: expected image and target [H, W, 3] of one size, got {list(image.shape)} and "
                             f"{list(target.shape)}")  # fmt: skip
        if tensor.dtype != torch.float32 or tensor.device != image.device or tensor.device.type not in ("cpu", "cuda"):
            raise InputError(f"l1_ssim: expected {name} as float32 on the CPU or a GPU, as the other picture, got "
                             f"{tensor.dtype} on {tensor.device}")  # fmt: skip
    if target.requires_grad:
        raise InputError("l1_ssim has no gradient by target: detach it")
    if image.is_cuda:
        return on_cuda.l1_ssim(image, target, ssim_weight)
    loss, _ = _l1_ssim(image, target, ssim_weight, image.requires_grad and torch.is_grad_enabled())
    return loss


@custom_op("gsbench::l1_ssim", mutates_args=())
def _l1_ssim(image: Tensor, target: Tensor, ssim_weight: float, with_gradient: bool) -> tuple[Tensor, Tensor]:
    grad = image.new_empty(image.shape if with_gradient else (0, 0, 3))
    pictures = image.detach().contiguous(), target.detach().contiguous()
    loss = native().l1_ssim(*pictures, ssim_weight, threads(), grad)
    return image.new_tensor(loss), grad


@_l1_ssim.register_fake
def _(image: Tensor, target: Tensor, ssim_weight: float, with_gradient: bool) -> tuple[Tensor, Tensor]:  # noqa: ARG001
    return image.new_empty(()), image.new_empty(image.shape if with_gradient else (0, 0, 3))


def _context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:  # noqa: ARG001
    ctx.save_for_backward(output[1])
    ctx.mark_non_differentiable(output[1])
    ctx.set_materialize_grads(False)


def _gradient(ctx: Any, g_loss: Tensor | None, _: Tensor | None) -> tuple[Tensor | None, None, None, None]:
    (grad,) = ctx.saved_tensors
    return None if g_loss is None else g_loss * grad, None, None, None


_l1_ssim.register_autograd(_gradient, setup_context=_context)
