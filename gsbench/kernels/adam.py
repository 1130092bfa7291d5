"""Check gradients for NaN and infinity and update parameters by Adam in place, all of them in one kernel call each.

A small model has about twelve parameters, and the overhead of a torch call costs as much as the update of one. On a GPU
neither call waits.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.headers import MAX_ADAM
from gsbench.kernels.library import Slots, library_of
from gsbench.kernels.operation import address, addresses, in_rows


@torch.no_grad()
def adam_all(
    parameters: Sequence[Tensor],  # of any shape, updated
    gradients: Sequence[Tensor],
    means: Sequence[Tensor],  # the running means of the gradients, updated
    squares: Sequence[Tensor],  # the running means of the squared gradients, updated
    steps: Sequence[Tensor],  # of []: how often each parameter was updated, updated
    rates: Sequence[Tensor],  # of []: the learning rates
    betas: Sequence[float],  # the decay rates of the two running means
    eps: float,  # added to the square root of the mean square
    skip: Tensor | None = None,  # []: nothing is updated unless it is 0
    drawn: Sequence[Tensor | None] | None = None,  # of [N] bool for a parameter [N, ...]: the rows to update; None: all
) -> None:
    """Update several parameters by Adam (Kingma & Ba 2015, algorithm 1), each with its own learning rate.

    Raises:
        InputError: tensors are not contiguous float32 on one device, or their shapes do not match.
    """
    if not parameters:
        return
    like, device = parameters[0], parameters[0].device
    updated = list(zip(parameters, [None] * len(parameters) if drawn is None else drawn, strict=True))  # with its rows
    gradients = in_rows(list(gradients))
    for name, listed in {"parameter": parameters, "gradient": gradients, "mean": means, "square": squares}.items():
        for x, parameter in zip(listed, parameters, strict=True):
            if not (x.shape == parameter.shape and _is_readable(x, torch.float32, device)):
                raise _refusal(f"adam_all: {name}", x, torch.float32, parameter.shape, device)
    for x in [*steps, *rates, *([] if skip is None else [skip])]:
        if x.dim() or not _is_readable(x, torch.float32, device):
            raise _refusal("adam_all: step, rate or skip", x, torch.float32, (), device)
    for parameter, rows in updated:
        if rows is not None and not (rows.shape == parameter.shape[:1] and _is_readable(rows, torch.bool, device)):
            raise _refusal("adam_all: drawn", rows, torch.bool, parameter.shape[:1], device)
    for part in _parts(len(parameters)):
        slots: Slots = {
            "count": len(parameters[part]),
            "numbers": tuple([x.numel() for x in parameters[part]]),
            # numbers in a row; 0: all rows are updated
            "widths": tuple([0 if rows is None else x.numel() // max(1, len(rows)) for x, rows in updated[part]]),
            "drawn": tuple([address(rows) for _, rows in updated[part]]),
            "gradients": addresses(gradients[part]),
            "rates": addresses(rates[part]),
            "skip": address(skip),
            "beta1": betas[0],
            "beta2": betas[1],
            "eps": eps,
            "out.parameters": addresses(parameters[part]),
            "out.means": addresses(means[part]),
            "out.squares": addresses(squares[part]),
            "out.steps": addresses(steps[part]),
        }
        library_of(like.device.type).call("adam_all", slots, like)


@torch.no_grad()
def flag_arrays(
    arrays: Sequence[Tensor | None],  # of any shapes; None counts as finite
    flags: Tensor,  # one for each array, set to 1 for those that have a number that is not finite
    skip: Tensor,  # [], set to 1 if any array has
) -> None:
    """Find which arrays are not finite, without waiting for a GPU. What is finite changes neither `flags` nor `skip`.

    Raises:
        InputError: arrays are not float32 on one device, or there is not one flag for each.
    """
    device = skip.device
    contiguous = in_rows([skip.new_empty(0) if x is None else x for x in arrays])
    for x in [*contiguous, skip]:
        if not _is_readable(x, torch.float32, device):
            raise _refusal("flag_arrays: arrays", x, torch.float32, x.shape, device)
    if not (flags.shape == (len(arrays),) and _is_readable(flags, torch.float32, device)):
        raise _refusal("flag_arrays: flags", flags, torch.float32, (len(arrays),), device)
    for part in _parts(len(arrays)):
        slots: Slots = {
            "count": len(contiguous[part]),
            "numbers": tuple([x.numel() for x in contiguous[part]]),
            "arrays": addresses(contiguous[part]),
            "out.flags": address(flags[part]),
            "out.skip": address(skip),
        }
        library_of(skip.device.type).call("flag_arrays", slots, skip)


def _parts(count: int) -> list[slice]:
    """Return which of `count` arrays each call of a kernel takes."""
    return [slice(first, min(first + MAX_ADAM, count)) for first in range(0, count, MAX_ADAM)]


def _is_readable(x: Tensor, dtype: torch.dtype, device: torch.device) -> bool:
    """Return whether a kernel can read a tensor; a training asks this of a hundred tensors in each step."""
    return x.dtype == dtype and x.device == device and x.is_contiguous()


def _refusal(name: str, x: Tensor, dtype: torch.dtype, shape: Sequence[int], device: torch.device) -> InputError:
    """Return the error for a tensor that a kernel cannot read."""
    return InputError(
        f"{name}: expected contiguous {dtype} of shape {list(shape)} on {device}, "
        f"got {x.dtype} of shape {list(x.shape)} on {x.device}"
    )
