"""Colours by the kernels against the harmonics and waves written in torch, and which rows and orders have none."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from sliced_models import assert_same, gradients
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.colors import show_colors
from gsbench.models.appearance import sh_colors, sh_time_colors
from gsbench.models.camera_time import unit

CENTER, TIME = torch.tensor([0.1, 0.2, -2.0]), torch.tensor(0.7)


def color_inputs(waves: int, dtype: torch.dtype, N: int = 21) -> list[Tensor]:
    """sh0 [N, 1, 3], shN [N, 16 waves - 1, 3], means [N, 3] and, of several waves, times [N, 1]."""
    g = torch.Generator().manual_seed(3)
    shapes = [(N, 1, 3), (N, 16 * waves - 1, 3), (N, 3), (N, 1)]
    return [torch.randn(shape, generator=g).to(dtype).requires_grad_() for shape in shapes][: 4 if waves > 1 else 3]


def shown(inputs: list[Tensor], opacities: Tensor, degree: int, waves: int, orders: Tensor | None = None) -> Tensor:
    """Colours by the kernels, on the device of the inputs, [N, 3]."""
    to = inputs[0].device
    timed = {"times": inputs[3], "time": TIME.to(to)} if waves > 1 else {}
    orders = None if orders is None else orders.to(to)
    by_name = {"center": CENTER.to(to), "degree": degree, "waves": waves, "orders": orders}
    return show_colors(*inputs[:3], opacities.to(to), **by_name, **timed)[0]


def exactly(inputs: list[Tensor], degree: int, waves: int, kept: Tensor | float = 1.0) -> Tensor:
    """Colours by torch, of coefficients [N, waves, 16, 3] of which some are kept."""
    coefficients = torch.cat(inputs[:2], 1).unflatten(1, (waves, 16)) * kept
    directions = unit(inputs[2] - CENTER)
    if waves == 1:
        return sh_colors(coefficients[:, 0], directions, degree)
    return sh_time_colors(coefficients, directions, degree, TIME - inputs[3][:, 0])


def is_kept(orders: Tensor, waves: int) -> Tensor:
    """Which of 16 coefficients of each frequency a row of such an order has, [N, waves, 16, 1]."""
    degrees = torch.arange(16).sqrt().floor()
    by_wave = torch.arange(waves) <= (orders // 4)[:, None]
    return (by_wave[:, :, None] & (degrees <= (orders % 4)[:, None, None]))[..., None]


@pytest.mark.parametrize("waves", [1, 3])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_colors(degree, waves, place):
    """Catches a wrong harmonic, wave or derivative, and coefficients of degrees not yet in use that get a gradient."""
    inputs, opacities = color_inputs(waves, torch.float64), torch.ones(21)
    opacities[4] = 0.9 / 255  # not drawn: no colour, no gradient
    expected = exactly(inputs, degree, waves) * (opacities > 1 / 255)[:, None]
    single = [place.move(x) for x in inputs]
    actual = shown(single, opacities, degree, waves)
    assert_same([actual, *gradients([actual], single)], [expected, *gradients([expected], inputs)])


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize("degree", [1, 3])
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_gradients_of_views_add_up(share, degree):
    """Catches a view whose gradient, of the rows that have one, lands in other rows of what views before it left."""
    N, inputs, random = 1100, color_inputs(3, torch.float32, 1100), torch.Generator().manual_seed(1)
    views = [shown(inputs, (torch.rand(N, generator=random) < share).float(), degree, 3) for _ in range(3)]
    weights = [torch.randn(N, 3, generator=random) for _ in views]
    apart = [torch.autograd.grad(v, inputs, w, retain_graph=True) for v, w in zip(views, weights, strict=True)]
    for view, weight in zip(views, weights, strict=True):
        view.backward(weight)
    for x, *of_views in zip(inputs, *apart, strict=True):
        assert x.grad.layout == torch.strided
        assert torch.equal(x.grad, sum(of_views[1:], of_views[0]))


@pytest.mark.parametrize("waves", [1, 3])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize(("N", "share"), [(1, 1.0), (37, 0.8), (1100, 0.0), (1100, 0.3), (1100, 1.0)])
def test_orders_and_opacities_leave_colors_out(N, share, degree, waves, place):
    """Catches a row that is sorted to another's place, a vector of two orders, a gradient above a row's order; culling
    that is not exact at 1/255, and gradients in the wrong row, or not written, as the drawn are packed."""
    g = torch.Generator().manual_seed(N)
    orders = torch.randint(0, 20, (N,), generator=g, dtype=torch.int32)  # some with more frequencies than there are
    drawn, inputs = torch.rand(N, generator=g) < share, color_inputs(waves, torch.float64, N)
    expected = exactly(inputs, degree, waves, is_kept(orders, waves)) * drawn[:, None]
    single = [place.move(x) for x in inputs]
    actual = shown(single, torch.where(drawn, 1.01 / 255, 0.99 / 255), degree, waves, orders)
    got = gradients([actual], single)
    assert_same([actual, *got], [expected, *gradients([expected], inputs)])
    left_out = ~is_kept(orders, waves).expand(-1, -1, -1, 3).flatten(1, 2)
    assert not torch.cat(got[:2], 1).cpu()[left_out].any()


@pytest.mark.parametrize("waves", [1, 3])
@pytest.mark.parametrize(("gaussian_per_view", "time_per_view"), [(False, False), (True, False), (True, True)])
def test_several_views_in_one_call(gaussian_per_view, time_per_view, waves, cuda_device):
    """Catches a view that reads the camera, time or Gaussians of another, and gradients that are not their sum."""
    random, names = torch.Generator().manual_seed(2), ("sh0", "shN", "means", "times")
    inputs = dict(zip(names, color_inputs(waves, torch.float32), strict=False))
    per_view = {"means": gaussian_per_view, "opacities": gaussian_per_view, "times": time_per_view}
    inputs["opacities"] = (torch.rand(21, generator=random) < 0.7).float()
    of_views = {"center": CENTER + torch.rand(3, 3, generator=random)}
    of_views |= {"time": torch.rand(3, generator=random)} if waves > 1 else {}
    many = {key: torch.stack([x, x.roll(1, 0), 0.9 * x]) if per_view.get(key) else x for key, x in inputs.items()}
    many = {key: x.detach().to(cuda_device).requires_grad_(key != "opacities") for key, x in many.items()}
    of_views = {key: x.to(cuda_device) for key, x in of_views.items()}
    orders, weight = torch.randint(0, 12, (21,), generator=random).int().to(cuda_device), torch.randn(3, 21, 3)

    def shown(inputs: dict[str, Tensor], of_view: dict[str, Tensor], weight: Tensor) -> tuple[Tensor, list[Tensor]]:
        (colors,) = show_colors(**inputs, **of_view, orders=orders, degree=3, waves=waves)
        return colors, list(torch.autograd.grad(colors, [inputs[key] for key in inputs if key != "opacities"], weight))

    colors, gradients = shown(many, of_views, weight.to(cuda_device))
    single = []
    for i in range(3):
        of_view = {key: x[i] if per_view.get(key) else x for key, x in many.items()}
        single.append(shown(of_view, {key: x[i] for key, x in of_views.items()}, weight[i].to(cuda_device)))
    assert torch.equal(colors, torch.stack([x for x, _ in single]))
    for key, gradient, *parts in zip(names, gradients, *[of_single for _, of_single in single], strict=False):
        want = torch.stack(parts) if per_view.get(key) else parts[0] + parts[1] + parts[2]
        assert torch.equal(gradient, want), key


def test_views_that_do_not_fit_are_refused(place):
    """Catches centres and times that are read past their end, and views that the CPU's kernel would leave out."""
    sh0, shN, means, times = [place.move(x) for x in color_inputs(2, torch.float32)]
    centers, time, opacities = place.move(torch.rand(4, 3)), place.move(torch.tensor(0.5)), place.move(torch.ones(21))
    several = means.expand(4, 21, 3), opacities.expand(4, 21)
    for gaussians, center, at in (
        ((means, opacities), centers, time),
        ((means, opacities), centers[0], time[None]),
        ((several[0], opacities), centers, time.expand(4)),
        (several, centers[0], time),
        (several, centers[:3], time.expand(3)),
    ):
        with pytest.raises(InputError, match="show_colors: expected"):
            show_colors(sh0, shN, *gaussians, times, center, at, degree=0, waves=2)
    if place.name != "cuda":
        with pytest.raises(InputError, match="show_colors: expected one view on cpu, got 4 in one call"):
            show_colors(sh0, shN, *several, times, centers, time.expand(4), degree=0, waves=2)


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 600), st.integers(0, 3), st.integers(1, 4), st.integers(0, 2**31))
def test_orders_that_leave_nothing_out_change_no_bit(N, degree, waves, seed):
    """Catches rows that are worked on in another order, or by other arithmetic, where they have orders."""
    g = torch.Generator().manual_seed(seed)
    highest = torch.randint(degree, 4, (N,), generator=g)
    orders = (highest + 4 * torch.randint(waves - 1, 9, (N,), generator=g)).int()
    drawn, inputs = (torch.rand(N, generator=g) < 0.7).float(), color_inputs(waves, torch.float32, N)
    results = []
    for rows in (None, orders):
        colors = shown(inputs, drawn, degree, waves, rows)
        results.append([colors, *gradients([colors], inputs)])
    assert all(torch.equal(x, y) for x, y in zip(*results, strict=True))


def test_any_number_is_an_order():
    """Catches an order that is read as a place in memory: nonsense may have any colour, and ends no process."""
    orders = torch.tensor([-1, -(2**31), 2**31 - 1], dtype=torch.int32).repeat(7)
    shown(color_inputs(1, torch.float32), torch.ones(21), 3, 1, orders).sum().backward()


def test_coefficients_and_orders_that_do_not_fit_are_refused():
    """Catches coefficients that are no whole degrees of every wave, and orders of another kind or number."""
    sh0, shN, means = color_inputs(1, torch.float32)
    with pytest.raises(InputError, match="coefficients"):
        shown([sh0, shN[:, :7], means], torch.ones(21), 3, 1)
    with pytest.raises(InputError, match="waves=2 and 7 coefficients"):
        shown([sh0, shN[:, :6], means, torch.zeros(21, 1)], torch.ones(21), 0, 2)
    for times, time in ((None, None), (torch.zeros(0), torch.zeros(0)), (torch.zeros(0), TIME)):
        with pytest.raises(InputError, match="times"):
            show_colors(sh0, shN, means, torch.ones(21), times, CENTER, time, degree=0, waves=2)
    for orders in (torch.zeros(21), torch.zeros(20, dtype=torch.int32), torch.zeros(21, dtype=torch.int64)):
        with pytest.raises(InputError, match="orders"):
            shown([sh0, shN, means], torch.ones(21), 3, 1, orders)
