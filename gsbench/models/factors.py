"""Parameters to factors F of a covariance S = F F^T, and back: triangular (6DGS, 7DGS), rotated (3DGS, 4DGS)."""

import torch
import torch.nn.functional as F
from torch import Tensor

from gsbench.kernels.thresholds import LOG_SIZE_MAX
from gsbench.models.slicing import triangularise


def sizes(logs: Tensor) -> Tensor:
    """exp of log sizes of any shape, each held to +-LOG_SIZE_MAX; the gradient of one that is held is zero."""
    return logs.clamp(-LOG_SIZE_MAX, LOG_SIZE_MAX).exp()


def triangular(
    log_diagonal: Tensor,  # [N, n]
    off_diagonal: Tensor,  # [N, n(n-1)/2]
    *,
    row_scaled: bool = False,
) -> Tensor:  # [N, n, n]
    """Lower triangular L whose diagonal is positive by exp (7DGS, section 4.1).

    Args:
        log_diagonal: logarithms of the diagonal.
        off_diagonal: the entries below it, row by row.
        row_scaled: an entry is (2 sigmoid(x) - 1) times its row's diagonal, as some 6DGS code has it, not x itself.
    """
    n = log_diagonal.shape[-1]
    diagonal = sizes(log_diagonal)
    rows = []
    for i, (below, d) in enumerate(zip(off_diagonal.split(list(range(n)), -1), diagonal.split(1, -1), strict=True)):
        entries = (2 * torch.sigmoid(below) - 1) * d if row_scaled else below
        rows.append(F.pad(torch.cat([entries, d], -1), (0, n - 1 - i)))
    return torch.stack(rows, 1)


def triangular_parameters(factor: Tensor, *, row_scaled: bool = False) -> tuple[Tensor, Tensor]:
    """Undo `triangular`: log_diagonal [N, n] and off_diagonal [N, n(n-1)/2] of any square factor [N, n, n] of S.

    With `row_scaled`, entries that form cannot reach (as large as their diagonal or larger) are cut to 99.9 % of it.
    """
    n = factor.shape[-1]
    L, _ = triangularise(factor, n)
    L = L * torch.where(L.diagonal(dim1=1, dim2=2) < 0, -1.0, 1.0)[:, None, :]
    diagonal = L.diagonal(dim1=1, dim2=2)
    i, j = torch.tril_indices(n, n, -1, device=factor.device)
    off_diagonal = L[:, i, j]
    if row_scaled:
        off_diagonal = 2 * torch.atanh((off_diagonal / diagonal[:, i]).clamp(-0.999, 0.999))
    return diagonal.log(), off_diagonal


def rotation(quaternions: Tensor) -> Tensor:
    """Rotation matrices of quaternions wxyz of any length but zero, [N, 4] -> [N, 3, 3]."""
    w, x, y, z = F.normalize(quaternions, dim=-1).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def rotation4d(left: Tensor, right: Tensor) -> Tensor:
    """The 4D rotation M_left(l) M_right(r) of two quaternions, [N, 4] and [N, 4] -> [N, 4, 4] (4DGS, eq. 7)."""
    a, b, c, d = F.normalize(left, dim=-1).unbind(-1)
    p, q, r, s = F.normalize(right, dim=-1).unbind(-1)
    M_left = torch.stack([a, -b, -c, -d, b, a, -d, c, c, d, a, -b, d, -c, b, a], -1).unflatten(-1, (4, 4))
    M_right = torch.stack([p, q, r, s, -q, p, -s, r, -r, s, p, -q, -s, -r, q, p], -1).unflatten(-1, (4, 4))
    return M_left @ M_right
