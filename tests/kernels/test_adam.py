"""The kernels of Adam and of the finite check against the same in torch, and what they refuse."""

import math

import pytest
import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.adam import adam_all, flag_arrays
from gsbench.kernels.headers import MAX_ADAM
from gsbench.train.optim import BETAS, EPS, adam_reference


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("shape", [(0, 3), (1,), (700, 0, 3), (700, 1, 3), (1000, 28), (70_000, 1)])
@pytest.mark.parametrize("step", [1.0, 30_000.0])
def test_adam_updates_what_was_drawn(shape, step, place):
    """Catches a run of rows that ends wrong, a row updated twice, a wrong row of a wide parameter, rows that should
    rest, a bias correction lost to cancellation, and bits that depend on the number of threads."""
    random = torch.Generator().manual_seed(0)
    g, p, m = (torch.randn(shape, generator=random) for _ in range(3))
    v, drawn = 0.01 + torch.rand(shape, generator=random), torch.rand(shape[0], generator=random) < 0.7
    expected = p.double(), m.double(), v.double()
    adam_reference(expected[0], g.double(), *expected[1:], drawn, 0.01, BETAS, EPS, torch.tensor(step))
    updated = []
    for threads in (1, 3):
        torch.set_num_threads(threads)
        actual = [[x.clone().to(place.device)] for x in (p, g, m, v, torch.tensor(step - 1), torch.tensor(0.01), drawn)]
        adam_all(*actual[:6], BETAS, EPS, drawn=actual[6])
        assert actual[4][0] == step
        updated.append([actual[i][0].cpu() for i in (0, 2, 3)])
    for x, again, want, before in zip(*updated, expected, (p, m, v), strict=True):
        torch.testing.assert_close(x.double(), want, rtol=1e-5, atol=1e-6)
        assert torch.equal(x[~drawn], before[~drawn])
        assert torch.equal(x, again)


@pytest.mark.usefixtures("threads")
def test_all_parameters_in_one_call_are_updated_as_torch_does(place):
    """Catches a parameter that is left out or updated twice, another's rate or count of updates, a 33rd that is
    forgotten, numbers after the last whole block of a GPU, and what `skip` should have stopped."""
    random = torch.Generator().manual_seed(0)
    shapes = [(), (0, 3), (1,), (700, 1, 3), (60_000, 2), *[(i + 1,) for i in range(MAX_ADAM)]]
    rates = [0.001 * (i + 1) for i in range(len(shapes))]
    start = [torch.randn(shape, generator=random) for shape in shapes]
    gradients = [[torch.randn(shape, generator=random) for shape in shapes] for _ in range(3)]
    expected = [x.clone().requires_grad_() for x in start]
    groups = [{"params": [x], "lr": rate} for x, rate in zip(expected, rates, strict=True)]
    reference = torch.optim.Adam(groups, eps=EPS)
    for of_step in gradients:
        for x, g in zip(expected, of_step, strict=True):
            x.grad = g.clone()
        reference.step()
    updated, skip = [], torch.zeros((), device=place.device)
    for threads in (1, 3):
        torch.set_num_threads(threads)
        x = [y.to(place.device, copy=True) for y in start]
        m, v = ([torch.zeros_like(y) for y in x] for _ in range(2))
        steps, in_memory = list(skip.new_zeros(len(x))), list(skip.new_tensor(rates))
        for of_step in gradients:
            g = [y.to(place.device) for y in of_step]
            adam_all(x, g, m, v, steps, in_memory, BETAS, EPS, skip)
        updated.append([[y.cpu() for y in x], *[[y.clone() for y in z] for z in (x, m, v, steps)]])
        adam_all(x, g, m, v, steps, in_memory, BETAS, EPS, skip + 1)
        assert all(map(torch.equal, [*x, *m, *v, *steps], [y for z in updated[-1][1:] for y in z]))
    for x, again, want in zip(updated[0][0], updated[1][0], expected, strict=True):
        torch.testing.assert_close(x, want.detach(), rtol=1e-5, atol=1e-6)
        assert torch.equal(x, again)


LENGTHS = [300_000 if i == 17 else 5 for i in range(40)]


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize(
    ("array", "at", "bad"), [(0, 0, math.nan), (39, 4, math.inf), (17, 299_999, -math.inf), (17, 1023, math.nan)]
)
def test_one_bad_number_among_many_arrays_is_found(array, at, bad, place):
    """Catches a kernel call that leaves out the last arrays, the last numbers or what another thread found, a flag at
    another array, and large finite numbers whose sum is taken for infinity."""
    torch.set_num_threads(2)
    arrays: list[Tensor | None] = [torch.full((n,), 3e38, device=place.device) for n in LENGTHS]
    arrays[3:5] = [None, torch.zeros(0, 3, device=place.device)]
    skip = torch.zeros((), device=place.device)
    flags = torch.zeros(len(arrays), device=place.device)
    flag_arrays(arrays, flags, skip)
    assert not flags.any()
    assert skip == 0
    if (poisoned := arrays[array]) is not None:
        poisoned[at] = bad
    for _ in range(2):  # the second finds the same
        flag_arrays(arrays, flags, skip)
        assert flags.nonzero().tolist() == [[array]]
        assert skip == 1
    flag_arrays(arrays[:3], flags[:3].zero_(), skip)
    assert skip == 1  # it stays, whatever comes later


def test_every_array_is_flagged(place):
    """Catches a flag that hides the next one, and an array whose gradient is a view with gaps."""
    arrays = [torch.full((n,), math.nan, device=place.device) for n in (1, 2, 255, 256, 257, 1025)]
    arrays.append(torch.full((4, 3), math.inf, device=place.device).T[1:])
    arrays.append(torch.tensor([[0.0, math.nan]] * 9, device=place.device)[:, 0])  # the gaps alone are bad
    skip, flags = torch.zeros((), device=place.device), torch.zeros(len(arrays), device=place.device)
    flag_arrays(arrays, flags, skip)
    assert flags.tolist() == [1] * 7 + [0]


X, ONE = torch.zeros(4, 2), torch.ones(())


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({1: torch.zeros(4, 3)}, r"gradient: expected contiguous torch.float32 of shape \[4, 2\] on cpu, got"),
        ({1: torch.zeros(4, 2, dtype=torch.float64)}, "gradient: .* got torch.float64"),
        ({2: torch.zeros(4, 2, dtype=torch.float16)}, "mean: .* got torch.float16"),
        ({3: torch.zeros(4, 2, dtype=torch.bfloat16)}, "square: .* got torch.bfloat16"),
        ({0: torch.zeros(2, 4).T}, "parameter: expected contiguous"),
        ({4: torch.ones((), dtype=torch.int64)}, "step, rate or skip: .* got torch.int64"),
        ({5: torch.ones((), dtype=torch.float64)}, "step, rate or skip: .* got torch.float64"),
        ({6: torch.ones(3, dtype=torch.bool)}, r"drawn: expected contiguous torch.bool of shape \[4\] .* \[3\]"),
        ({6: torch.ones(4)}, "drawn: .* got torch.float32"),
        ({7: torch.zeros(1)}, r"skip: .* of shape \[\] on cpu, got torch.float32 of shape \[1\]"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(changed, message):
    """Catches a mask or an array of another size or type, and a parameter with gaps, whose address a kernel gets."""
    listed = {i: X.clone() for i in range(4)} | {4: ONE.clone(), 5: ONE.clone(), 6: None, 7: None} | changed
    *arrays, drawn, skip = listed.values()
    with pytest.raises(InputError, match=message):
        adam_all(*[[x] for x in arrays], BETAS, EPS, skip, [drawn])


@pytest.mark.parametrize(
    ("arrays", "flags", "message"),
    [
        ([X.double()], torch.zeros(1), "arrays: expected contiguous torch.float32 .* got torch.float64"),
        ([X.half()], torch.zeros(1), "arrays: .* got torch.float16"),
        ([X, X], torch.zeros(1), r"flags: .* of shape \[2\] on cpu, got torch.float32 of shape \[1\]"),
        ([X], torch.zeros(1).bool(), "flags: expected contiguous torch.float32 .* got torch.bool"),
    ],
)
def test_flags_that_do_not_fit_are_refused(arrays, flags, message):
    """Catches numbers of another type read as float32, and a flag written after the last."""
    with pytest.raises(InputError, match=message):
        flag_arrays(arrays, flags, ONE.clone())
