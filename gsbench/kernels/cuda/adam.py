"""Adam on the rows of a parameter that were drawn, on the GPU: `gsbench.kernels.adam` says what it does."""

import math

from torch import Tensor

from gsbench.kernels.arrays import plain
from gsbench.kernels.cuda import cuda, on_device, pointers, stream


@on_device
def adam(
    parameter: Tensor, gradient: Tensor, mean: Tensor, square: Tensor, drawn: Tensor, rate: float, betas: list[float],
    eps: float, step: Tensor,
) -> None:  # fmt: skip
    """Update in place; the step's number stays on the device, so that nothing waits for it."""
    given = plain(drawn, gradient, step)
    cuda().adam(len(parameter), parameter[0].numel(), *pointers(*given[:2], parameter, mean, square), rate, *betas,
                *(math.log(beta) for beta in betas), eps, *pointers(given[2]), stream(parameter))  # fmt: skip
