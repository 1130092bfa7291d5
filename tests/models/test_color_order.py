"""Orders of colour: one number for kernels and checkpoints, a degree and frequencies for everyone else."""

import math

import torch
from hypothesis import given
from hypothesis import strategies as st

from gsbench.models.appearance import MOST_PACKED, ColorOrder, at_most, coefficients_within, order_of

PACKED = st.integers(0, MOST_PACKED)


@given(PACKED)
def test_a_number_and_its_order_are_one(packed: int) -> None:
    """Catches a packing that loses an order, for ints and for tensors."""
    order = order_of(packed)
    assert 0 <= order.degree <= 3
    assert 1 <= order.waves <= 8
    assert order.packed == packed
    assert torch.equal(order_of(torch.tensor([packed])).packed, torch.tensor([packed]))


@given(st.lists(PACKED, min_size=1), PACKED)
def test_lowering_keeps_the_smaller_part_of_each(packed: list[int], limit: int) -> None:
    """Catches a comparison of the numbers themselves: degree 0 with 2 waves (4) is not above degree 3 (3)."""
    most = order_of(limit)
    lowered = [ColorOrder(min(order_of(one).degree, most.degree), min(order_of(one).waves, most.waves)).packed
               for one in packed]  # fmt: skip
    assert at_most(torch.tensor(packed), limit).tolist() == lowered


@given(PACKED)
def test_the_coefficients_within_an_order(packed: int) -> None:
    """Catches a frequency or a degree that is counted from the wrong end, against the definition one by one."""
    found = coefficients_within(torch.tensor([packed]), 3, 8)[0]
    order = order_of(packed)
    for wave in range(8):
        for k in range(16):
            assert bool(found[wave, k]) == (wave < order.waves and math.isqrt(k) <= order.degree)
