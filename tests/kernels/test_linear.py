"""A layer of a network against torch's, with rows that have no gradient and with NaN."""

import math

import pytest
import torch
from torch import Tensor

from gsbench.kernels.linear import linear

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


def test_nan_stays() -> None:
    """Catches a ReLU that makes NaN 0, so that a training goes on which should end."""
    x, weight, bias = layer(20, 8, 4)
    x.data[3, 5] = math.nan
    assert linear(x, weight, bias, True)[0].isnan().all(1).nonzero().tolist() == [[3]]
