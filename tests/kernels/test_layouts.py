"""Tensors that are not row by row in memory: the results and gradients of the same values that are."""

from collections.abc import Callable

import pytest
import torch
from raster.cases import case
from torch import Tensor

from gsbench.kernels.headers import HIDDEN
from gsbench.kernels.refine import refine
from gsbench.kernels.slices import slice_static
from gsbench.raster import rasterize

N = 5
LAYOUTS: dict[str, Callable[[Tensor], Tensor]] = {
    "one row for all, stride 0": lambda x: x[:1].expand(x.shape),
    "one number a row, stride 0": lambda x: x[..., :1].expand(x.shape),
    "every second row": lambda x: x.repeat_interleave(2, 0)[::2],
    "transposed": lambda x: x.transpose(0, -1).contiguous().transpose(0, -1),
}


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("name", ["means", "factors", "opacities", "colors", "background", "beta_exponents"])
def test_gradient_of_a_leaf_of_any_layout(name: str, layout: str) -> None:
    """Catches memory read as it does not lie, a gradient that is added up in the memory that the rows of a leaf share,
    or one that is written in another order."""
    arguments = case("tall", torch.float32) | {"background": torch.tensor([0.1, 0.5, 0.9])}
    if name == "beta_exponents":
        arguments["beta_exponents"] = torch.linspace(0.5, 4.0, len(arguments["means"]))
    leaf = LAYOUTS[layout](arguments[name])
    images, gradients = [], []
    for backend, x in (("cpu", leaf.detach()), ("reference", leaf.detach().double().contiguous())):
        others = {k: v.to(x.dtype) if isinstance(v, Tensor) else v for k, v in arguments.items()}
        image = rasterize(**others | {name: x.requires_grad_(), "backend": backend}).image
        image.square().sum().backward()
        assert x.grad is not None
        images.append(image.double())
        gradients.append(x.grad.double())
    torch.testing.assert_close(*images, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(*gradients, rtol=1e-3, atol=1e-3)


def test_a_negated_view_is_negated() -> None:
    """Catches memory read as it lies where torch has only noted that its sign is another, as of an imaginary part."""
    scales, quats, opacities = torch.rand(N, 3), torch.rand(N, 4), torch.rand(N)
    negated = torch._neg_view(-scales)
    assert negated.is_contiguous()
    for x, y in zip(slice_static(negated, quats, opacities), slice_static(scales, quats, opacities), strict=True):
        assert torch.equal(x, y)


def test_transposed_weights_of_agr() -> None:
    """Catches weights whose columns are taken for rows: results were wrong by a tenth, in silence."""
    g = torch.Generator().manual_seed(0)
    shapes = [(2 * HIDDEN, 5), (2 * HIDDEN,), (10, HIDDEN), (10,)]
    plain = [torch.rand(*shape, generator=g) for shape in shapes]
    values = [torch.rand(N, 3, generator=g), torch.rand(N, 7, generator=g)]

    def run(weights: list[Tensor]) -> tuple[list[Tensor], list[Tensor]]:
        weights = [x.detach().requires_grad_() for x in weights]
        moved = refine(values, *weights, torch.ones(10), torch.zeros(2))
        sum(x.square().sum() for x in moved).backward()
        return moved, [x.grad for x in weights if x.grad is not None]

    for got, expected in zip(run([LAYOUTS["transposed"](x) for x in plain]), run(plain), strict=True):
        for x, y in zip(got, expected, strict=True):
            torch.testing.assert_close(x, y)
