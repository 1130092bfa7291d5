"""Samples of planes in space against torch's, in float64, at nodes, at the border of the grid and beyond it."""

import math

import pytest
import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.fields import sample_planes
from gsbench.models.hexplane import Planes


def planes(channels: int, levels: int) -> Planes:
    """Planes of random features whose box is [-1, 1]^3: a position p has the coordinates -p."""
    g = torch.Generator().manual_seed(0)
    corners = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
    field = Planes(corners, (5, 4, 3, 6), levels, channels, g)
    for nodes in field.parameters():
        nodes.data.uniform_(0.5, 1.5, generator=g)
    return field


def gradients(field: Planes, positions: Tensor, upstream: Tensor) -> list[Tensor]:
    """The products of samples, in float64 by torch with time planes of 1, and the gradients of positions and nodes."""
    positions = positions.clone().requires_grad_()
    field.of_time.data.fill_(1)
    by_kernel = positions.dtype is torch.float32
    products = field.products(positions) if by_kernel else field(positions, positions.new_zeros(()))
    return [products, *torch.autograd.grad(products, [positions, field.of_space], upstream)]


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize(("channels", "levels"), [(32, 2), (3, 3), (40, 1)])
def test_samples_and_gradients_are_torch_s(channels, levels):
    """Catches a wrong corner, share, axis, level or channel, a product without one of the planes, channels beyond the
    last, and a gradient that leaves the grid: points are inside, on nodes, on the border and far outside."""
    g = torch.Generator().manual_seed(1)
    inside = torch.rand(70, 3, generator=g) * 2 - 1
    far = torch.randn(30, 3, generator=g) * 3
    nodes = torch.cartesian_prod(*[torch.tensor([-1.0, 0.5, 1.0])] * 3)
    positions = torch.cat([inside, far, nodes, torch.tensor([[math.inf, -math.inf, 0.1]])])
    upstream = torch.randn(len(positions), levels * channels, generator=g)
    upstream[5:9] = 0  # these rows are left out
    field = planes(channels, levels)
    computed = gradients(field, positions, upstream)
    expected = gradients(field.double(), positions.double(), upstream.double())
    # At a node, the derivative by a position jumps: rounding decides on which side of it a point lies.
    smooth = torch.ones(len(positions), dtype=torch.bool)
    smooth[len(inside) + len(far) :] = False
    for name, x, y in zip(("products", "positions", "space"), computed, expected, strict=True):
        rows = smooth if name == "positions" else slice(None)
        torch.testing.assert_close(x[rows].double(), y[rows], rtol=2e-5, atol=2e-5, msg=name)


def test_positions_at_the_border_have_the_gradient_of_inside_or_none():
    """Catches a derivative beyond the border, where features are constant, and a division by zero in a cell's width."""
    positions = torch.tensor([[1.0001, 0.2, 0.3], [-7.0, 0.2, 0.3], [math.nan, 0.2, 0.3]])
    _, by_position, *_ = gradients(planes(16, 1), positions, torch.ones(3, 16))
    assert not by_position[:, 0].any()
    assert by_position[:, 1:].abs().min() > 0


def test_nodes_that_do_not_fit_are_refused():
    """Catches nodes that the kernel would read past their end, and numbers of them that overflow."""
    tensors = torch.zeros(1, 3), torch.zeros(3), torch.ones(3), torch.zeros(46, 2)
    with pytest.raises(InputError, match=r"expected of_space of shape \[47, 2\], got \[46, 2\]"):
        sample_planes(*tensors, 2, 1, 5, 4, 3)
    for levels, nodes in ((0, 5), (9, 5), (1, 1), (1, 1 << 20)):
        with pytest.raises(InputError, match="expected 1 to 8 levels of 2 to 4096 nodes"):
            sample_planes(*tensors, 2, levels, nodes, 4, 3)


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize("channels", [32, 3])
def test_the_penalty_and_its_gradients_are_torch_s(channels):
    """Catches a plane, row or number that is left out or has another's weight, a difference at the border of a plane,
    and a distance from 1 whose gradient has the wrong sign, or is not zero at 1, where nodes start."""
    field, results = planes(channels, 2), []
    field.of_time.data[::3] = 1
    for of in (field, field.double()):
        penalty = of.penalty(0.3, 0.5, 0.7)
        results.append([penalty, *torch.autograd.grad(penalty, list(of.parameters()), penalty.new_tensor(100))])
    for computed, expected in zip(*results, strict=True):
        torch.testing.assert_close(computed.double(), expected, rtol=1e-5, atol=1e-5)
