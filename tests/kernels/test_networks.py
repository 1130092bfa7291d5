"""A layer of a network, and a network of heads, against torch's, with rows that have no gradient and with NaN."""

import math

import pytest
import torch
from torch import Tensor

from gsbench.kernels.fields import heads, linear
from gsbench.models.hexplane import Network

LAYERS = pytest.mark.parametrize(
    ("rows", "inputs", "outputs", "relu"), [(300, 349, 256, True), (37, 13, 30, False), (1, 93, 10, True)]
)


def layer(rows: int, inputs: int, outputs: int) -> list[Tensor]:
    g = torch.Generator().manual_seed(0)
    shapes = (rows, inputs), (outputs, inputs), (outputs,)
    x, weight, bias = (torch.randn(shape, generator=g) for shape in shapes)
    return [x.requires_grad_(), (weight / math.sqrt(inputs)).requires_grad_(), bias.requires_grad_()]


@LAYERS
def test_a_layer_and_its_gradients_are_torch_s(rows: int, inputs: int, outputs: int, relu: bool) -> None:
    """Catches a row, column or product that a tile of the matrices leaves out or takes twice, and a ReLU that does not
    stop a gradient."""
    tensors = layer(rows, inputs, outputs)
    upstream = torch.randn(rows, outputs, generator=torch.Generator().manual_seed(1))
    (y,) = linear(*tensors, relu)
    expected = torch.nn.functional.linear(*tensors)
    expected = expected.relu() if relu else expected
    torch.testing.assert_close(y, expected, rtol=1e-5, atol=1e-5)
    by_torch = torch.autograd.grad(expected, tensors, upstream)
    torch.testing.assert_close(torch.autograd.grad(y, tensors, upstream), by_torch, rtol=1e-4, atol=1e-4)


def test_rows_without_a_gradient_change_nothing() -> None:
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


def gradients(network: Network, x: Tensor, upstream: Tensor) -> list[Tensor]:
    """The outputs, and the gradients of the inputs and of all weights."""
    x = x.clone().requires_grad_()
    y = network(x)
    return [y.detach(), *torch.autograd.grad(y, [x, *network.parameters()], upstream)]


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize(
    ("rows", "inputs", "width", "outputs"), [(700, 64, 64, [3, 3, 4]), (150, 21, 13, [3, 1, 40, 4]), (1, 5, 33, [2])]
)
def test_heads_and_their_gradients_are_torch_s(rows: int, inputs: int, width: int, outputs: list[int]) -> None:
    """Catches outputs or a hidden layer of another head, a lost layer, bias or ReLU, a chunk or column that is left
    out, and rows whose gradients other rows get: some have none."""
    g = torch.Generator().manual_seed(0)
    network = Network(inputs, width, outputs, g)
    x, upstream = torch.randn(rows, inputs, generator=g), torch.randn(rows, sum(outputs), generator=g)
    upstream[2:90:3] = 0
    upstream[300:600] = 0
    computed = gradients(network, x, upstream)
    expected = gradients(network.double(), x.double(), upstream.double())
    for a, b in zip(computed, expected, strict=True):
        torch.testing.assert_close(a.double(), b, rtol=1e-4, atol=1e-4)
    assert not computed[1][(upstream == 0).all(1)].any()


def test_every_output_has_a_head() -> None:
    """Catches an output that no head writes, and memory beyond the outputs that a head reads or writes."""
    x, first, hidden, last = torch.rand(9, 4), torch.rand(5, 4), torch.rand(3, 5, 5), torch.rand(6, 5)
    biases = torch.rand(5), torch.rand(3, 5), torch.rand(6)
    tensors = x, first, biases[0], hidden, biases[1], last, biases[2]
    for ends, same in (([2, 1, 0], [2, 2, 6]), ([-1, 4, 9], [0, 4, 6]), ([7, 7, 7], [6, 6, 6])):
        y, expected = (heads(*tensors, torch.tensor(numbers, dtype=torch.int32))[0] for numbers in (ends, same))
        assert torch.equal(y, expected)
        assert y.isfinite().all()


def test_nan_stays() -> None:
    """Catches a ReLU that makes NaN 0, so that a training goes on which should end."""
    x, weight, bias = layer(20, 8, 4)
    x.data[3, 5] = math.nan
    assert linear(x, weight, bias, True)[0].isnan().all(1).nonzero().tolist() == [[3]]
    assert Network(8, 6, [3, 2], torch.Generator())(x).isnan().all(1).nonzero().tolist() == [[3]]
