"""Slices, colours and refinement by the CUDA kernels, on a GPU or by the shim, against the models written in torch."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest
import torch
from test_observe import VARIANTS, assert_same, color_inputs, gradients, model_and_raw, rotated, still
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels import colors, refine, slices
from gsbench.kernels.cuda import observe as on_cuda
from gsbench.models import Query
from gsbench.models.appearance import sh_colors, sh_time_colors
from gsbench.models.base import unit
from gsbench.models.factors import OFF_DIAGONALS
from gsbench.models.gaussians3d import Gaussians3DModel
from gsbench.models.refinement import Refinement

OPERATIONS = {
    slices._observe: on_cuda.observe,
    slices._observe_backward: on_cuda.observe_backward,
    slices._rotated: on_cuda.rotated,
    slices._rotated_backward: on_cuda.rotated_backward,
    slices._still: on_cuda.still,
    slices._still_backward: on_cuda.still_backward,
    colors._show: on_cuda.show,
    colors._show_backward: on_cuda.show_backward,
    refine._refine: on_cuda.refine,
    refine._refine_backward: on_cuda.refine_backward,
}
Move = Callable[[Tensor], Tensor]


@pytest.fixture
def move(cuda_device: str) -> Iterator[Move]:
    """Takes tensors to where the kernels run; for the shim, the operations call these on the CPU meanwhile."""
    with ExitStack() as stack:
        for operation, function in OPERATIONS.items() if cuda_device == "cpu" else ():
            operation.register_kernel("cpu")(function)
            operation._disabled_kernel.discard("cpu")  # `set_kernel_enabled` cannot leave it disabled
            stack.callback(operation._disabled_kernel.add, "cpu")
        yield lambda x: x.detach().to(cuda_device, torch.float32).requires_grad_(x.requires_grad)


def back(tensors: list[Tensor]) -> list[Tensor]:
    return [x.cpu() for x in tensors]


@pytest.mark.parametrize(("timed", "options"), VARIANTS)
def test_slice(timed: bool, options: dict[str, Any], move: Move) -> None:
    """Catches a wrong row order, reflection, gate or derivative of any parameter."""
    center = torch.tensor([0.3, -0.2, -3.0])
    exact, raw = model_and_raw(timed, options, torch.float64)
    seen = exact.condition(raw, Query(center.double(), torch.tensor(0.4, dtype=torch.float64)))
    expected = [seen.means, seen.factors, torch.sigmoid(raw["opacities"]) * seen.gate]
    model, _ = model_and_raw(timed, options, torch.float32)
    single = {name: move(value) for name, value in raw.items()}
    lambdas = {name: move(value) for name, value in model.log_modulation.items()}
    actual = list(slices.observe_triangular(
        single["means"], single["directions"], single.get("times"), single["log_diagonal"], single["shape"],
        single["motion"], single["coupling"], single["opacities"], move(center), move(torch.tensor(0.4)),
        lambdas["direction"].exp(), lambdas["time"].exp() if timed else None,
        conditioned_first=options.get("factor_order") != "paper", form=OFF_DIAGONALS.index(model.triangle.form),
        directional_half=model.directional_half,
    ))  # fmt: skip
    assert_same(back(actual), expected)
    wanted = gradients(expected, [*raw.values(), *exact.log_modulation.values()])
    weights = torch.Generator().manual_seed(2)
    given = [move(torch.randn(x.shape, generator=weights)) for x in actual]
    assert_same(back(list(torch.autograd.grad(actual, [*single.values(), *lambdas.values()], given))), wanted)


def test_rotated_slice(move: Move) -> None:
    """Catches a wrong sign of a quaternion's matrix, row order, gate or derivative of any parameter."""
    exact, raw = rotated(torch.float64)
    seen = exact.condition(raw, Query(torch.zeros(3, dtype=torch.float64), torch.tensor(0.4, dtype=torch.float64)))
    expected = [seen.means, seen.factors, torch.sigmoid(raw["opacities"]) * seen.gate]
    single = [move(x) for x in raw.values()]
    log_lambda = move(exact.log_modulation["time"])
    actual = list(slices.observe_rotated(*single, move(torch.tensor(0.4)), log_lambda.exp()))
    assert_same(back(actual), expected)
    g = torch.Generator().manual_seed(2)
    given = [move(torch.randn(x.shape, generator=g)) for x in actual]
    assert_same(back(list(torch.autograd.grad(actual, [*single, log_lambda], given))),
                gradients(expected, [*raw.values(), exact.log_modulation["time"]]))  # fmt: skip


def test_still_slice(move: Move) -> None:
    """Catches a wrong sign of a rotation's entry, a size that does not stop, or a derivative."""
    raw = still(torch.float64)
    expected = [Gaussians3DModel.factors(raw), torch.sigmoid(raw["opacities"])]
    single = [move(x) for x in raw.values()]
    actual = list(slices.observe_still(*single))
    assert_same(back(actual), expected)
    g = torch.Generator().manual_seed(2)
    given = [move(torch.randn(x.shape, generator=g)) for x in actual]
    assert_same(back(list(torch.autograd.grad(actual, single, given))), gradients(expected, list(raw.values())))


@pytest.mark.parametrize("waves", [1, 3])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_colors(degree: int, waves: int, move: Move) -> None:
    """Catches a wrong harmonic, wave or derivative, and coefficients of degrees not in use that get a gradient."""
    center, opacities = torch.tensor([0.1, 0.2, -2.0]), torch.ones(21)
    opacities[4] = 0.9 / 255  # not drawn: no colour, no gradient
    sh0, shN, means, times = inputs = color_inputs(waves, torch.float64)
    directions, all_of = unit(means - center.double()), torch.cat([sh0, shN], 1)
    if waves == 1:
        expected = sh_colors(all_of, directions, degree)
    else:
        expected = sh_time_colors(all_of.unflatten(1, (waves, 16)), directions, degree, 0.7 - times[:, 0])
    expected = expected * (opacities > 1 / 255).double()[:, None]
    used = 3 if waves == 1 else 4
    single = [move(x) for x in inputs]
    actual = colors.show_colors(*single[:3], move(opacities), move(center), degree,
                                single[3] if waves > 1 else None, move(torch.tensor(0.7)), waves)  # fmt: skip
    assert_same([actual.cpu()], [expected])
    wanted = torch.autograd.grad(expected.sum(), inputs[:used], materialize_grads=True)
    assert_same(back(list(torch.autograd.grad(actual.sum(), single[:used]))), list(wanted))


@pytest.mark.parametrize(
    ("N", "widths"),
    [(1, [3, 1, 3, 28]), (300, [3, 1, 3, 28]), (300, [3, 3, 21]), (16_421, [3, 7])],  # the last: more than 512 batches
)
def test_refinement(N: int, widths: list[int], move: Move) -> None:
    """Catches a batch's edge that is lost, a network that reads another's weights, and any wrong gradient."""
    g = torch.Generator().manual_seed(N)
    exact = Refinement(widths, g).double()
    with torch.no_grad():
        for parameter in exact.parameters():
            parameter.add_(0.2 * torch.randn(parameter.shape, generator=g))
    parts = [*widths[:-1], 2, widths[-1] - 2]  # the last network moves two arrays
    values = [torch.randn(N, c, generator=g, dtype=torch.float64).requires_grad_() for c in parts]
    expected = exact(values, torch.tensor(0.37, dtype=torch.float64))
    weights = [torch.randn(x.shape, generator=g) for x in expected]

    single = {name: move(p) for name, p in exact.named_parameters()}
    inputs, at_time = [move(x) for x in values], move(exact.at_time(torch.tensor(0.37, dtype=torch.float64)))
    outs = [[single[f"{kind}_out.{i}"] for i in range(len(widths))] for kind in ("weights", "biases")]
    actual = refine.refine(inputs, single["weight_in"][:, : exact.features], at_time, *outs)
    assert_same(back(actual), expected)
    wanted = torch.autograd.grad(expected, [*values, *exact.parameters()], [w.double() for w in weights])
    got = torch.autograd.grad(actual, [*inputs, at_time, single["weight_in"], *outs[0], *outs[1]],
                              [move(w) for w in weights])  # fmt: skip
    n, used = len(values), slice(None, exact.features)
    by_name = dict(zip((name for name, _ in exact.named_parameters()), wanted[n:], strict=True))
    assert_same(back([*got[:n], got[n], got[n + 1][:, used], *got[n + 2 :]]),
                [*wanted[:n], by_name["bias_in"], by_name["weight_in"][:, used],
                 *(by_name[f"weights_out.{i}"] for i in range(len(widths))),
                 *(by_name[f"biases_out.{i}"] for i in range(len(widths)))])  # fmt: skip


def test_networks_too_large_are_refused(move: Move) -> None:
    """Catches a network that would not fit the kernel's arrays, and would be read past their end."""
    one = move(torch.ones(1))
    with pytest.raises(InputError, match="at most 28 outputs"):
        refine.refine([move(torch.ones(4, 3)), move(torch.ones(4, 29))], move(torch.ones(128, 3)), one.expand(128),
                      [move(torch.ones(3, 64)), move(torch.ones(29, 64))], [one.expand(3), one.expand(29)])  # fmt: skip
