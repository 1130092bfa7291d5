"""Kernels that leave out what a row does without: a query, AGR, or some of its harmonics."""

import math
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from test_slices import SUBTRACTING, VARIANTS, assert_same, color_inputs, model_and_raw, nan_memory, rotated
from test_tape import fitted
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from gsbench.errors import InputError
from gsbench.kernels import refine as refining
from gsbench.kernels.colors import show_colors
from gsbench.kernels.slices import slice_rotated
from gsbench.models import Query
from gsbench.models.appearance import sh_time_colors
from gsbench.models.base import GaussianModel, Raw
from gsbench.models.effect_sets import EffectSets
from gsbench.models.query import unit
from gsbench.models.refinement import Refinement
from gsbench.models.sliced import tensors_of

CENTER, TIME = torch.tensor([0.3, -0.2, -3.0]), torch.tensor(0.4)
SHARES = (0.0, 0.03, 0.5, 0.98, 1.0)  # of the rows that change: of 37 rows 0, 1, 18, 36 and all


def weights_of(outputs: list[Tensor]) -> list[Tensor]:
    g = torch.Generator().manual_seed(2)
    return [torch.randn(x.shape, generator=g).to(x) for x in outputs]


def intervals_around(time: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Which of so many rows are moved at a time, and their intervals: some begin or end with it, some never move."""
    intervals = torch.rand(count, 2, generator=torch.Generator().manual_seed(count)).sort(-1).values
    intervals[::7, 0], intervals[1::7, 1] = time, time
    intervals[2::7] = torch.tensor([math.inf, -math.inf])
    return (intervals[:, 0] <= time) & (time <= intervals[:, 1]), intervals


def gradients(outputs: list[Tensor], inputs: list[Tensor]) -> list[Tensor]:
    return list(torch.autograd.grad(outputs, inputs, weights_of(outputs), materialize_grads=True))


def assert_static_rows(exact: GaussianModel, raw: Raw, model: GaussianModel, single: Raw, share: float) -> None:
    """Slice and gradients with static rows are the reference's, and conditioned rows are as without them."""
    count = round(share * len(raw["means"]))
    query = Query(CENTER, TIME)
    everything = tensors_of(model.slice_geometry(single, query))
    exact.effect_sets = model.effect_sets = EffectSets(0, count, None)
    expected = tensors_of(exact.slice_geometry(raw, Query(CENTER.double(), TIME.double())))
    actual = tensors_of(model.slice_geometry(single, query))
    for x, y in zip(actual, everything, strict=True):
        assert torch.equal(x[:count], y[:count])
    assert count == len(actual[0]) or not torch.equal(actual[0][count:], everything[0][count:])
    want = gradients(expected, [*raw.values(), *exact.log_lambda.parameters()])
    got = gradients(actual, [*single.values(), *model.log_lambda.parameters()])
    assert_same(actual, expected)
    assert_same(got, want)
    for x, y in zip(got[: len(raw)], want, strict=False):
        assert not x[count:][y[count:] == 0].any(), "what a static row does not depend on has a gradient"


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize("share", SHARES)
@pytest.mark.parametrize(("name", "options"), VARIANTS + SUBTRACTING)
def test_static_rows_of_triangular_factors(name: str, options: dict[str, Any], share: float) -> None:
    """Catches a static row that reads a column of time or direction, skews otherwise, or writes no gradient."""
    assert_static_rows(
        *model_and_raw(name, options, torch.float64), *model_and_raw(name, options, torch.float32), share
    )


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize("share", SHARES)
def test_static_rows_of_rotated_factors(share: float) -> None:
    """Catches a static row that is turned otherwise than by its left quaternion, fades, or has a gradient by time."""
    assert_static_rows(*rotated(torch.float64), *rotated(torch.float32), share)


def test_a_static_row_has_no_other_gradient() -> None:
    """Catches a gradient by what is a static row's no more, in kernel and reference alike."""
    model, raw = model_and_raw("7dgs", {}, torch.float32)
    model.effect_sets = EffectSets(0, 10, None)
    got = dict(
        zip(raw, gradients(tensors_of(model.slice_geometry(raw, Query(CENTER, TIME))), list(raw.values())), strict=True)
    )
    for name in ("directions", "times", "motion", "coupling"):
        assert not got[name][10:].any(), name
        assert got[name][:10].any(), name
    assert not got["log_diagonal"][10:, :4].any()
    assert got["log_diagonal"][10:, 4:].any()


# ---- colours


def kept(orders: Tensor, waves: int) -> Tensor:
    """Which of 16 coefficients of each frequency a row of such an order has, [N, waves, 16, 1]."""
    degrees = torch.arange(16).sqrt().floor()
    by_wave = torch.arange(waves) <= (orders // 4)[:, None]
    return (by_wave[:, :, None] & (degrees <= (orders % 4)[:, None, None]))[..., None]


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize("waves", [1, 3])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("N", [1, 37, 1100])
def test_orders_leave_coefficients_out(N: int, degree: int, waves: int) -> None:
    """Catches a row that is sorted to another's place, a vector of two orders, and a gradient above a row's order."""
    g = torch.Generator().manual_seed(N)
    orders = torch.randint(0, 20, (N,), generator=g, dtype=torch.int32)  # some with more frequencies than there are
    drawn = torch.rand(N, generator=g) < 0.8
    center = torch.tensor([0.1, 0.2, -2.0])
    sh0, shN, means, times = exact = color_inputs(waves, torch.float64, N)
    used = torch.cat([sh0, shN], 1).unflatten(1, (waves, 16)) * kept(orders, waves)
    expected = sh_time_colors(used, unit(means - center), degree, 0.7 - times[:, 0]) * drawn[:, None]
    single = color_inputs(waves, torch.float32, N)
    timed = (single[3], torch.tensor(0.7)) if waves > 1 else (None, None)
    actual = show_colors(*single[:3], drawn.float(), center, degree, *timed, waves, orders)
    assert_same([actual], [expected])
    inputs = 4 if waves > 1 else 3
    got, want = gradients([actual], single[:inputs]), gradients([expected], exact[:inputs])
    assert_same(got, want)
    left_out = ~kept(orders, waves).expand(-1, -1, -1, 3).flatten(1, 2)
    assert not torch.cat(got[:2], 1)[left_out].any()


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 600), st.integers(0, 3), st.integers(1, 4), st.integers(0, 2**31))
def test_orders_that_leave_nothing_out_change_no_bit(N: int, degree: int, waves: int, seed: int) -> None:
    """Catches rows that are worked on in another order, or by other arithmetic, where they have orders."""
    g = torch.Generator().manual_seed(seed)
    own_degree = torch.randint(degree, 4, (N,), generator=g)
    orders = (own_degree + 4 * torch.randint(waves - 1, 9, (N,), generator=g)).int()
    drawn, inputs = (torch.rand(N, generator=g) < 0.7).float(), color_inputs(waves, torch.float32, N)
    timed = (inputs[3], torch.tensor(0.7)) if waves > 1 else (None, None)
    found = []
    for given_orders in (None, orders):
        colors = show_colors(*inputs[:3], drawn, torch.zeros(3), degree, *timed, waves, given_orders)
        found.append([colors, *gradients([colors], inputs[: 4 if waves > 1 else 3])])
    assert all(torch.equal(x, y) for x, y in zip(*found, strict=True))


# ---- AGR


@pytest.mark.usefixtures("instruction_set", "threads")
@pytest.mark.parametrize("N", [1, 127, 5000])
@pytest.mark.parametrize("share", SHARES)
@pytest.mark.parametrize("rests", [False, True])
def test_rows_that_agr_does_not_move(N: int, share: float, rests: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a row past the prefix, or outside its visible interval, that is moved, counted in a weight's gradient, or
    not copied, forth or back."""
    monkeypatch.setattr(refining, "allocate", nan_memory)
    widths, parts, count, g = [3, 1, 9], [3, 1, 2, 7], round(share * N), torch.Generator().manual_seed(N)
    exact = Refinement(widths, g, units=0.5 + torch.rand(sum(widths), generator=g)).double()
    with torch.no_grad():
        for parameter in exact.parameters():
            parameter.add_(0.2 * torch.randn(parameter.shape, generator=g))
    values = [torch.randn(N, c, generator=g, dtype=torch.float64).requires_grad_() for c in parts]
    time = torch.tensor(0.37)
    awake, intervals = intervals_around(time, count) if rests else (torch.arange(count) < count, None)
    expected = exact(values, time.double(), rows=count, intervals=intervals)
    want = gradients(expected, [*values, *exact.parameters()])
    single = Refinement(widths, g)
    single.load_state_dict(exact.state_dict())
    inputs = [x.detach().float().requires_grad_() for x in values]
    found = []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        moved = single(inputs, time, by_kernel=True, rows=count, intervals=intervals)
        found.append([*moved, *gradients(moved, [*inputs, *single.parameters()])])
    moved, got = found[0][: len(parts)], found[0][len(parts) :]
    assert_same(moved, expected)
    assert_same(got, want)
    at_rest = torch.cat([~awake, torch.ones(N - count, dtype=torch.bool)])
    for x, y, gradient, weight in zip(inputs, moved, got, weights_of(moved), strict=False):
        assert torch.equal(x[at_rest], y[at_rest])
        assert torch.equal(gradient[at_rest], weight[at_rest])
        assert (x[~at_rest] != y[~at_rest]).any(-1).all()
    assert all(torch.equal(x, y) for other in found[1:] for x, y in zip(found[0], other, strict=True))
    always = single(inputs, time, by_kernel=True)
    assert all(torch.equal(x[~at_rest], y[~at_rest]) for x, y in zip(moved, always, strict=True)), "bits of the others"


# ---- the door


def test_rows_that_there_are_not() -> None:
    """Catches a prefix longer than the arrays, which a kernel would read past their end, and orders of another kind."""
    model, raw = model_and_raw("7dgs", {}, torch.float32)
    for count in (38, -1):
        model.effect_sets = EffectSets(0, count, None)
        with pytest.raises(InputError, match="conditioned: expected a number of rows from 0 to 37"):
            model.slice_geometry(raw, Query(CENTER, TIME))
    rotating, single = rotated(torch.float32)
    with pytest.raises(InputError, match="conditioned"):
        slice_rotated(*single.values(), rotating.clock, TIME, rotating.log_lambda["time"], conditioned=46)
    with pytest.raises(InputError, match="refine: rows"):
        Refinement([3, 4], torch.Generator())([torch.ones(2, 3), torch.ones(2, 4)], TIME, by_kernel=True, rows=3)
    for intervals in (torch.ones(3, 2), torch.ones(2, 3), torch.ones(2, 2).double(), torch.empty(0)):
        with pytest.raises(InputError, match="intervals"):
            Refinement([3, 4], torch.Generator())([torch.ones(2, 3), torch.ones(2, 4)], TIME, by_kernel=True, rows=2,
                                                  intervals=intervals)  # fmt: skip
    with pytest.raises(InputError, match="intervals and time together"):
        refining.refine([torch.ones(2, 3), torch.ones(2, 4)], torch.ones(128, 3), torch.ones(128), torch.ones(7, 64),
                        torch.ones(7), torch.ones(7), torch.empty(0), intervals=torch.ones(2, 2))  # fmt: skip
    sh0, shN, means, _ = color_inputs(1, torch.float32)
    for orders in (torch.zeros(21), torch.zeros(20, dtype=torch.int32), torch.zeros(21, dtype=torch.int64)):
        with pytest.raises(InputError, match="orders"):
            show_colors(sh0, shN, means, torch.ones(21), torch.zeros(3), 3, orders=orders)


def test_any_number_is_an_order() -> None:
    """Catches an order that is read as a place in memory: nonsense may have any colour, and ends no process."""
    sh0, shN, means, _ = color_inputs(1, torch.float32)
    orders = torch.tensor([-1, -(2**31), 2**31 - 1], dtype=torch.int32).repeat(7)
    show_colors(sh0, shN, means, torch.ones(21), torch.zeros(3), 3, orders=orders).sum().backward()


class Calls(TorchDispatchMode):
    """Collects the operations of the kernels that are called, with their arguments."""

    def __init__(self) -> None:
        super().__init__()
        self.found: dict[str, tuple[Any, tuple[Any, ...]]] = {}

    def __torch_dispatch__(self, operator: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if operator.namespace == "gsbench":
            self.found[operator.name()] = operator, args
        return operator(*args, **(kwargs or {}))


@pytest.mark.parametrize("name", ["4dgs", "7dgs"])
@pytest.mark.parametrize("classed", [False, True])
def test_torch_is_told_the_truth(name: str, classed: bool) -> None:
    """Catches an operation with prefixes, intervals or orders whose fake has other shapes than it has."""
    model = fitted(name, 30, agr=True, classed=classed)
    if model.effect_sets is not None:
        model.effect_sets = model.effect_sets._replace(intervals=intervals_around(TIME, model.effect_sets.refined)[1])
    with Calls() as calls:
        model.slice(Query(CENTER, TIME))
    slicing = "slice_triangular" if name == "7dgs" else "slice_rotated"
    assert {f"gsbench::{one}" for one in ("refine", slicing, "show_colors")} <= calls.found.keys()
    for operator, arguments in calls.found.values():
        torch.library.opcheck(operator, arguments, test_utils=("test_schema", "test_faketensor"))
