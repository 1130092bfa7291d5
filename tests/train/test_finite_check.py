"""What the finite check makes of losses and gradients; a step found to be bad only later is not applied meanwhile."""

import math

import pytest
import torch
from torch import nn

from gsbench.kernels.finite import are_finite
from gsbench.train.divergence import DivergedError, FiniteCheck


def parameter(gradient: list[float]) -> nn.Parameter:
    p = nn.Parameter(torch.zeros(len(gradient)))
    p.grad = torch.tensor(gradient)
    return p


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_the_parameter_is_named_at_its_step(bad: float) -> None:
    """Catches a bad gradient that reaches its parameter, or is blamed on another parameter or step."""
    groups = {"means": [parameter([1.0, 2.0])], "refinement": [parameter([1.0]), parameter([0.0, bad])]}
    seen = FiniteCheck("cpu")
    with pytest.raises(DivergedError, match=r"step 3: the gradient of 'refinement' is not finite \(loss 0.5\)"):
        seen.check(3, torch.tensor(0.5), groups)
    with pytest.raises(DivergedError, match="step 4: the loss is nan"):
        FiniteCheck("cpu").check(4, torch.tensor(math.nan), {"means": [parameter([1.0])]})


def test_finite_values_whose_sum_is_not_are_let_through() -> None:
    """Catches a check of the sum alone, and a parameter without a gradient taken for a fault."""
    unused = nn.Parameter(torch.zeros(1))
    seen = FiniteCheck("cpu")
    seen.check(0, torch.tensor(0.25), {"means": [parameter([3e38, 3e38])], "unused": [unused]})
    assert seen.loss == 0.25


def test_a_bad_step_found_later_changes_nothing_meanwhile() -> None:
    """Catches a GPU's training, looked at now and then, that applies a bad gradient, or a good one after it."""
    seen = FiniteCheck("cpu")
    seen.every = 4
    fitted = nn.Parameter(torch.zeros(3))
    adam = torch.optim.Adam([fitted], lr=0.1, fused=True)
    adam.found_inf = seen.skip  # type: ignore[attr-defined]
    before = []

    def train() -> None:
        for step in range(1, 20):
            fitted.grad = torch.full((3,), math.nan if step == 6 else 1.0)
            before.append(fitted.detach().clone())
            seen.check(step, torch.tensor(float(step)), {"means": [fitted]})
            adam.step()

    with pytest.raises(DivergedError, match=r"step 6: the gradient of 'means' is not finite \(loss 6.0\)"):
        train()
    assert len(before) == 8  # steps 1 to 8, the second to be looked at
    assert not torch.equal(before[4], before[5])  # step 5 was applied ..
    assert torch.equal(before[5], before[6])  # .. step 6 was not ..
    assert torch.equal(before[6], before[7])  # .. nor was step 7
    assert fitted.isfinite().all()


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize(("array", "place"), [(0, 0), (39, 4), (17, 299_999)])
def test_one_bad_number_among_many_arrays_is_found(array: int, place: int) -> None:
    """Catches a kernel call that leaves out the last arrays, the last numbers, or what another thread found."""
    torch.set_num_threads(2)
    arrays = [torch.full((300_000,) if i == 17 else (5,), 3e38) for i in range(40)]
    assert are_finite([*arrays, torch.zeros(0)])
    arrays[array][place] = math.nan
    assert not are_finite(arrays)
