"""What the operations of `gsbench.kernels.slices`, `.colors` and `.refine` do for tensors on the GPU.

lambda, time and the camera's centre are read on the device: nothing here waits for it. An empty tensor's address is 0,
by which the kernels know that time is not observed.
"""

import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.arrays import plain
from gsbench.kernels.cuda import allocate, cuda, on_device, pointers, stream


@on_device
def observe(
    means: Tensor, directions: Tensor, times: Tensor, log_diagonal: Tensor, shape: Tensor, motion: Tensor,
    coupling: Tensor, opacities: Tensor, center: Tensor, time: Tensor, lambda_d: Tensor, lambda_t: Tensor, half: float,
    conditioned_first: bool, form: int, subtracts: bool,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Means [N, 3], factors [N, 3, 3] and opacities [N] of a slice; empty `times`: time is not observed."""
    if subtracts:
        raise InputError("observe_triangular: expected the square-root scheme on a GPU, got one that subtracts")
    out = _observation(means)
    arrays = plain(time, lambda_d, lambda_t, center, means, directions, times, log_diagonal, shape, motion, coupling,
                   opacities)  # fmt: skip
    cuda().observe_triangular(len(means), conditioned_first, form, half, *pointers(*arrays), *pointers(*out),
                              stream(means))  # fmt: skip
    return out


@on_device
def observe_backward(
    means: Tensor, directions: Tensor, times: Tensor, log_diagonal: Tensor, shape: Tensor, motion: Tensor,
    coupling: Tensor, opacities: Tensor, center: Tensor, time: Tensor, lambda_d: Tensor, lambda_t: Tensor, half: float,
    conditioned_first: bool, form: int, subtracts: bool, g_means: Tensor, g_factors: Tensor, g_opacities: Tensor,
) -> tuple[Tensor, ...]:  # fmt: skip
    """Gradients of the first eight, and of (lambda_d, lambda_t) [2]."""
    assert not subtracts, "`observe` has refused it"
    arrays = plain(time, lambda_d, lambda_t, center, means, directions, times, log_diagonal, shape, motion, coupling,
                   opacities)  # fmt: skip
    out = _like(means, directions, times, log_diagonal, shape, motion, coupling, opacities)
    lambdas = means.new_zeros(2)
    given = plain(g_means, g_factors, g_opacities)
    cuda().observe_triangular_backward(len(means), conditioned_first, form, half, *pointers(*arrays),
                                       *pointers(*given, *out, lambdas), stream(means))  # fmt: skip
    return *out, lambdas


@on_device
def rotated(
    means: Tensor, times: Tensor, scales: Tensor, left: Tensor, right: Tensor, opacities: Tensor,
    time: Tensor, lambda_t: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Means [N, 3], factors [N, 3, 3] and opacities [N] of a slice of 4D Gaussians."""
    out = _observation(means)
    arrays = plain(time, lambda_t, means, times, scales, left, right, opacities)
    cuda().observe_rotated(len(means), *pointers(*arrays, *out), stream(means))
    return out


@on_device
def rotated_backward(
    means: Tensor, times: Tensor, scales: Tensor, left: Tensor, right: Tensor, opacities: Tensor, time: Tensor,
    lambda_t: Tensor, g_means: Tensor, g_factors: Tensor, g_opacities: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """Gradients of the first six, and of lambda_t."""
    arrays = plain(time, lambda_t, means, times, scales, left, right, opacities, g_means, g_factors, g_opacities)
    out = _like(means, times, scales, left, right, opacities)
    g_lambda = torch.zeros_like(lambda_t)
    cuda().observe_rotated_backward(len(means), *pointers(*arrays, *out, g_lambda), stream(means))
    return out[0], out[1], out[2], out[3], out[4], out[5], g_lambda


@on_device
def still(scales: Tensor, quats: Tensor, opacities: Tensor) -> tuple[Tensor, Tensor]:
    """Factors [N, 3, 3] and opacities [N] of 3D Gaussians."""
    N, arrays = len(scales), plain(scales, quats, opacities)
    factors, out = (allocate("a slice's Gaussians", scales, N, *row) for row in ((3, 3), ()))
    cuda().observe_still(N, *pointers(*arrays, factors, out), stream(scales))
    return factors, out


@on_device
def still_backward(
    scales: Tensor, quats: Tensor, opacities: Tensor, g_factors: Tensor, g_opacities: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients of the first three."""
    arrays, out = plain(scales, quats, opacities, g_factors, g_opacities), _like(scales, quats, opacities)
    cuda().observe_still_backward(len(scales), *pointers(*arrays, *out), stream(scales))
    return out[0], out[1], out[2]


@on_device
def show(
    sh0: Tensor, shN: Tensor, means: Tensor, opacities: Tensor, times: Tensor, center: Tensor,
    time: Tensor, degree: int, waves: int,
) -> Tensor:  # fmt: skip
    """Colours [N, 3]; empty `times`: they do not change."""
    colors = allocate("colours", means, len(means), 3)
    arrays = plain(sh0, shN, means, opacities, times, center, time)
    cuda().show_colors(len(means), degree, _bases(shN, waves), waves, *pointers(*arrays, colors), stream(means))
    return colors


@on_device
def show_backward(
    sh0: Tensor, shN: Tensor, means: Tensor, opacities: Tensor, times: Tensor, center: Tensor,
    time: Tensor, degree: int, waves: int, g_colors: Tensor, rows: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """Gradients of sh0, shN, means and times."""
    assert rows is None, "`rows` are of the CPU's kernel"
    arrays = plain(sh0, shN, means, opacities, times, center, time, g_colors)
    out = [x.zero_() for x in _like(sh0, shN, means, times)]
    cuda().show_colors_backward(len(means), degree, _bases(shN, waves), waves, *pointers(*arrays, *out),
                                stream(means))  # fmt: skip
    return out[0], out[1], out[2], out[3]


@on_device
def refine(
    values: list[Tensor], weight_in: Tensor, bias_in: Tensor, weight_out: Tensor, bias_out: Tensor, widths: list[int]
) -> list[Tensor]:
    """Values moved by the perceptrons."""
    limits, features = cuda(), sum(widths[:-1])
    if features > limits.MAX_FEATURES or len(widths) > limits.MAX_NETWORKS or max(widths) > limits.MAX_WIDTH:
        raise InputError(f"refine: expected on a GPU at most {limits.MAX_NETWORKS} networks of at most "
                         f"{limits.MAX_FEATURES} features and at most {limits.MAX_WIDTH} outputs, got {len(widths)}, "
                         f"{features} and {max(widths)}")  # fmt: skip
    given, weights = plain(*values), plain(weight_in, bias_in, weight_out, bias_out)
    out = [allocate("refinements", x, *x.shape) for x in given]
    cuda().refine(len(given[0]), widths, _widths(given), pointers(*given), *pointers(*weights), pointers(*out),
                  stream(weight_in))  # fmt: skip
    return out


@on_device
def refine_backward(
    values: list[Tensor], weight_in: Tensor, bias_in: Tensor, weight_out: Tensor, bias_out: Tensor, widths: list[int],
    g_out: list[Tensor],
) -> list[Tensor]:  # fmt: skip
    """Gradients of the features, then of the weights."""
    given, grads, weights = plain(*values), plain(*g_out), plain(weight_in, bias_in, weight_out, bias_out)
    features = [g.clone() for g in grads[: len(widths) - 1]]
    by_network = allocate("gradients of AGR's features", weight_in, len(widths), len(given[0]), sum(widths[:-1]))
    out = [torch.zeros_like(x) for x in weights]
    cuda().refine_backward(len(given[0]), widths, _widths(given), pointers(*given), *pointers(*weights),
                           pointers(*grads), pointers(*features), *pointers(by_network, *out),
                           stream(weight_in))  # fmt: skip
    return [*features, *out]


def _widths(values: tuple[Tensor, ...]) -> list[int]:
    return [x.shape[-1] for x in values]


def _observation(means: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Means [N, 3], factors [N, 3, 3] and opacities [N], to be written."""
    a, b, c = (allocate("a slice's Gaussians", means, len(means), *row) for row in ((3,), (3, 3), ()))
    return a, b, c


def _like(*parameters: Tensor) -> list[Tensor]:
    """Gradients, to be written."""
    return [allocate("gradients of a model's parameters", x, *x.shape) for x in parameters]


def _bases(shN: Tensor, waves: int) -> int:
    """Harmonics stored for each frequency."""
    return (shN.shape[1] + 1) // waves
