"""Adam's kernels against the same update in torch, and what they refuse."""

from typing import Any

import pytest
import torch
from conftest import Place

from gsbench.errors import InputError
from gsbench.kernels.adam import adam, adam_all
from gsbench.kernels.headers import MAX_ADAM
from gsbench.train.optim import adam_reference


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("shape", [(0, 3), (1,), (700, 1, 3), (1000, 28)])
@pytest.mark.parametrize("step", [1.0, 30_000.0])
def test_adam_updates_what_was_drawn(shape: tuple[int, ...], step: float, place: Place) -> None:
    """Catches a run of rows that ends wrong, a row updated twice, a wrong row of a wide parameter, rows that should
    rest, a bias correction lost to cancellation, and bits that depend on the number of threads."""
    random = torch.Generator().manual_seed(0)
    g, p, m = (torch.randn(shape, generator=random) for _ in range(3))
    v, drawn = torch.rand(shape, generator=random), torch.rand(shape[0], generator=random) < 0.7
    expected = p.double(), m.double(), v.double()
    adam_reference(expected[0], g.double(), *expected[1:], drawn, 0.01, [0.9, 0.999], 1e-15, torch.tensor(step))
    updated = []
    for threads in (1, 3):
        torch.set_num_threads(threads)
        actual = [x.clone().to(place.device) for x in (p, g, m, v, drawn, torch.tensor(step))]
        adam(*actual[:5], 0.01, [0.9, 0.999], 1e-15, actual[5])
        updated.append([actual[i].cpu() for i in (0, 2, 3)])
    for x, again, want, before in zip(*updated, expected, (p, m, v), strict=True):
        torch.testing.assert_close(x.double(), want, rtol=1e-5, atol=1e-6)
        assert torch.equal(x[~drawn], before[~drawn])
        assert torch.equal(x, again)


@pytest.mark.usefixtures("threads", "instruction_set")
def test_all_parameters_in_one_call_are_updated_as_torch_does() -> None:
    """Catches a parameter that is left out or updated twice, another's rate or step, and a 33rd that is forgotten."""
    random = torch.Generator().manual_seed(0)
    shapes = [(), (0, 3), (1,), (700, 1, 3), (60_000, 2), *[(i + 1,) for i in range(MAX_ADAM)]]
    rates = [0.001 * (i + 1) for i in range(len(shapes))]
    start = [torch.randn(shape, generator=random) for shape in shapes]
    gradients = [[torch.randn(shape, generator=random) for shape in shapes] for _ in range(3)]
    expected = [x.clone().requires_grad_() for x in start]
    groups = [{"params": [x], "lr": rate} for x, rate in zip(expected, rates, strict=True)]
    reference = torch.optim.Adam(groups, eps=1e-15)
    for of_step in gradients:
        for x, g in zip(expected, of_step, strict=True):
            x.grad = g.clone()
        reference.step()
    updated = []
    for threads in (1, 3):
        torch.set_num_threads(threads)
        x, m, v = ([y.clone() for y in start], *([torch.zeros_like(y) for y in start] for _ in range(2)))
        for step, of_step in enumerate(gradients):
            adam_all(x, of_step, m, v, [torch.tensor(step + 1.0)] * len(x), rates, [0.9, 0.999], 1e-15)
        updated.append(x)
    for x, again, want in zip(*updated, expected, strict=True):
        torch.testing.assert_close(x, want.detach(), rtol=1e-5, atol=1e-6)
        assert torch.equal(x, again)


X = torch.zeros(4, 2)


@pytest.mark.parametrize(
    ("update", "changed", "message"),
    [
        (adam, {1: torch.zeros(4, 3)}, r"expected gradient of shape \[4, 2\] on cpu, got \[4, 3\]"),
        (adam, {4: torch.ones(3, dtype=torch.bool)}, r"expected drawn of shape \[4\]"),
        (
            adam_all,
            {1: torch.zeros(4, 3)},
            r"expected gradient as contiguous float32 of shape \[4, 2\] on the CPU, got",
        ),
        (adam_all, {2: torch.zeros(4, 2, dtype=torch.float64)}, "expected mean as contiguous float32"),
        (adam_all, {0: torch.zeros(2, 4).T}, "expected parameter as contiguous float32"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(update: Any, changed: dict[int, torch.Tensor], message: str) -> None:
    """Catches a mask or an array of another size or type, and a parameter with gaps, whose address reaches the
    kernel."""
    arguments: list[Any] = list(
        ({i: X.clone() for i in range(4)} | {4: torch.ones(4, dtype=torch.bool)} | changed).values()
    )
    if update is adam_all:
        arguments = [[x] for x in arguments[:4]]
        more: list[Any] = [[torch.ones(())], [0.1], [0.9, 0.999], 1e-15]
    else:
        more = [0.01, [0.9, 0.999], 1e-15, torch.tensor(1.0)]
    with pytest.raises(InputError, match=message):
        update(*arguments, *more)
