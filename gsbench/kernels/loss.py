"""Compute the training loss of 3DGS, (1 - w) L1 + w (1 - SSIM) with weight w, together with its gradient."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.library import Slots, allocate, library_of
from gsbench.kernels.operation import Gradient, Input, Operation, Output, Sums, Tensors, Upstream, address, in_rows
from gsbench.kernels.tensors import check_number, check_tensor

_TARGET = (torch.float32, torch.uint8)


class _Similarity(Operation):
    """The loss as a differentiable operation; the forward pass also computes the gradient with respect to the image.

    So the backward pass only multiplies this gradient by the gradient that it gets for the loss.
    """

    def __init__(self) -> None:
        super().__init__(
            "l1_ssim",
            inputs={
                "image": Input("C height width 3"),
                "target": Input("C height width 3", Gradient.REFUSED, _TARGET),
            },
            outputs={"loss": Output("C"), "gradient": Output("numbers", gradient=False)},
            numbers={"ssim_weight": float, "with_gradient": bool},
            derive=lambda tensors, numbers: {"numbers": tensors["image"].numel() if numbers["with_gradient"] else 0},
        )

    def run(self, tensors: Tensors, numbers: Sequence[Any]) -> tuple[Tensors, Slots]:
        """Return the loss of each image [C], and its gradient by the image, which is empty unless `with_gradient`."""
        slots = self.match(tensors, numbers).copy()
        image, target = in_rows(tensors)
        C, height, width = slots["C"], slots["height"], slots["width"]
        library = library_of(image.device.type)
        parts = image.new_empty(C, library.similarity_parts(height, width))  # sums, whose total is the loss
        gradient = allocate("the gradient of the loss", image, (slots["numbers"],))
        scratch = None
        if library.needs_scratch and slots["with_gradient"]:
            scratch = allocate("derivatives of SSIM", image, (C, 3, 3, height, width))
        in_bytes = target.dtype == torch.uint8
        slots |= {
            "image": image.data_ptr(),
            "target": 0 if in_bytes else target.data_ptr(),
            "target_bytes": target.data_ptr() if in_bytes else 0,
            "out.loss": parts.data_ptr(),
            "out.gradient": gradient.data_ptr(),
            "out.scratch": address(scratch),
        }
        library.call(self.name, slots, image)
        return [parts.sum(1) if parts.shape[1] > 1 else parts[:, 0], gradient], slots

    def prepare(self, tensors: Tensors, numbers: Sequence[Any], outputs: Sequence[Tensor] = ()) -> Slots:
        return {}  # `backward` calls no kernel

    def backward(
        self, tensors: Tensors, slots: Slots, outputs: Tensors, upstream: Upstream, wanted: Sequence[bool], sums: Sums
    ) -> list[Tensor | None]:
        """Multiply the gradients that `run` has computed by those by the losses; there is none by the target."""
        by_loss, image = upstream[0], tensors[0]  # [C], [C, H, W, 3]
        return [None if by_loss is None else by_loss.view(-1, 1, 1, 1) * outputs[1].view_as(image), None]


_similarity = _Similarity()


def l1_ssim(
    image: Tensor,  # [H, W, 3] or [C, H, W, 3]
    target: Tensor,  # as image, or the same in 8 bits
    ssim_weight: float,
) -> Tensor:  # [] or [C]
    """Return the loss of 3DGS (eq. 7) of each image, (1 - w) L1 + w (1 - SSIM), differentiable with respect to `image`.

    The weight w is `ssim_weight`. SSIM has an 11 x 11 Gaussian window of sigma 1.5 and zero padding. The value is that
    of `gsbench.train.losses.photometric`. A target of uint8 is divided by 255 as it is read; the result has the same
    bits as with floats.

    Raises:
        InputError: the arguments are not images of the same size on one device, `image` is not float32, `target` is
            neither float32 nor uint8, or it requires a gradient.
    """
    check_tensor(image, "l1_ssim: image", (torch.float32,))
    check_tensor(target, "l1_ssim: target", _TARGET)
    check_number(ssim_weight, "l1_ssim: ssim_weight", 0, 1)
    if image.dim() not in (3, 4) or image.shape[-1] != 3 or target.shape != image.shape or not image.numel():
        raise InputError(
            f"l1_ssim: expected image and target [H, W, 3] or [C, H, W, 3] of one size, got "
            f"{list(image.shape)} and {list(target.shape)}"
        )
    with_gradient = image.requires_grad and torch.is_grad_enabled()
    if image.dim() == 3:
        return _similarity(image[None], target[None], ssim_weight, with_gradient)[0][0]
    return _similarity(image, target, ssim_weight, with_gradient)[0]
