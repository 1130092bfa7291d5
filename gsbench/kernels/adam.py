"""Adam on the rows of a parameter that were drawn, in place: the others cost a look at a mask."""

import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.library import library_of
from gsbench.kernels.operation import address


@torch.no_grad()
def adam(
    parameter: Tensor,  # [N, ...]
    gradient: Tensor,  # [N, ...]
    mean: Tensor,  # [N, ...]
    square: Tensor,  # [N, ...]
    drawn: Tensor,  # [N] bool
    rate: float,
    betas: list[float],
    eps: float,
    step: Tensor,  # []
) -> None:
    """One update, the `step`-th from 1, of the rows `drawn` (Kingma & Ba 2015, algorithm 1).

    Args:
        parameter: what is moved.
        gradient: of the loss by it.
        mean: the running mean of the gradient.
        square: that of its square.
        drawn: which rows are updated.
        rate: the learning rate.
        betas: how much of the two means is kept.
        eps: added to the root of the mean square.
        step: the number of this update.

    Raises:
        InputError: not contiguous float32 on one device, or shapes that do not fit.
    """
    named = {"parameter": parameter, "gradient": gradient, "mean": mean, "square": square}
    for name, x in named.items():
        if x.shape != parameter.shape:
            raise InputError(f"adam: expected {name} of shape {list(parameter.shape)}, got {list(x.shape)}")
        if x.dtype != torch.float32 or x.device != parameter.device:
            raise InputError(f"adam: expected {name} as float32 on {parameter.device}, got {x.dtype} on {x.device}")
    if drawn.shape != parameter.shape[:1] or drawn.dtype != torch.bool or drawn.device != parameter.device:
        raise InputError(f"adam: expected drawn as bool of shape {list(parameter.shape[:1])} on {parameter.device}, "
                         f"got {drawn.dtype} of shape {list(drawn.shape)} on {drawn.device}")  # fmt: skip
    if step.shape != () or step.dtype != torch.float32 or step.device != parameter.device:
        raise InputError(f"adam: expected step as float32 of shape [] on {parameter.device}, got {step.dtype} of "
                         f"{list(step.shape)} on {step.device}")  # fmt: skip
    if not all(x.is_contiguous() for x in (parameter, mean, square)):
        raise InputError("adam: expected parameter, mean and square row by row in memory: call .contiguous()")
    if not len(parameter):
        return
    rows, of = gradient.contiguous(), drawn.contiguous()
    slots = {"N": len(parameter), "width": parameter[0].numel(), "drawn": address(of), "gradient": address(rows),
             "rate": rate, "beta1": betas[0], "beta2": betas[1], "eps": eps, "step": address(step),
             "out.parameter": address(parameter), "out.mean": address(mean), "out.square": address(square)}  # fmt: skip
    library_of(parameter.device.type).call("adam", slots, parameter)
