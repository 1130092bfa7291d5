"""Slicing against the textbook formula in exact and in double precision, easy and hard, with its gradients."""

import mpmath
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from gsbench.errors import InputError
from gsbench.models.slicing import SCHEMES, mahalanobis, reduce, slice_gaussians, triangularise

PROPERTY = settings(max_examples=25, deadline=None)
seeds = st.integers(0, 2**31)


def normal(seed: int, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def tame(seed: int, N: int, k: int) -> tuple[Tensor, Tensor, Tensor]:
    """Means, well-conditioned full factors and queries."""
    factor = 2 * torch.eye(3 + k, dtype=torch.float64) + 0.3 * normal(seed, N, 3 + k, 3 + k)
    return normal(seed + 1, N, 3 + k), factor.flip(1), normal(seed + 2, N, k)


def hard(seed: int, N: int) -> Tensor:
    """Triangular 7D factors over (p, q) with a diagonal from 1e-5 to 1 and entries of about 1 below it."""
    exponent = torch.rand(N, 7, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return normal(seed, N, 7, 7).tril(-1) + torch.diag_embed(10 ** (-5 * exponent))


def conditional(mean: Tensor, factor: Tensor, query: Tensor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean, covariance and gain by the formula of METHODS in float64, with the explicit inverse."""
    S = (factor @ factor.mT).numpy()
    mu, q = mean.numpy(), np.broadcast_to(query.numpy(), (len(mean), mean.shape[1] - 3))
    K = S[:, :3, 3:] @ np.linalg.inv(S[:, 3:, 3:])
    return mu[:, :3] + np.einsum("nij,nj->ni", K, q - mu[:, 3:]), S[:, :3, :3] - K @ S[:, 3:, :3], K


def conditional_exact(factor: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Covariance and gain [3, 3], [3, k] of one factor, by the formula in 80 digits."""
    with mpmath.workdps(80):
        F = mpmath.matrix(factor.tolist())
        S = F * F.T
        K = S[:3, 3:] * mpmath.inverse(S[3:, 3:])
        return np.array((S[:3, :3] - K * S[3:, :3]).tolist(), float), np.array(K.tolist(), float)


def relative(x: Tensor, exact: np.ndarray) -> np.ndarray:
    """Frobenius norm of the error of each matrix, over that of the exact one."""
    return np.linalg.norm(x.double().numpy() - exact, axis=(1, 2)) / np.linalg.norm(exact, axis=(1, 2))


@pytest.mark.parametrize("one_query", [False, True])
@pytest.mark.parametrize("k", [0, 1, 3, 4])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_formula(scheme, k, one_query):
    """Catches a wrong block, transpose, order of (p, q) or sign, for no observation, t, d and both; f_temp and f_dir of
    another block than the marginal one, delta^T (R R^T)^-1 delta."""
    mean, factor, query = tame(0, 50, k)
    query = query[0] if one_query else query
    sliced = slice_gaussians(mean, factor, query, scheme=scheme)
    expected_mean, expected_cov, expected_gain = conditional(mean, factor, query)
    np.testing.assert_allclose(sliced.mean.numpy(), expected_mean, atol=1e-12)
    np.testing.assert_allclose((sliced.factor @ sliced.factor.mT).numpy(), expected_cov, atol=1e-12)
    np.testing.assert_allclose(sliced.gain.numpy(), expected_gain, atol=1e-12)
    rows, delta = factor[:, 3:], normal(6, 50, k)
    expected = (delta[:, None] @ torch.linalg.inv(rows @ rows.mT) @ delta[..., None])[:, 0, 0]
    torch.testing.assert_close(mahalanobis(rows, delta), expected)


def test_square_root_is_exact_where_the_formula_is_not():
    """Catches a reduction that squares the condition number: double precision agrees with 80 digits to 1e-9."""
    factor = hard(1, 8)
    sliced = slice_gaussians(torch.zeros(8, 7).double(), factor, torch.zeros(4).double())
    exact = [conditional_exact(f) for f in factor]
    assert relative(sliced.factor @ sliced.factor.mT, np.stack([e[0] for e in exact])).max() < 1e-9
    assert relative(sliced.gain, np.stack([e[1] for e in exact])).max() < 1e-9


@PROPERTY
@given(seeds, st.integers(0, 4))
def test_reduction_keeps_the_covariance(seed, k):
    """Catches a reflection that is not one: F F^T of the reduced factor, rows (p, q), is that of the factor."""
    F = tame(seed, 5, k)[1]
    T_qq, T_pq, T_pp = reduce(F)
    T = torch.cat([torch.cat([T_pq, T_pp], -1), torch.cat([T_qq, torch.zeros(5, k, 3)], -1)], 1)
    torch.testing.assert_close(T @ T.mT, F @ F.mT, rtol=1e-12, atol=1e-12)
    assert torch.equal(T_qq, T_qq.tril())


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("size", [1.0, 1e-2, 1e-3, 1e-4, 1e-6])
def test_reduction_of_what_is_nearly_reduced(size, sign):
    """Catches the reflection of the other sign, which cancels where a row has almost its final form (float32)."""
    F = torch.cat([normal(0, 200, 3, 7), size * normal(1, 200, 4, 7)], 1)
    F[:, 3:, :4] += sign * (torch.eye(4) + normal(2, 200, 4, 4).tril(-1))
    T_qq, T_pq, T_pp = (x.double() for x in reduce(F.float()))
    T = torch.cat([torch.cat([T_pq, T_pp], -1), torch.cat([T_qq, torch.zeros(200, 4, 3)], -1)], 1)
    F = F.float().double()
    assert relative(T @ T.mT, (F @ F.mT).numpy()).max() < 2e-6


@pytest.mark.parametrize("k", [0, 1, 3, 4])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_gradients(scheme, k):
    """Catches a wrong derivative by factor, mean or query, in each scheme (central differences)."""
    inputs = [x.requires_grad_() for x in tame(3, 2, k)]

    def sliced(mean: Tensor, factor: Tensor, query: Tensor) -> tuple[Tensor, ...]:
        mean3, factor3, gain = slice_gaussians(mean, factor, query, scheme=scheme)
        return mean3, factor3 @ factor3.mT, gain, mahalanobis(factor[:, 3:], query)

    assert torch.autograd.gradcheck(sliced, inputs)


@pytest.mark.parametrize("rows", [[0], [1, 2], [0, 1, 2]])
def test_rows_of_zeros(rows):
    """Catches 0/0 in a reflection: a Gaussian that is flat in p, and a row of q that is zero in the reduction."""
    mean, factor, query = tame(7, 3, 4)
    flat = factor.clone()
    flat[:, rows] = 0
    flat.requires_grad_()
    sliced = slice_gaussians(mean, flat, query)
    sum(x.square().sum() for x in sliced).backward()
    assert flat.grad.isfinite().all()
    assert all(x.isfinite().all() for x in sliced)
    T, rest = triangularise(flat, 4)
    flat.grad = None
    (T.square().sum() + rest.sum()).backward()
    assert not T.detach()[:, rows].any()
    assert flat.grad.isfinite().all()


@pytest.mark.parametrize(
    "shapes",
    [
        ((5, 7), (5, 7, 7), (3,)),
        ((5, 7), (5, 7, 7), (5, 3)),
        ((5, 7), (5, 7, 7), (4, 4)),
        ((5, 7), (5, 7, 7), (1, 5, 4)),
        ((5, 7), (5, 7, 7), ()),
        ((5, 7), (5, 7, 6), (4,)),
        ((5, 7), (4, 7, 7), (4,)),
        ((5, 2), (5, 2, 2), (0,)),
        ((7,), (7, 7), (4,)),
        ((1, 5, 7), (1, 5, 7, 7), (4,)),
    ],
)
def test_shapes_are_checked(shapes):
    """Catches shapes that fail in the depths or broadcast to nonsense."""
    with pytest.raises(InputError, match="slice_gaussians: expected mean"):
        slice_gaussians(*map(torch.zeros, shapes))


def test_unknown_scheme():
    """Catches a misspelt scheme that falls through to another one."""
    with pytest.raises(InputError, match="Did you mean 'cholesky'"):
        slice_gaussians(*tame(0, 1, 1), scheme="cholesk")
