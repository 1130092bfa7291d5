"""Adam on the rows of a parameter that were drawn, in place: the others cost a look at a mask."""

import torch
from torch import Tensor
from torch.library import custom_op

from gsbench.errors import InputError
from gsbench.kernels import native, threads
from gsbench.kernels.arrays import check
from gsbench.kernels.cuda import adam as on_cuda


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

    `mean` and `square` are the running means of the gradient and of its square.

    Raises:
        InputError: not contiguous float32 on one device, or shapes that do not fit.
    """
    shape = tuple(parameter.shape)
    named = {"parameter": parameter, "gradient": gradient, "mean": mean, "square": square}
    check("adam", {name: (tensor, shape) for name, tensor in named.items()} | {"step": (step, ())})
    if drawn.shape != shape[:1] or drawn.dtype != torch.bool or drawn.device != parameter.device:
        raise InputError(f"adam: expected drawn as bool of shape {list(shape[:1])} on {parameter.device}, got "
                         f"{drawn.dtype} of shape {list(drawn.shape)} on {drawn.device}")  # fmt: skip
    if not all(tensor.is_contiguous() for tensor in (parameter, mean, square)):
        raise InputError("adam: expected parameter, mean and square row by row in memory: call .contiguous()")
    if len(parameter):
        _adam(parameter, gradient, mean, square, drawn, rate, betas, eps, step)


@custom_op("gsbench::adam", mutates_args=("parameter", "mean", "square"))
def _adam(
    parameter: Tensor, gradient: Tensor, mean: Tensor, square: Tensor, drawn: Tensor, rate: float, betas: list[float],
    eps: float, step: Tensor,
) -> None:  # fmt: skip
    rows = [t.detach().view(len(t), -1) for t in (parameter, gradient.contiguous(), mean, square)]
    count = step.item()
    unbias = [1 / (1 - betas[0] ** count), (1 - betas[1] ** count) ** -0.5]
    native().adam(*rows, drawn.contiguous(), rate, *betas, eps, *unbias, threads())


@_adam.register_fake
def _(*_: object) -> None:
    return None


_adam.register_kernel("cuda")(on_cuda.adam)
