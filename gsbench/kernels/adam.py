"""Update parameters by Adam in place, several of them in one call, and check that gradients are finite.

A small model has about twelve parameters, and the overhead of a torch call costs as much as the update of one.
"""

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
    parameter: Tensor,  # [N, ...], updated
    gradient: Tensor,  # [N, ...]
    mean: Tensor,  # [N, ...] the running mean of the gradient, updated
    square: Tensor,  # [N, ...] the running mean of the squared gradient, updated
    drawn: Tensor,  # [N] bool: the rows to update
    rate: float,  # the learning rate
    betas: list[float],  # the decay rates of the two running means
    eps: float,  # added to the square root of the mean square
    step: Tensor,  # [] the number of this update, from 1
) -> None:
    """Do one Adam update (Kingma & Ba 2015, algorithm 1) of those rows (Gaussians) of a parameter that `drawn` selects.

    Raises:
        InputError: tensors are not contiguous float32 on one device, or their shapes do not match.
    """
    named = {"parameter": parameter, "gradient": gradient, "mean": mean, "square": square, "drawn": drawn, "step": step}
    for name, x in named.items():
        check_tensor(x, f"adam: {name}", (torch.bool if name == "drawn" else torch.float32,))
        if not parameter.dim():
            raise InputError("adam: expected parameter of at least one dimension, got none")
        shape = {"drawn": parameter.shape[:1], "step": torch.Size()}.get(name, parameter.shape)
        if x.shape != shape or x.device != parameter.device:
            raise InputError(
                f"adam: expected {name} of shape {list(shape)} on {parameter.device}, got {list(x.shape)} on {x.device}"
            )
    if not isinstance(betas, list | tuple) or len(betas) != 2:
        raise InputError(f"adam: expected two betas, got {betas!r:.80}")
    for name, number in (("rate", rate), ("eps", eps), ("betas", betas[0]), ("betas", betas[1])):
        check_number(number, f"adam: {name}")
    if not all(x.is_contiguous() and not x.is_neg() for x in (parameter, mean, square)):
        raise InputError("adam: expected parameter, mean and square row by row in memory: call .contiguous()")
    if not len(parameter):
        return
    gradient, drawn = in_rows([gradient, drawn])
    slots = {
        "N": len(parameter),
        "width": parameter[0].numel(),
        "drawn": address(drawn),
        "gradient": address(gradient),
        "rate": rate,
        "beta1": betas[0],
        "beta2": betas[1],
        "eps": eps,
        "step": address(step),
        "out.parameter": address(parameter),
        "out.mean": address(mean),
        "out.square": address(square),
    }
    library_of(parameter.device.type).call("adam", slots, parameter)


@torch.no_grad()
def adam_all(
    parameters: Sequence[Tensor],  # of any shape, updated
    gradients: Sequence[Tensor],
    means: Sequence[Tensor],  # the running means of the gradients, updated
    squares: Sequence[Tensor],  # the running means of the squared gradients, updated
    steps: Sequence[Tensor],  # of []: the number of this update for each parameter, from 1
    rates: Sequence[float],  # the learning rates
    betas: list[float],  # the decay rates of the two running means
    eps: float,  # added to the square root of the mean square
) -> None:
    """Update several parameters on the CPU by Adam, each with its own learning rate, as `torch.optim.Adam` does.

    Raises:
        InputError: tensors are not contiguous float32 on the CPU, or their shapes do not match.
    """
    gradients = in_rows(list(gradients))
    for name, listed in {"parameter": parameters, "gradient": gradients, "mean": means, "square": squares}.items():
        for x, parameter in zip(listed, parameters, strict=True):
            if not (x.shape == parameter.shape and x.dtype == torch.float32 and x.is_cpu and x.is_contiguous()):
                raise InputError(
                    f"adam_all: expected {name} as contiguous float32 of shape {list(parameter.shape)} on "
                    f"the CPU, got {x.dtype} of shape {list(x.shape)} on {x.device}"
                )
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


@torch.no_grad()
def are_finite(arrays: Sequence[Tensor]) -> bool:
    """Return whether all numbers of some float32 arrays on the CPU, of any shapes, are finite."""
    rows = in_rows(list(arrays))
    for first in range(0, len(rows), MAX_ADAM):
        part = rows[first : first + MAX_ADAM]
        flags = part[0].new_zeros(1, dtype=torch.int64)
        slots = {
            "count": len(part),
            "numbers": tuple([x.numel() for x in part]),
            "arrays": addresses(part),
            "out.flags": flags.data_ptr(),
        }
        library_of("cpu").call("flag_arrays", slots, flags)
        if flags.item():
            return False
    return True
