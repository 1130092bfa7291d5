"""Factors, colours, AGR's networks and directions, each against its definition."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from gsbench.models.appearance import (
    MOST_PACKED,
    ColorOrder,
    at_most,
    coefficients_within,
    order_of,
    sh_basis,
    sh_colors,
    sh_time_colors,
)
from gsbench.models.camera_time import unit
from gsbench.models.factors import OFF_DIAGONALS, CholeskyLayout, rotation
from gsbench.models.refinement import Refinement, encode_time

PROPERTY = settings(max_examples=25, deadline=None)
seeds = st.integers(0, 2**31)


def normal(seed: int, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def directions(seed: int, N: int) -> Tensor:
    return nn.functional.normalize(normal(seed, N, 3), dim=-1)


def test_triangular_row_scaled():
    """Catches another scaling than (2 sigmoid(x) - 1) times the diagonal of the entry's own row."""
    layout = CholeskyLayout("ddd", "row_scaled")
    L = layout.factor(torch.tensor([[0.0, 1.0, 2.0]]), layout.split(torch.tensor([[5.0, -6.0, 0.0]])))
    expected = [(2 / (1 + math.exp(-5.0)) - 1) * math.e, (2 / (1 + math.exp(6.0)) - 1) * math.e**2, 0.0]
    torch.testing.assert_close(L[0, [1, 2, 2], [0, 0, 1]], torch.tensor(expected))


@PROPERTY
@given(seeds, st.sampled_from(["ppp", "dddppp", "dddtppp", "ptd", "pppddd", "ppptddd"]), st.sampled_from(OFF_DIAGONALS))
def test_parameters_undo_a_factor(seed, letters, form):
    """Catches a factor that changes when a split writes it back: parameters -> L -> L Q -> parameters."""
    layout, n = CholeskyLayout(letters, form), len(letters)
    parameters = {"log_diagonal": normal(seed, 4, n), **layout.split(normal(seed + 1, 4, n * (n - 1) // 2))}
    L = layout.factor(parameters["log_diagonal"], parameters)
    Q = torch.linalg.qr(normal(seed + 2, 4, n, n))[0]
    torch.testing.assert_close(layout.parameters(L @ Q), parameters, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(
    ("letters", "expected"),
    [
        (
            "dddtppp",
            {"shape": "54 64 65", "motion": "40 41 42 43 50 51 52 53 60 61 62 63", "coupling": "10 20 21 30 31 32"},
        ),
        (
            "ppptddd",
            {"shape": "10 20 21", "motion": "30 31 32 40 41 42 50 51 52 60 61 62", "coupling": "43 53 54 63 64 65"},
        ),
    ],
)
def test_kinds_of_entries(letters, expected):
    """Catches an entry of L_pp among the motions, or of L_td among the shapes: each has its unit and its rate."""
    layout, n = CholeskyLayout(letters, "raw"), len(letters)
    names = torch.tensor([10 * i + j for i in range(n) for j in range(i)])[None]
    assert {kind: " ".join(map(str, x[0].tolist())) for kind, x in layout.split(names).items()} == expected


def test_row_scaled_cuts_what_it_cannot_reach():
    """Catches atanh of 1 or more, which is not finite: such entries become 99.9 % of their diagonal."""
    factor = torch.tensor([[[1.0, 0, 0], [4.0, 2.0, 0], [-9.0, 0, 3.0]]])
    layout = CholeskyLayout("ddd", "row_scaled")
    parameters = layout.parameters(factor)
    L = layout.factor(parameters["log_diagonal"], parameters)
    torch.testing.assert_close(L[0], torch.tensor([[1.0, 0, 0], [1.998, 2.0, 0], [-2.997, 0, 3.0]]))


@PROPERTY
@given(seeds)
def test_rotation(seed):
    """Catches a transpose or another order of components than wxyz, and lengths that matter."""
    q = normal(seed, 5, 4)
    expected = Rotation.from_quat(q.numpy(), scalar_first=True).as_matrix()
    np.testing.assert_allclose(rotation(q).numpy(), expected, atol=1e-12)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_colors(degree):
    """Catches coefficients above the degree in use that still show, a lost +0.5 and a clamp at another value."""
    coefficients, d = normal(1, 20, 16, 3), directions(2, 20)
    n = (degree + 1) ** 2
    expected = np.maximum(0, np.einsum("nk,nkc->nc", sh_basis(d, 3).numpy()[:, :n], coefficients.numpy()[:, :n]) + 0.5)
    np.testing.assert_allclose(sh_colors(coefficients, d, degree).numpy(), expected, atol=1e-12)
    assert (expected == 0).any()


def test_orders_leave_out_what_is_above_them():
    """Catches a row that loses the highest degree or wave of its own order, or keeps one above: degree + 4 waves."""
    coefficients, d, offset = normal(6, 12, 3, 16, 3), directions(7, 12), normal(8, 12)
    orders = torch.tensor([degree + 4 * waves for degree in range(4) for waves in range(3)], dtype=torch.int32)
    degrees = torch.tensor([degree for degree in range(4) for _ in range(2 * degree + 1)])
    within = (degrees <= orders[:, None] % 4)[:, None] & (torch.arange(3) <= orders[:, None] // 4)[..., None]
    cut = torch.where(within[..., None], coefficients, 0.0)
    torch.testing.assert_close(sh_time_colors(coefficients, d, 3, offset, orders), sh_time_colors(cut, d, 3, offset))
    torch.testing.assert_close(sh_colors(coefficients[:, 0], d, 3, orders), sh_colors(cut[:, 0], d, 3))


PACKED = st.integers(0, MOST_PACKED)


@PROPERTY
@given(PACKED, st.lists(PACKED, min_size=1))
def test_an_order_is_one_number(packed, others):
    """Catches a packing that loses an order, for ints and for tensors; a limit that compares the numbers themselves,
    for degree 0 with 2 waves (4) is not above degree 3 (3); and a frequency or degree counted from the wrong end."""
    order = order_of(packed)
    assert 0 <= order.degree <= 3
    assert 1 <= order.waves <= 8
    assert order.packed == packed
    assert torch.equal(order_of(torch.tensor([packed])).packed, torch.tensor([packed]))
    pairs = [(order_of(other), order) for other in others]
    lowered = [ColorOrder(min(a.degree, b.degree), min(a.waves, b.waves)).packed for a, b in pairs]
    assert at_most(torch.tensor(others), packed).tolist() == lowered
    mask = coefficients_within(torch.tensor([packed]), 3, 8)[0]
    expected = [[wave < order.waves and math.isqrt(k) <= order.degree for k in range(16)] for wave in range(8)]
    assert mask.tolist() == expected


def test_time_encoding():
    """Catches another octave, order or factor than (sin 2^k pi t, cos 2^k pi t), k = 0..K-1; the paper's K is 10."""
    t = 0.37
    expected = [f(2**k * math.pi * t) for k in range(10) for f in (math.sin, math.cos)]
    for arguments, K in (((), 10), ((3,), 3), ((0,), 0)):
        encoded = encode_time(torch.tensor(t, dtype=torch.float64), *arguments)
        np.testing.assert_allclose(encoded.numpy(), expected[: 2 * K], atol=1e-10)


def test_refinement_measures_in_units():
    """Catches a scene of another size that is refined otherwise: lengths 100 times longer move 100 times further."""
    units = torch.tensor([100.0] * 3 + [1.0] * 4 + [1.0, 100.0])
    small, large = (Refinement([3, 1, 3, 2], torch.Generator().manual_seed(0), 4, u) for u in (None, units))
    for i, (a, b) in enumerate(zip(small.parameters(), large.parameters(), strict=True)):
        a.data = b.data = normal(i, *a.shape).float()
    values, time = normal(9, 6, 9).float(), torch.tensor(0.3)
    moved = torch.cat(small(list(values.split([3, 1, 3, 2], -1)), time), -1)
    again = torch.cat(large(list((values * units).split([3, 1, 3, 2], -1)), time), -1)
    torch.testing.assert_close(again, moved * units, rtol=1e-4, atol=1e-4)


def test_refinement_starts_at_zero_but_learns():
    """Catches residuals before any training, an output layer of zeros that gets no gradient, and another start than
    that of torch.nn.Linear: uniform within 1 / sqrt(width)."""
    refinement = Refinement([3, 1, 3, 28], torch.Generator().manual_seed(0))
    bound = 1 / math.sqrt(7 + 2 * refinement.octaves)
    for weights in (refinement.weight_in, refinement.bias_in):
        assert 0.9 * bound < weights.abs().max() <= bound
        assert weights.mean().abs() < 0.1 * bound
    assert refinement.weight_in.std().item() == pytest.approx(bound / math.sqrt(3), rel=0.05)
    values = list(normal(0, 5, 35).float().split([3, 1, 3, 7, 21], -1))
    moved = refinement(values, torch.tensor(0.3))
    assert all(torch.equal(x, y) for x, y in zip(moved, values, strict=True))
    sum(x.sum() for x in moved).backward()
    assert refinement.weight_out.grad.any(1).all()


def test_refinement_is_four_perceptrons_on_27_numbers():
    """Catches a shortcut of the shared first layer that is not 27 x 64 x c on the concatenated features."""
    refinement = Refinement([3, 1, 3, 28], torch.Generator().manual_seed(0)).double()
    for i, p in enumerate([refinement.weight_out, refinement.bias_out]):
        p.data = normal(i, *p.shape)
    values, time = list(normal(9, 6, 35).split([3, 1, 3, 28], -1)), torch.tensor(0.3, dtype=torch.float64)
    f = torch.cat([*values[:3], encode_time(time).expand(6, -1)], -1)
    assert f.shape[-1] == 27
    for i, (value, moved) in enumerate(zip(values, refinement(values, time), strict=True)):
        rows, outputs = slice(64 * i, 64 * (i + 1)), slice([0, 3, 4, 7][i], [3, 4, 7, 35][i])
        perceptron = nn.Sequential(nn.Linear(27, 64), nn.ReLU(), nn.Linear(64, value.shape[1])).double()
        first, last = perceptron[0], perceptron[2]
        first.weight.data, first.bias.data = refinement.weight_in.data[rows], refinement.bias_in.data[rows]
        last.weight.data, last.bias.data = refinement.weight_out.data[outputs], refinement.bias_out.data[outputs]
        torch.testing.assert_close(moved, value + perceptron(f))


def test_unit():
    """Catches a direction of another length than 1, and NaN where a camera sits on a mean: zero, with no gradient."""
    vectors = torch.tensor([[3.0, 0, 4], [0, 0, 0], [1e-15, 0, 0], [0, -1e-5, 0]], requires_grad=True)
    directions = unit(vectors)
    torch.testing.assert_close(directions[[0, 3]], torch.tensor([[0.6, 0, 0.8], [0, -1, 0]]))
    assert not directions[[1, 2]].any()
    (directions * torch.tensor([1.0, 2, 3])).sum().backward()
    assert vectors.grad.isfinite().all()
    assert not vectors.grad[[1, 2]].any()
    assert vectors.grad[[0, 3]].any()
    assert torch.autograd.gradcheck(unit, normal(0, 4, 3).requires_grad_())
