"""Slice joint Gaussians over (p, q) at an observed q into conditional 3D Gaussians over p (7DGS, section 4.2).

    K = S_pq S_qq^-1        mean = mu_p + K (q - mu_q)        cov = S_pp - K S_pq^T

A factor F of S = F F^T, with rows ordered (p, q), gives a Gaussian. Forming S squares the condition number,
so the default scheme never forms it. It turns the rows of F by reflections until
F = [T_pq T_pp; T_qq 0] with T_qq lower triangular (square-root Kalman filters: Kailath, Sayed, Hassibi, chapter 12),

    K = T_pq T_qq^-1        cov = T_pp T_pp^T

and passes T_pp itself to the rasterizer. This covariance is semi-definite by construction; nothing is subtracted.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from gsbench.errors import InputError, did_you_mean
from gsbench.kernels.tensors import check_tensor

SCHEMES = ("square_root", "schur", "cholesky")


class Slice(NamedTuple):
    """The conditional Gaussian of a joint one, given q."""

    mean: Tensor  # [N, 3]
    factor: Tensor  # [N, 3, 3] F of cov = F F^T
    gain: Tensor  # [N, 3, k] K: how the mean moves with q


class Reduced(NamedTuple):
    """A factor in the form [T_qq 0; T_pq T_pp]: conditioned variables first, T_qq lower triangular."""

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
    """Slice N joint Gaussians: condition them on q = query (7DGS eq. 9 and 10).

        mean = mu_p + S_pq S_qq^-1 (q - mu_q)        cov = S_pp - S_pq S_qq^-1 S_qp

    with S = F F^T and p = (x, y, z). By `square_root` no covariance is formed: an orthogonal matrix turns F into
    [T_pp T_pq; 0 T_qq], and then gain = T_pq T_qq^-1 and cov = T_pp T_pp^T.

    Args:
        mean: (mu_p, mu_q), [N, 3+k].
        factor: a square F with S = F F^T, rows ordered (p, q), [N, 3+k, 3+k].
        query: the observed q in the units of mu_q, the same for all Gaussians [k] or one for each [N, k].
        scheme: `square_root` works on F; `schur` inverts S_qq and subtracts, as published code does; `cholesky` solves
            with a Cholesky factor of S_qq and subtracts. The last two are for comparison: they lose half the digits.

    Returns:
        Slice(mean, factor, gain): mean [N, 3] and factor [N, 3, 3] of the conditional Gaussians in the units of p, with
        cov = factor factor^T; gain = S_pq S_qq^-1 [N, 3, k], the motion of the mean with q.

    Raises:
        InputError: types or shapes do not fit, or the scheme is unknown.

    Example:
        A Gaussian over (x, y, z, t) that moves along x: its covariance of x and t is 0.5.

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
            raise InputError(f"slice_gaussians: expected {name} as {mean.dtype} on {mean.device}, as the mean is, got "
                             f"{x.dtype} on {x.device}")  # fmt: skip
    N, n = mean.shape if mean.dim() == 2 else (0, 0)
    if n < 3 or factor.shape != (N, n, n) or query.shape not in ((N, n - 3), (n - 3,)):
        raise InputError(f"slice_gaussians: expected mean [N, 3+k], factor [N, 3+k, 3+k] and query [N, k] or [k], "
                         f"got {list(mean.shape)}, {list(factor.shape)} and {list(query.shape)}")  # fmt: skip
    check_scheme(scheme)
    if scheme == "square_root":
        return slice_reduced(mean, reduce(factor), query)
    gain, cov = subtract(factor, scheme)
    moved = mean[:, :3] + (gain @ (query - mean[:, 3:])[..., None])[..., 0]
    return Slice(moved, _cholesky3(cov), gain)


def subtract(factor: Tensor, scheme: str) -> tuple[Tensor, Tensor]:
    """Compute K [N, 3, k] and S_pp - K S_pq^T [N, 3, 3] by a scheme that forms S; the result may be indefinite."""
    S = factor @ factor.mT
    S_pp, S_pq, S_qq = S[:, :3, :3], S[:, :3, 3:], S[:, 3:, 3:]
    if scheme == "schur":
        gain = S_pq @ torch.linalg.inv_ex(S_qq).inverse
    else:
        gain = torch.cholesky_solve(S_pq.mT, torch.linalg.cholesky_ex(S_qq).L).mT
    return gain, S_pp - gain @ S_pq.mT


def check_scheme(scheme: str) -> None:
    """Raise InputError unless `scheme` is one of SCHEMES."""
    if scheme not in SCHEMES:
        raise InputError(f"slicing scheme '{scheme}' is not known. {did_you_mean(scheme, SCHEMES)}")


def slice_reduced(mean: Tensor, reduced: Reduced, query: Tensor) -> Slice:
    """Slice factors that are already [T_qq 0; T_pq T_pp]: mean = mu_p + T_pq (T_qq^-1 (q - mu_q))."""
    white = whiten(reduced.T_qq, query - mean[:, 3:])
    moved = mean[:, :3] + (reduced.T_pq * white[:, None]).sum(-1)
    return Slice(moved, reduced.T_pp, gain_of(reduced.T_pq, reduced.T_qq))


def reduce(factor: Tensor) -> Reduced:
    """Turn a factor with rows (p, q), [N, 3+k, n], to [T_qq 0; T_pq T_pp] by reflections from the right."""
    k = factor.shape[1] - 3
    T, rest = triangularise(torch.cat([factor[:, 3:], factor[:, :3]], 1), k)
    return Reduced(T[:, :k], T[:, k:], rest[:, k:])


def mahalanobis(rows: Tensor, delta: Tensor) -> Tensor:
    """Compute delta^T (R R^T)^-1 delta of rows R of a factor without an inverse, [N, m, n] and [N, m] -> [N].

    This is the exponent of f_temp and f_dir (7DGS eq. 11 and 12): R R^T is the marginal block S_t or S_d.
    """
    T, _ = triangularise(rows, rows.shape[1])
    return whiten(T, delta).square().sum(-1)


def whiten(T: Tensor, delta: Tensor) -> Tensor:
    """Compute T^-1 delta for lower triangular T, [N, m, m] and [N, m] -> [N, m], by forward substitution.

    The squares of its first i entries add up to the Mahalanobis distance of the first i variables alone.
    """
    rows = T.unbind(1)
    white: list[Tensor] = []
    for i, residual in enumerate(delta.unbind(-1)):
        for j, known in enumerate(white):
            residual = residual - rows[i][:, j] * known
        white.append(residual / rows[i][:, i])
    return torch.stack(white, -1) if white else delta


def triangularise(rows: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """Reflect [N, r, n] rows from the right until the first k are lower triangular: [N, r, k] and the rest [N, r, n-k].

    R H H^T R^T = R R^T, so no covariance changes. These are Householder reflections, with the sign that avoids
    cancellation (Golub and Van Loan, section 5.1).
    """
    rest, columns = rows, []
    for i in range(k):
        x = rest[:, i]
        square = (x * x).sum(-1, keepdim=True)
        length = torch.where(square > 0, torch.where(square > 0, square, 1.0).sqrt(), 0.0)
        signed = torch.where(x[:, :1] < 0, -length, length)
        v = torch.cat([x[:, :1] + signed, x[:, 1:]], -1)
        vv = (v * v).sum(-1, keepdim=True)
        step = v * (2 / torch.where(vv > 0, vv, 1.0))  # zero for a row of zeros, which does not change
        rest = rest - (rest * v[:, None]).sum(-1, keepdim=True) * step[:, None]
        # Row i is now (-+|x|, 0, ..). It is written as such, so that T is exactly triangular.
        columns.append(torch.cat([torch.zeros_like(rest[:, :i, 0]), -signed, rest[:, i + 1 :, 0]], -1))
        rest = rest[..., 1:]
    T = torch.stack(columns, -1) if columns else rows[..., :0]
    return T, rest


def gain_of(T_pq: Tensor, T_qq: Tensor) -> Tensor:
    """Compute K = T_pq T_qq^-1 by back substitution, [N, 3, k] and [N, k, k] lower triangular -> [N, 3, k]."""
    k = T_qq.shape[-1]
    solved: list[Tensor] = []  # columns k-1, k-2, ..
    for j in reversed(range(k)):
        column = T_pq[..., j]
        for i, x in zip(range(k - 1, j, -1), solved, strict=True):
            column = column - x * T_qq[:, i, j, None]
        solved.append(column / T_qq[:, j, j, None])
    return torch.stack(solved[::-1], -1) if solved else T_pq


def _cholesky3(S: Tensor) -> Tensor:
    """Compute a lower triangular factor of S [N, 3, 3]; if S is indefinite, negative pivots become zero."""

    def root(x: Tensor) -> Tensor:
        return torch.where(x > 0, torch.where(x > 0, x, 1.0).sqrt(), 0.0)

    def over(x: Tensor, pivot: Tensor) -> Tensor:
        return torch.where(pivot > 0, x / torch.where(pivot > 0, pivot, 1.0), 0.0)

    a = root(S[:, 0, 0])
    b, c = over(S[:, 1, 0], a), over(S[:, 2, 0], a)
    d = root(S[:, 1, 1] - b * b)
    e = over(S[:, 2, 1] - b * c, d)
    f = root(S[:, 2, 2] - c * c - e * e)
    zero = torch.zeros_like(a)
    return torch.stack([a, zero, zero, b, d, zero, c, e, f], -1).unflatten(-1, (3, 3))
