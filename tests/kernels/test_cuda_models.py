"""Slices, colours, refinement and training steps by the CUDA kernels, on a GPU or by the shim, against torch's."""

from collections.abc import Callable
from copy import deepcopy
from typing import Any

import pytest
import test_tape
import torch
from test_moving import NAMES, N, moving
from test_prefixes import SHARES, gradients, intervals_around, kept
from test_slices import (
    VARIANTS,
    assert_same,
    color_inputs,
    covariances,
    model_and_raw,
    refined_exactly,
    rotated,
    static,
    universal,
)
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels import colors, refine
from gsbench.kernels.backends import AUTO, REFERENCE, Backend
from gsbench.measure.speed import StageClock
from gsbench.models import GaussianModel, Query
from gsbench.models.appearance import sh_colors, sh_time_colors
from gsbench.models.effect_sets import EffectSets
from gsbench.models.gaussians3d import Gaussians3DModel
from gsbench.models.query import unit
from gsbench.models.refinement import Refinement
from gsbench.models.sliced import Geometry, tensors_of
from gsbench.train.step import Step

Move = Callable[[Tensor], Tensor]


@pytest.fixture
def move(cuda_device: str) -> Move:
    """Takes tensors to where the kernels run."""
    return lambda x: x.detach().to(cuda_device, torch.float32).requires_grad_(x.requires_grad)


def back(tensors: list[Tensor]) -> list[Tensor]:
    return [x.cpu() for x in tensors]


def assert_slices_agree(
    exact: GaussianModel, raw: dict[str, Tensor], move: Move, of: Callable[[Geometry], list[Tensor]] = tensors_of
) -> None:
    """The kernels' slice, and its gradients by all parameters, against those of torch in float64."""
    center, time = torch.tensor([0.3, -0.2, -3.0]), torch.tensor(0.4)
    expected = of(exact.slice_geometry(raw, Query(center.double(), time.double())))
    lambdas = list(exact.log_lambda.parameters())
    single = {name: move(x) for name, x in raw.items()}
    model = deepcopy(exact).to(single["opacities"])
    model.condition = None  # nothing is left to torch
    actual = of(model.slice_geometry(single, Query(move(center), move(time))))
    assert_same(back(actual), expected)
    inputs = [*single.values(), *model.log_lambda.parameters()]
    assert_same(back(gradients(actual, inputs)), gradients(expected, [*raw.values(), *lambdas]))


@pytest.mark.parametrize(("name", "options"), VARIANTS)
def test_slice(name: str, options: dict[str, Any], move: Move) -> None:
    """Catches a wrong row order, reflection, opacity factor or derivative of any parameter."""
    assert_slices_agree(*model_and_raw(name, options, torch.float64), move)


def test_rotated_slice(move: Move) -> None:
    """Catches a wrong sign of a quaternion's matrix, row order, opacity factor or derivative of any parameter."""
    assert_slices_agree(*rotated(torch.float64), move)


def test_static_slice(move: Move) -> None:
    """Catches a wrong sign of a rotation's entry, a size that does not stop, or a derivative."""
    raw = static(torch.float64)
    raw = {"means": torch.zeros(len(raw["opacities"]), 3, dtype=torch.float64, requires_grad=True), **raw}
    assert_slices_agree(Gaussians3DModel(), raw, move)


@pytest.mark.parametrize("name", ["ubs", "ubs_static"])
def test_universal_slice(name: str, move: Move) -> None:
    """Catches a thread that reads another row, and a kernel for Gaussians with time that is run for those without."""
    assert_slices_agree(*universal(name, torch.float64), move, covariances)


@pytest.mark.parametrize("share", SHARES)
@pytest.mark.parametrize(("name", "options"), VARIANTS)
def test_static_rows(name: str, options: dict[str, Any], share: float, move: Move) -> None:
    """Catches a static row that reads a column of time or direction, or leaves a gradient unwritten."""
    exact, raw = model_and_raw(name, options, torch.float64)
    exact.effect_sets = EffectSets(0, round(share * 37), None)
    assert_slices_agree(exact, raw, move)


@pytest.mark.parametrize("share", SHARES)
def test_static_rows_of_rotated_factors(share: float, move: Move) -> None:
    """Catches a static row that is turned otherwise than by its left quaternion, or fades."""
    exact, raw = rotated(torch.float64)
    exact.effect_sets = EffectSets(0, round(share * 45), None)
    assert_slices_agree(exact, raw, move)


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("name", NAMES)
def test_moving_slice(name: str, share: float, move: Move) -> None:
    """Catches a row of a moving or a static Gaussian that is read from another place, or whose gradient is lost."""
    exact, raw = moving(name, torch.float64)
    exact.effect_sets = EffectSets(0, round(share * N), None)
    assert_slices_agree(exact, raw, move)


@pytest.mark.parametrize("waves", [1, 3])
def test_orders(waves: int, move: Move) -> None:
    """Catches a thread that reads another row's order, and a gradient above a row's own."""
    N, g = 300, torch.Generator().manual_seed(waves)
    orders = torch.randint(0, 20, (N,), generator=g, dtype=torch.int32)
    sh0, shN, means, times = exact = color_inputs(waves, torch.float64, N)
    center = torch.tensor([0.1, 0.2, -2.0])
    used = torch.cat([sh0, shN], 1).unflatten(1, (waves, 16)) * kept(orders, waves)
    expected = sh_time_colors(used, unit(means - center.double()), 2, 0.7 - times[:, 0])
    single, count = [move(x) for x in exact], 4 if waves > 1 else 3
    timed = (single[3], move(torch.tensor(0.7))) if waves > 1 else (None, None)
    actual = colors.show_colors(*single[:3], move(torch.ones(N)), move(center), 2, *timed, waves,
                                orders.to(single[0].device))  # fmt: skip
    assert_same([actual.cpu()], [expected])
    assert_same(back(gradients([actual], single[:count])), gradients([expected], list(exact[:count])))


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
    exact, values, expected = refined_exactly(N, widths)
    single = deepcopy(exact).to(move(values[0]))
    inputs = [move(x) for x in values]
    actual = single(inputs, move(torch.tensor(0.37)), by_kernel=True)
    assert_same(back(actual), expected)
    assert_same(back(gradients(actual, [*inputs, *single.parameters()])),
                gradients(expected, [*values, *exact.parameters()]))  # fmt: skip


@pytest.mark.parametrize("rests", [False, True])
@pytest.mark.parametrize("share", SHARES)
def test_rows_that_agr_does_not_move(share: float, rests: bool, move: Move) -> None:
    """Catches a row past the prefix, or outside its visible interval, that is moved, counted in a weight's gradient, or
    not copied, forth or back."""
    g, count = torch.Generator().manual_seed(1), round(share * 300)
    exact = Refinement([3, 1, 9], g, units=0.5 + torch.rand(13, generator=g)).double()
    with torch.no_grad():
        for parameter in exact.parameters():
            parameter.add_(0.2 * torch.randn(parameter.shape, generator=g))
    values = [torch.randn(300, c, generator=g, dtype=torch.float64).requires_grad_() for c in (3, 1, 2, 7)]
    time = torch.tensor(0.37)
    awake, intervals = intervals_around(time, count) if rests else (torch.arange(count) < count, None)
    expected = exact(values, time.double(), rows=count, intervals=intervals)
    single, inputs = deepcopy(exact).to(move(values[0])), [move(x) for x in values]
    actual = single(
        inputs, move(time), by_kernel=True, rows=count, intervals=None if intervals is None else move(intervals)
    )
    assert_same(back(actual), expected)
    at_rest = torch.cat([~awake, torch.ones(300 - count, dtype=torch.bool)])
    for x, y in zip(back(actual), back(inputs), strict=True):
        assert torch.equal(x[at_rest], y[at_rest])
    assert_same(back(gradients(actual, [*inputs, *single.parameters()])),
                gradients(expected, [*values, *exact.parameters()]))  # fmt: skip


def test_networks_too_large_are_refused(move: Move) -> None:
    """Catches a network that would not fit the kernel's arrays, and would be read past their end."""
    one, units = move(torch.ones(1)), move(torch.ones(32))
    with pytest.raises(InputError, match="at most 28 outputs"):
        refine.refine([move(torch.ones(4, 3)), move(torch.ones(4, 29))], move(torch.ones(128, 3)), one.expand(128),
                      move(torch.ones(32, 64)), one.expand(32), units, move(torch.empty(0)))  # fmt: skip


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize(("name", "agr", "classed"), [("7dgs", True, False), ("4dgs", False, False),
                                                      ("7dgs", True, True), ("4dgs", True, True)])  # fmt: skip
def test_a_training_step_s_gradients_are_the_reference_s(name: str, agr: bool, classed: bool, cuda_device: str) -> None:
    """Catches what no kernel shows alone: a gradient that is lost, or taken twice, on its way from the loss through
    blending, projection, colours and slices to the parameters, or in the sum over views."""
    torch.set_num_threads(1)  # the shim runs in one

    def step(backend: Backend, device: str) -> dict[str, Tensor]:
        made = test_tape.fitted(name, agr=agr, classed=classed).to(device)
        if classed:
            made.effect_sets = made.effect_sets._replace(orders=made.effect_sets.orders.to(device))
        made.backend = backend
        background = torch.tensor([0.1, 0.5, 0.9], device=device)
        Step(made, background, 0.2, False, StageClock(device))([view.to(device) for view in test_tape.views(2)])
        return test_tape.gradients(made)

    got, want = step(AUTO, cuda_device), step(REFERENCE, "cpu")
    assert got.keys() == want.keys()
    for key, expected in want.items():
        assert expected.any(), key
        assert (got[key].cpu() - expected).norm() <= 1e-3 * expected.norm(), key
