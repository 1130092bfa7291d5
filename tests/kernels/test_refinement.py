"""AGR by the kernels against its networks written in torch: which rows it moves, which have a gradient."""

import math
from copy import deepcopy

import pytest
import torch
from sliced_models import assert_same, gradients, weights_of
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels import refine as refining
from gsbench.kernels.operation import EVERY_ROW
from gsbench.kernels.refine import refine
from gsbench.models.refinement import Refinement

TIME = torch.tensor(0.375)


def exact_network(N: int, widths: list[int], parts: list[int]) -> tuple[Refinement, list[Tensor]]:
    """A network of AGR in float64 whose parameters are not the initial ones, and values of N Gaussians to move."""
    g = torch.Generator().manual_seed(N)
    network = Refinement(widths, g, units=0.5 + torch.rand(sum(widths), generator=g)).double()
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.2 * torch.randn(parameter.shape, generator=g))
    return network, [torch.randn(N, c, generator=g, dtype=torch.float64).requires_grad_() for c in parts]


@pytest.fixture
def nan_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Memory that shows where nothing was written."""
    monkeypatch.setattr(refining, "allocate", lambda _, like, shape: like.new_full(shape, torch.nan))


@pytest.mark.parametrize("N", [1, 127, 300, 16_421])  # on a GPU, the last are more than 512 batches
@pytest.mark.parametrize("widths", [[3, 1, 3, 28], [3, 7], [3, 3, 21]])
def test_refinement(N, widths, place):
    """Catches a block's edge that is lost, a network that reads another's weights, and any wrong gradient."""
    if N > 300 and widths != [3, 7]:
        pytest.skip("many rows are tested of one network")
    exact, values = exact_network(N, widths, [*widths[:-1], 2, widths[-1] - 2])  # the last network moves two arrays
    expected = exact(values, TIME.double())
    single, inputs = deepcopy(exact).to(place.move(values[0])), [place.move(x) for x in values]
    actual = single(inputs, place.move(TIME), by_kernel=True)
    assert_same(actual, expected)
    for a, b in zip(actual, expected, strict=True):
        assert (a.cpu() - b).norm() <= 1e-5 * b.norm(), "digits are lost"
    few = N <= 300  # of many rows one is where rounding switches a ReLU, and has another gradient
    assert_same(
        gradients(actual, [*inputs * few, *single.parameters()]),
        gradients(expected, [*values * few, *exact.parameters()]),
    )


def intervals_around(time: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Which of so many rows are moved at a time, and their intervals: some begin or end with it, some never move."""
    intervals = torch.rand(count, 2, generator=torch.Generator().manual_seed(count)).sort(-1).values
    intervals[::7, 0], intervals[1::7, 1] = time, time
    intervals[2::7] = torch.tensor([math.inf, -math.inf])
    return (intervals[:, 0] <= time) & (time <= intervals[:, 1]), intervals


@pytest.mark.usefixtures("threads", "nan_memory")
@pytest.mark.parametrize("N", [1, 127, 5000])
@pytest.mark.parametrize("share", [0.0, 0.03, 0.5, 0.98, 1.0])
@pytest.mark.parametrize("rests", [False, True])
def test_rows_that_agr_does_not_move(N, share, rests, place):
    """Catches a row past the prefix, or outside its interval, that is moved, counted in a weight's gradient or lost."""
    N = N if place.name != "cuda" else min(N, 300)
    parts, count = [3, 1, 2, 7], round(share * N)
    exact, values = exact_network(N, [3, 1, 9], parts)
    awake, intervals = intervals_around(TIME, count) if rests else (torch.arange(count) < count, None)
    expected = exact(values, TIME.double(), rows=count, intervals=intervals)
    want = gradients(expected, [*values, *exact.parameters()])
    single, inputs = deepcopy(exact).to(place.move(values[0])), [place.move(x) for x in values]
    time = place.move(TIME)
    moving = None if intervals is None else place.move(intervals)
    results = []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        moved = single(inputs, time, by_kernel=True, rows=count, intervals=moving)
        results.append([*moved, *gradients(moved, [*inputs, *single.parameters()])])
    moved, got = results[0][: len(parts)], results[0][len(parts) :]
    assert_same(moved, expected)
    assert_same(got, want)
    at_rest = torch.cat([~awake, torch.ones(N - count, dtype=torch.bool)])
    for x, y, gradient, weight in zip(inputs, moved, got, weights_of(moved), strict=False):
        assert torch.equal(x[at_rest], y[at_rest])
        assert torch.equal(gradient[at_rest], weight[at_rest])
        assert (x[~at_rest] != y[~at_rest]).any(-1).all()
    assert all(torch.equal(x, y) for other in results[1:] for x, y in zip(results[0], other, strict=True))
    always = single(inputs, time, by_kernel=True)
    assert all(torch.equal(x[~at_rest], y[~at_rest]) for x, y in zip(moved, always, strict=True)), "bits of the others"


@pytest.mark.parametrize("share", [0.0, 0.6, 1.0])
def test_several_views_in_one_call(share, cuda_device):
    """Catches a view that sees the time of another, and gradients that are not the sum over views."""
    exact, values = exact_network(300, [3, 1, 9], [3, 1, 2, 7])
    network, times = exact.to(cuda_device, torch.float32), torch.tensor([0.375, 0.5, 0.1], device=cuda_device)
    values = [x.detach().to(times).requires_grad_() for x in values]
    inputs, count = [*values, *network.parameters()], round(share * 300)
    options = {"by_kernel": True, "rows": count, "intervals": intervals_around(TIME, count)[1].to(cuda_device)}
    outputs = network(values, times, **options)
    weights, of_views = weights_of(outputs), []
    for i, time in enumerate(times):
        of_view = network(values, time, **options)
        assert all(torch.equal(x[i], y) for x, y in zip(outputs, of_view, strict=True))
        of_views.append(torch.autograd.grad(of_view, inputs, [weight[i] for weight in weights]))
    for x, got, *parts in zip(inputs, torch.autograd.grad(outputs, inputs, weights), *of_views, strict=True):
        want = parts[0] + parts[1] + parts[2]
        if any(x is value for value in values):
            assert torch.equal(got, want)
        torch.testing.assert_close(got, want, rtol=1e-4, atol=1e-5 * float(want.abs().max()))  # blocks add up all views


def backward_of_refinement(values: list[Tensor], weights: list[Tensor], g_out: list[Tensor]) -> list[Tensor]:
    """By the kernel: gradients of the two features, then of the weights."""
    tensors = [*values, *weights, torch.ones(16), *[torch.empty(0)] * 3]  # units, no encoded time, no intervals
    outputs, slots = refining._refine.run(tensors, (EVERY_ROW,))
    every = refining._refine.backward(tensors, slots, outputs, g_out, [True] * len(tensors), {})
    known = [g for g in every if g is not None]
    return [*known[:2], *known[4:]]


@pytest.mark.usefixtures("instruction_set", "threads", "nan_memory")
@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("N", [0, 1, 127, 128, 129, 5000])
def test_refinement_of_what_has_no_gradient(N, share):
    """Catches gradients in the wrong row, or not written, as those that have one are packed, or a row that counts as
    one without though one of its numbers is not zero; and sums that depend on the number of threads."""
    g = torch.Generator().manual_seed(N)
    values = [torch.randn(N, c, generator=g) for c in (3, 1, 5, 7)]
    weights = [torch.randn(shape, generator=g) for shape in [(192, 4), (192,), (16, 64), (16,)]]
    drawn = torch.rand(N, generator=g) >= share
    g_out = [torch.randn(x.shape, generator=g) * drawn[:, None] for x in values]
    for i, x in enumerate(g_out):  # every fourth has a gradient in one array only, and there in its last number only
        x[::4, :-1] = 0
        x[::4, -1] *= torch.arange(len(x[::4])) % len(g_out) == i

    exact = [x.double().requires_grad_() for x in (*values[:2], *weights)]
    hidden = torch.relu(torch.cat(exact[:2], -1) @ exact[2].T + exact[3]).split(64, -1)
    layers = zip(hidden, exact[4].split([3, 1, 12]), exact[5].split([3, 1, 12]), strict=True)
    moved = torch.cat(exact[:2], -1), torch.cat([h @ w.T + b for h, w, b in layers], -1)
    both = torch.cat([x.double() for x in g_out], -1)
    expected = list(torch.autograd.grad(moved, exact, (both[:, :4], both)))
    results = []
    for number in (1, 2, 3):
        torch.set_num_threads(number)
        results.append(backward_of_refinement(values, weights, g_out))
    assert_same(results[0], expected)
    assert all(torch.equal(x, y) for other in results[1:] for x, y in zip(results[0], other, strict=True))


def test_arrays_that_do_not_fit_are_refused(place):
    """Catches arrays that a kernel would read past their end, and a network that would not fit its own."""
    single = place.move(torch.ones(1))

    def ones(*shape: int) -> Tensor:
        return single.expand(shape).contiguous()

    values, ten = [ones(4, 3), ones(4, 7)], (ones(10), single[:0])
    with pytest.raises(InputError, match="refine: expected"):
        refine([ones(4, 3)], ones(64, 3), ones(64), ones(3, 64), ones(3), *ten)
    for features, columns in ((values, 2), (values[::-1], 3)):
        with pytest.raises(InputError, match="refine: expected weight_in of shape"):
            refine(features, ones(128, columns), ones(128), ones(10, 64), ones(10), *ten)
    for rows in (0, 64, 127, 192):
        with pytest.raises(InputError, match="64 rows of weight_in for each feature"):
            refine(values, ones(rows, 3), ones(rows), ones(10, 64), ones(10), *ten)
    with pytest.raises(InputError, match="intervals and time together"):
        refine(values, ones(128, 3), ones(128), ones(10, 64), ones(10), *ten, intervals=ones(4, 2))
    several, timed = single.new_empty(2, 0), {"time": single[0], "intervals": ones(4, 2)}
    with pytest.raises(InputError, match="refine: expected"):
        refine(values, ones(128, 3), ones(128), ones(10, 64), ones(10), ten[0], several, **timed)
    if place.name != "cuda":
        with pytest.raises(InputError, match="refine: expected one view on cpu, got 2 in one call"):
            refine(values, ones(128, 3), ones(128), ones(10, 64), ones(10), ten[0], several)
    if place.name == "cuda":
        with pytest.raises(InputError, match="at most 28 outputs"):
            refine([ones(4, 3), ones(4, 29)], ones(128, 3), ones(128), ones(32, 64), ones(32), ones(32), single[:0])
    network, pair = Refinement([3, 4], torch.Generator()).to(single), [ones(2, 3), ones(2, 4)]
    with pytest.raises(InputError, match="refine: rows"):
        network(pair, single[0], by_kernel=True, rows=3)
    for intervals in (ones(3, 2), ones(2, 3), ones(2, 2).double(), single[:0]):
        with pytest.raises(InputError, match="intervals"):
            network(pair, single[0], by_kernel=True, rows=2, intervals=intervals)
