"""A layer of a network, and the network of a field, against torch's, with rows without a gradient and with NaN."""

import math

import pytest
import torch
from torch import Tensor

from gsbench.kernels.fields import field, linear
from gsbench.models.hexplane import HexPlaneModel, Network, Planes

LAYERS = pytest.mark.parametrize(
    ("rows", "inputs", "outputs", "relu"), [(300, 349, 256, True), (37, 13, 30, False), (1, 93, 10, True)]
)


def layer(rows: int, inputs: int, outputs: int) -> list[Tensor]:
    g = torch.Generator().manual_seed(0)
    shapes = (rows, inputs), (outputs, inputs), (outputs,)
    x, weight, bias = (torch.randn(shape, generator=g) for shape in shapes)
    return [x.requires_grad_(), (weight / math.sqrt(inputs)).requires_grad_(), bias.requires_grad_()]


@LAYERS
def test_a_layer_and_its_gradients_are_torch_s(rows, inputs, outputs, relu):
    """Catches a row, column or product that a tile leaves out or takes twice, and a ReLU that stops no gradient."""
    tensors = layer(rows, inputs, outputs)
    upstream = torch.randn(rows, outputs, generator=torch.Generator().manual_seed(1))
    (y,) = linear(*tensors, relu)
    expected = torch.nn.functional.linear(*tensors)
    expected = expected.relu() if relu else expected
    torch.testing.assert_close(y, expected, rtol=1e-5, atol=1e-5)
    by_torch = torch.autograd.grad(expected, tensors, upstream)
    torch.testing.assert_close(torch.autograd.grad(y, tensors, upstream), by_torch, rtol=1e-4, atol=1e-4)


def test_rows_without_a_gradient_change_nothing():
    """Catches rows that the backward pass leaves out though they have a gradient, or whose gradients another row gets:
    the bits are those of a layer that has no such rows."""
    x, weight, bias = layer(700, 40, 50)
    upstream = torch.randn(700, 50, generator=torch.Generator().manual_seed(1))
    upstream[torch.rand(700, generator=torch.Generator().manual_seed(2)) < 0.6] = 0
    rows = upstream.any(1)
    g_x, *g_layer = torch.autograd.grad(linear(x, weight, bias, True)[0], (x, weight, bias), upstream)
    few = x[rows].detach().requires_grad_()
    expected = torch.autograd.grad(linear(few, weight, bias, True)[0], (few, weight, bias), upstream[rows])
    assert not g_x[~rows].any()
    for gradient, same in zip((g_x[rows], *g_layer), expected, strict=True):
        assert torch.equal(gradient, same)


def field_of(channels: int, levels: int, width: int, outputs: list[int]) -> HexPlaneModel:
    """A field of random nodes and weights whose box is [-1, 1]^3."""
    g = torch.Generator().manual_seed(0)
    model = HexPlaneModel(channels=channels, levels=levels, resolution=5, time_resolution=6)
    corners = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
    model.planes = Planes(corners, model.nodes, levels, channels, g)
    model.network = Network(levels * channels, width, outputs, g)
    for nodes in model.planes.parameters():
        nodes.data.uniform_(0.5, 1.5, generator=g)
    return model


def gradients(model: HexPlaneModel, positions: Tensor, time: float, upstream: Tensor) -> list[Tensor]:
    """The outputs of a field, and the gradients of the positions and of all nodes and weights."""
    positions = positions.clone().requires_grad_()
    y = torch.cat(model.changes(positions, positions.new_tensor(time)), -1)
    return [y.detach(), *torch.autograd.grad(y, [positions, *model.parameters()], upstream)]


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize("time", [0.0, 0.37, 1.0, 1.5])
@pytest.mark.parametrize(
    ("rows", "channels", "levels", "width", "outputs"),
    [(700, 32, 2, 64, [3, 3, 4]), (150, 7, 3, 13, [3, 1, 40, 4]), (1, 20, 1, 33, [2])],
)
def test_a_field_and_its_gradients_are_torch_s(rows, channels, levels, width, outputs, time):
    """Catches a wrong line, share or level, channels beyond the last, outputs or a hidden layer of another head, a lost
    layer, bias or ReLU, a chunk or column that is left out, and rows whose gradients other rows get: some have none."""
    g = torch.Generator().manual_seed(0)
    positions, upstream = torch.randn(rows, 3, generator=g), torch.randn(rows, sum(outputs), generator=g)
    upstream[2:90:3] = 0
    upstream[300:600] = 0
    model = field_of(channels, levels, width, outputs)
    computed = gradients(model, positions, time, upstream)
    expected = gradients(model.double(), positions.double(), time, upstream.double())
    for a, b in zip(computed, expected, strict=True):
        torch.testing.assert_close(a.double(), b, rtol=1e-4, atol=1e-4)
    assert not computed[1][(upstream == 0).all(1)].any()


def test_every_output_has_a_head():
    """Catches an output that no head writes, and memory beyond the outputs that a head reads or writes."""
    of_planes = torch.rand(9, 4), torch.rand(9, 3), *torch.rand(2, 3), torch.rand(()), torch.rand(12, 4)
    layers = torch.rand(5, 4), torch.rand(5), torch.rand(3, 5, 5), torch.rand(3, 5), torch.rand(6, 5), torch.rand(6)
    for ends, same in (([2, 1, 0], [2, 2, 6]), ([-1, 4, 9], [0, 4, 6]), ([7, 7, 7], [6, 6, 6])):
        y, expected = (
            field(*of_planes, *layers, torch.tensor(numbers, dtype=torch.int32), 4, 1, 2, 2, 2, 2)[0]
            for numbers in (ends, same)
        )
        assert torch.equal(y, expected)
        assert y.isfinite().all()


def test_nan_stays():
    """Catches a ReLU that makes NaN 0, so that a training goes on which should end."""
    x, weight, bias = layer(20, 8, 4)
    x.data[3, 5] = math.nan
    assert linear(x, weight, bias, True)[0].isnan().all(1).nonzero().tolist() == [[3]]
    model = field_of(4, 2, 6, [3, 2])
    model.network.first.bias.data[1] = math.nan
    assert torch.cat(model.changes(torch.zeros(2, 3), torch.tensor(0.5)), -1).isnan().all()
