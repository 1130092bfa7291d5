"""Slice Gaussians: compute the conditional 3D Gaussians over position p, given q (time, direction) (7DGS, section 4.2).

The joint covariance of p and q is S = F F^T, where the rows of F are ordered (p, q). The conditional Gaussian has

    K = S_pq S_qq^-1        mean = mu_p + K (q - mu_q)        cov = S_pp - K S_pq^T

The default method does not compute S, because that squares the condition number. It multiplies F from the right by
Householder reflections until F = [T_pq T_pp; T_qq 0] with T_qq lower triangular. This is the method of square-root
Kalman filters (Kailath, Sayed, Hassibi, chapter 12). Then

    K = T_pq T_qq^-1        cov = T_pp T_pp^T

The rasterizer takes the factor T_pp, so the covariance is always semi-definite.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from gsbench.errors import InputError, check_known
from gsbench.kernels.tensors import check_tensor
from gsbench.models.portable_math import sqrt

SCHEMES = ("square_root", "schur", "cholesky")


class Slice(NamedTuple):
    """Hold the conditional 3D Gaussians over position, given time or direction q."""

    mean: Tensor  # [N, 3]
    factor: Tensor  # [N, 3, 3] F of cov = F F^T
    gain: Tensor  # [N, 3, k] K: the derivative of the mean with respect to q


class Reduced(NamedTuple):
    """Hold the blocks of the factor [T_qq 0; T_pq T_pp] of a covariance; p is position, q time and direction."""

    T_qq: Tensor  # [N, k, k]
    T_pq: Tensor  # [N, 3, k]
    T_pp: Tensor  # [N, 3, 3]


def slice_gaussians(
    mean: Tensor,  # [N, 3+k]
    factor: Tensor,  # [N, 3+k, 3+k]
    query: Tensor,  # [N, k] or [k]
    *,
    scheme: str = "square_root",
) -> Slice:
    """Compute the conditional 3D Gaussians over position p of N joint Gaussians over (p, q), given q (7DGS eq. 9, 10).

        mean = mu_p + S_pq S_qq^-1 (q - mu_q)        cov = S_pp - S_pq S_qq^-1 S_qp

    Args:
        mean: the means (mu_p, mu_q), [N, 3+k].
        factor: a square factor F of the covariance S = F F^T, with rows ordered (p, q), [N, 3+k, 3+k].
        query: the value of q, [k] for all Gaussians or [N, k].
        scheme: the numerical method. `square_root` applies reflections to F and does not compute S. `schur` inverts
            S_qq, as published code does. `cholesky` solves with a Cholesky factor of S_qq. The last two lose half of
            the digits and are for comparison.

    Returns:
        The mean [N, 3], a factor [N, 3, 3] of the covariance, and the gain S_pq S_qq^-1 [N, 3, k], the derivative of
        the mean with respect to q.

    Raises:
        InputError: types or shapes do not fit, or the scheme is unknown.

    Example:
        A Gaussian over (x, y, z, t) moves along x, because the covariance of x and t is 0.5.

        >>> import torch
        >>> from gsbench import slice_gaussians
        >>> factor = torch.eye(4)[None]
        >>> factor[0, 0, 3] = 0.5
        >>> at = slice_gaussians(torch.zeros(1, 4), factor, torch.tensor([2.0]))
        >>> at.mean
        tensor([[1., 0., 0.]])
        >>> at.factor @ at.factor.mT
        tensor([[[1., 0., 0.],
                 [0., 1., 0.],
                 [0., 0., 1.]]])
    """
    for name, x in (("mean", mean), ("factor", factor), ("query", query)):
        check_tensor(x, f"slice_gaussians: {name}")
        if x.dtype != mean.dtype or x.device != mean.device:
            raise InputError(
                f"slice_gaussians: expected {name} as {mean.dtype} on {mean.device}, as the mean is, got "
                f"{x.dtype} on {x.device}"
            )
    N, n = mean.shape if mean.dim() == 2 else (0, 0)
    if n < 3 or factor.shape != (N, n, n) or query.shape not in ((N, n - 3), (n - 3,)):
        raise InputError(
            f"slice_gaussians: expected mean [N, 3+k], factor [N, 3+k, 3+k] and query [N, k] or [k], "
            f"got {list(mean.shape)}, {list(factor.shape)} and {list(query.shape)}"
        )
    check_scheme(scheme)
    mu_p, delta = mean[:, :3], query - mean[:, 3:]
    if scheme == "square_root":
        T_qq, T_pq, T_pp = reduce(factor)
        return Slice(mu_p + (T_pq * whiten(T_qq, delta)[:, None]).sum(-1), T_pp, gain_of(T_pq, T_qq))
    gain, cov = subtract(factor, scheme)
    return Slice(mu_p + (gain @ delta[..., None])[..., 0], cholesky3(cov), gain)


def subtract(factor: Tensor, scheme: str) -> tuple[Tensor, Tensor]:
    """Return the gain K = S_pq S_qq^-1 [N, 3, k] and the conditional covariance S_pp - K S_pq^T [N, 3, 3].

    Here p is position, q is time and direction, and S = F F^T is computed. Rounding may make the result indefinite. The
    schemes "schur" and "cholesky" are for comparison, see `slice_gaussians`.
    """
    S = factor @ factor.mT
    S_pp, S_pq, S_qq = S[:, :3, :3], S[:, :3, 3:], S[:, 3:, 3:]
    if scheme == "schur":
        gain = S_pq @ torch.linalg.inv_ex(S_qq).inverse
    else:
        gain = torch.cholesky_solve(S_pq.mT, torch.linalg.cholesky_ex(S_qq).L).mT
    return gain, S_pp - gain @ S_pq.mT


def check_scheme(scheme: str) -> None:
    """Raise InputError unless `scheme` is a method of conditioning: `square_root`, `schur` or `cholesky`."""
    check_known("slicing scheme", scheme, SCHEMES)


def reduce(factor: Tensor) -> Reduced:
    """Transform covariance factors with rows (p, q) to the form [T_qq 0; T_pq T_pp] by Householder reflections.

    Here p is position, and q is time and direction. The factors are [N, 3+k, n]; T_qq is lower triangular.
    """
    k = factor.shape[1] - 3
    T, rest = triangularise(torch.cat([factor[:, 3:], factor[:, :3]], 1), k)
    return Reduced(T[:, :k], T[:, k:], rest[:, k:])


def mahalanobis(rows: Tensor, delta: Tensor) -> Tensor:
    """Compute squared Mahalanobis distances delta^T (R R^T)^-1 delta without an inverse, [N, m, n] and [N, m] -> [N].

    `rows` is R, the rows of a factor for some variables, so R R^T is the marginal covariance of these variables.
    """
    T, _ = triangularise(rows, rows.shape[1])
    return whiten(T, delta).square().sum(-1)


def whiten(T: Tensor, delta: Tensor) -> Tensor:
    """Compute T^-1 delta for lower triangular T by forward substitution, [N, m, m] and [N, m] -> [N, m].

    The sum of squares of the first i entries is the squared Mahalanobis distance of the first i variables.
    """
    rows = T.unbind(1)
    white: list[Tensor] = []
    for i, residual in enumerate(delta.unbind(-1)):
        for j, solved in enumerate(white):
            residual = residual - rows[i][:, j] * solved
        white.append(residual / rows[i][:, i])
    return torch.stack(white, -1) if white else delta


def triangularise(rows: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """Multiply matrices R [N, r, n] from the right by k Householder reflections that make the first k rows triangular.

    R R^T, the covariance, does not change. The reflections have the sign that avoids cancellation (Golub and Van Loan,
    section 5.1).

    Returns:
        The first k columns [N, r, k], which are lower triangular in their first k rows, and the others [N, r, n-k].
    """
    rest, columns = rows, []
    for i in range(k):
        x = rest[:, i]
        square = (x * x).sum(-1, keepdim=True)
        length = torch.where(square > 0, sqrt(torch.where(square > 0, square, 1.0)), 0.0)
        signed = torch.where(x[:, :1] < 0, -length, length)
        # I - tau u u^T with u_0 = 1: its numbers are of order one, so that no square of a short row underflows.
        first = x[:, :1] + signed
        u = torch.cat([torch.ones_like(first), x[:, 1:] / torch.where(square > 0, first, 1.0)], -1)
        tau = first / torch.where(square > 0, signed, 1.0)  # zero for a row of zeros, which does not change
        rest = rest - (rest * u[:, None]).sum(-1, keepdim=True) * (tau * u)[:, None]
        # Row i is now (+-|x|, 0, ..) up to rounding. The zeros are written, so that T is exactly triangular.
        columns.append(torch.cat([torch.zeros_like(rest[:, :i, 0]), -signed, rest[:, i + 1 :, 0]], -1))
        rest = rest[..., 1:]
    T = torch.stack(columns, -1) if columns else rows[..., :0]
    return T, rest


def gain_of(T_pq: Tensor, T_qq: Tensor) -> Tensor:
    """Compute K = T_pq T_qq^-1, by which means (p) move with time and direction (q); T_qq is lower triangular."""
    k = T_qq.shape[-1]
    solved: list[Tensor] = []  # columns k-1, k-2, .. of K, by substitution in K T_qq = T_pq
    for j in reversed(range(k)):
        column = T_pq[..., j]
        for i, x in zip(range(k - 1, j, -1), solved, strict=True):
            column = column - x * T_qq[:, i, j, None]
        solved.append(column / T_qq[:, j, j, None])
    return torch.stack(solved[::-1], -1) if solved else T_pq


def cholesky3(S: Tensor) -> Tensor:
    """Compute the Cholesky factor of S [N, 3, 3]; if S is indefinite, negative pivots are replaced by zero."""

    def root(x: Tensor) -> Tensor:
        return torch.where(x > 0, sqrt(torch.where(x > 0, x, 1.0)), 0.0)

    def over(x: Tensor, pivot: Tensor) -> Tensor:
        return torch.where(pivot > 0, x / torch.where(pivot > 0, pivot, 1.0), 0.0)

    # L = [a 0 0; b d 0; c e f]
    a = root(S[:, 0, 0])
    b, c = over(S[:, 1, 0], a), over(S[:, 2, 0], a)
    d = root(S[:, 1, 1] - b * b)
    e = over(S[:, 2, 1] - b * c, d)
    f = root(S[:, 2, 2] - c * c - e * e)
    zero = torch.zeros_like(a)
    return torch.stack([a, zero, zero, b, d, zero, c, e, f], -1).unflatten(-1, (3, 3))
