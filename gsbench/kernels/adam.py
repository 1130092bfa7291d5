"""Update parameters by Adam in place: some Gaussians of one parameter, or several whole parameters in one call."""

from collections.abc import Sequence

import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.headers import MAX_ADAM
from gsbench.kernels.library import library_of
from gsbench.kernels.operation import address, addresses, in_rows
from gsbench.kernels.tensors import check_number, check_tensor


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
    """Do one Adam update (Kingma & Ba 2015, algorithm 1) of those rows (Gaussians) of a parameter that `drawn` selects.

    Args:
        parameter: the tensor to update.
        gradient: the gradient of the loss with respect to the parameter.
        mean: the running mean of the gradient, updated too.
        square: the running mean of the squared gradient, updated too.
        drawn: the rows to update.
        rate: the learning rate.
        betas: the decay rates of the two running means.
        eps: added to the square root of the mean square.
        step: the number of this update, from 1.

    Raises:
        InputError: tensors are not contiguous float32 on one device, or their shapes do not match.
    """
    named = {"parameter": parameter, "gradient": gradient, "mean": mean, "square": square}
    for name, x in named.items():
        check_tensor(x, f"adam: {name}", (torch.float32,))
        if x.shape != parameter.shape:
            raise InputError(f"adam: expected {name} of shape {list(parameter.shape)}, got {list(x.shape)}")
        if x.device != parameter.device:
            raise InputError(f"adam: expected {name} on {parameter.device}, got it on {x.device}")
    if not parameter.dim():
        raise InputError("adam: expected parameter of at least one dimension, got none")
    check_tensor(drawn, "adam: drawn", (torch.bool,))
    if drawn.shape != parameter.shape[:1] or drawn.device != parameter.device:
        raise InputError(f"adam: expected drawn of shape {list(parameter.shape[:1])} on {parameter.device}, got "
                         f"{list(drawn.shape)} on {drawn.device}")  # fmt: skip
    check_tensor(step, "adam: step", (torch.float32,))
    if step.shape != () or step.device != parameter.device:
        raise InputError(f"adam: expected step of shape [] on {parameter.device}, got {list(step.shape)} on "
                         f"{step.device}")  # fmt: skip
    if not isinstance(betas, list | tuple) or len(betas) != 2:
        raise InputError(f"adam: expected two betas, got {betas!r:.80}")
    for name, number in (("rate", rate), ("eps", eps), ("betas", betas[0]), ("betas", betas[1])):
        check_number(number, f"adam: {name}")
    if not all(x.is_contiguous() and not x.is_neg() for x in (parameter, mean, square)):
        raise InputError("adam: expected parameter, mean and square row by row in memory: call .contiguous()")
    if not len(parameter):
        return
    rows, of = in_rows([gradient, drawn])
    slots = {"N": len(parameter), "width": parameter[0].numel(), "drawn": address(of), "gradient": address(rows),
             "rate": rate, "beta1": betas[0], "beta2": betas[1], "eps": eps, "step": address(step),
             "out.parameter": address(parameter), "out.mean": address(mean), "out.square": address(square)}  # fmt: skip
    library_of(parameter.device.type).call("adam", slots, parameter)


@torch.no_grad()
def adam_all(
    parameters: Sequence[Tensor],
    gradients: Sequence[Tensor],
    means: Sequence[Tensor],
    squares: Sequence[Tensor],
    steps: Sequence[Tensor],  # of []
    rates: Sequence[float],
    betas: list[float],
    eps: float,
) -> None:
    """Update several parameters on the CPU by Adam, each with its own learning rate, as `torch.optim.Adam` does.

    All parameters are updated in one call: a small model has about twelve, and the overhead of a torch call costs as
    much as the update of one parameter.

    Args:
        parameters: the tensors to update, of any shape.
        gradients: the gradients of the loss with respect to the parameters.
        means: the running means of the gradients, updated too.
        squares: the running means of the squared gradients, updated too.
        steps: the number of this update for each parameter, from 1.
        rates: the learning rates.
        betas: the decay rates of the two running means.
        eps: added to the square root of the mean square.

    Raises:
        InputError: tensors are not contiguous float32 on the CPU, or their shapes do not match.
    """
    gradients = in_rows(list(gradients))
    for name, listed in {"parameter": parameters, "gradient": gradients, "mean": means, "square": squares}.items():
        for x, parameter in zip(listed, parameters, strict=True):
            if not (x.shape == parameter.shape and x.dtype == torch.float32 and x.is_cpu and x.is_contiguous()):
                raise InputError(f"adam_all: expected {name} as contiguous float32 of shape {list(parameter.shape)} on "
                                 f"the CPU, got {x.dtype} of shape {list(x.shape)} on {x.device}")  # fmt: skip
    for first in range(0, len(parameters), MAX_ADAM):
        part = slice(first, first + MAX_ADAM)
        slots = {
            "count": len(parameters[part]),
            "numbers": tuple([x.numel() for x in parameters[part]]),
            "gradients": addresses(gradients[part]),
            "steps": addresses(steps[part]),
            "rates": tuple(rates[part]),
            "beta1": betas[0],
            "beta2": betas[1],
            "eps": eps,
            "out.parameters": addresses(parameters[part]),
            "out.means": addresses(means[part]),
            "out.squares": addresses(squares[part]),
        }
        library_of("cpu").call("adam_all", slots, parameters[0])
