"""Compute factors F of covariances S = F F^T: a Cholesky factor (6DGS, 7DGS), or rotation times scale (3DGS, 4DGS)."""

import torch
import torch.nn.functional as F
from scipy.spatial.transform import Rotation
from torch import Tensor

from gsbench.errors import check_known
from gsbench.kernels.headers import LOG_SIZE_MAX
from gsbench.models.portable_math import exp, log
from gsbench.models.slicing import triangularise

OFF_DIAGONALS = (
    "relative",
    "raw",
    "row_scaled",
)  # values of `form` of `CholeskyLayout`, in the order of math/off_diagonal.h
KINDS = ("shape", "motion", "coupling")  # kinds of entries below the diagonal, see `CholeskyLayout`


def sizes(logs: Tensor) -> Tensor:
    """Compute exp of log sizes after clamping them to +-LOG_SIZE_MAX; a clamped log size has a gradient of zero."""
    return exp(logs.clamp(-LOG_SIZE_MAX, LOG_SIZE_MAX))


class CholeskyLayout:
    """Describe the Cholesky factor of a covariance over position p, time t and direction d.

    The entries below the diagonal are of three kinds, each with its own learning rate:

    - `shape`: the row and the column are both of p;
    - `motion`: one of them is of p, the other of t or d; these entries move the 3D Gaussian with time and direction;
    - `coupling`: the row and the column are both of t or d.
    """

    def __init__(self, letters: str, form: str = "relative") -> None:
        """Describe a Cholesky factor by the variable of each row, "p", "t" or "d", for example "dddtppp".

        The form is how a parameter x gives an entry below the diagonal. `raw`: the entry is x, as in the 7DGS paper.
        `row_scaled`: it is (2 sigmoid(x) - 1) times the diagonal entry of its row, as in the authors' later code.
        `relative`: it is x times the diagonal entry of its row if row and column are "p", else x.
        """
        check_known("off_diagonal", form, OFF_DIAGONALS)
        self.form = form
        self.letters = letters
        below = [(i, j) for i in range(len(letters)) for j in range(i)]  # row by row, as `split` takes them
        places: dict[str, list[int]] = {"shape": [], "motion": [], "coupling": []}
        for place, (i, j) in enumerate(below):
            count_of_p = (letters[i] + letters[j]).count("p")
            places[("coupling", "motion", "shape")[count_of_p]].append(place)
        self.places = places  # the indices of the entries of each kind among all entries below the diagonal
        self.kinds = tuple(kind for kind in KINDS if places[kind])  # a factor over (t, p) has no coupling
        self.rows = [i for i, _ in below]
        order = [place for kind in KINDS for place in places[kind]]
        # Entry i below the diagonal is column self.columns[i] of the concatenation (shape, motion, coupling).
        self.columns = sorted(range(len(order)), key=order.__getitem__)
        relative = {"relative": places["shape"], "raw": [], "row_scaled": range(len(below))}[form]
        self.is_relative = torch.tensor([place in relative for place in range(len(below))])

    def pair(self, place: int) -> tuple[str, str]:
        """Return the variables ("p", "t" or "d") of the row and the column of entry `place` below the diagonal."""
        row = self.rows[place]  # row (row - 1) / 2 entries are above it
        return self.letters[row], self.letters[place - row * (row - 1) // 2]

    def factor(self, log_diagonal: Tensor, kinds: dict[str, Tensor]) -> Tensor:
        """Compute lower triangular factors L [N, n, n] (7DGS, section 4.1) over position and k other variables.

        `log_diagonal` is [N, n] with n = 3 + k; `shape` is [N, 3], `motion` [N, 3 k], `coupling` [N, k (k - 1) / 2].
        """
        n = log_diagonal.shape[-1]
        diagonal = sizes(log_diagonal)
        x = self.join(kinds)
        if self.form == "row_scaled":
            x = 2 * torch.sigmoid(x) - 1
        x = torch.where(self.is_relative.to(x.device), x * diagonal[:, self.rows], x)
        rows = zip(x.split(list(range(n)), -1), diagonal.split(1, -1), strict=True)  # row i has i entries in x
        return torch.stack([F.pad(torch.cat(row, -1), (0, n - 1 - i)) for i, row in enumerate(rows)], 1)

    def parameters(self, factor: Tensor) -> dict[str, Tensor]:
        """Compute the parameters of the triangular factors L with L L^T = F F^T, for any square F [N, n, n].

        The form `row_scaled` cannot express an entry as large as the diagonal entry of its row. Such an entry is cut to
        99.9 % of the diagonal entry.
        """
        n = factor.shape[-1]
        L, _ = triangularise(factor, n)
        L = L * torch.where(L.diagonal(dim1=1, dim2=2) < 0, -1.0, 1.0)[:, None, :]  # L L^T stays, its diagonal is > 0
        diagonal = L.diagonal(dim1=1, dim2=2)
        i, j = torch.tril_indices(n, n, -1, device=factor.device)
        x = L[:, i, j]
        x = torch.where(self.is_relative.to(x.device), x / diagonal[:, self.rows], x)
        if self.form == "row_scaled":
            x = 2 * torch.atanh(x.clamp(-0.999, 0.999))
        return {"log_diagonal": log(diagonal)} | self.split(x)

    def split(self, below: Tensor) -> dict[str, Tensor]:
        """Split the parameters below the diagonal, [N, n (n - 1) / 2] row by row, into the kinds of the class."""
        return {kind: below[:, self.places[kind]] for kind in self.kinds}

    def join(self, kinds: dict[str, Tensor]) -> Tensor:
        """Concatenate the parameters `shape`, `motion` and `coupling` to all those below the diagonal, row by row."""
        return torch.cat([kinds[kind] for kind in self.kinds], -1)[:, self.columns]


def rotation(quaternions: Tensor) -> Tensor:
    """Compute the rotation matrices of quaternions wxyz, which need not be normalised, [N, 4] -> [N, 3, 3]."""
    w, x, y, z = F.normalize(quaternions, dim=-1).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def turn_of_space(quaternions: Tensor) -> Tensor:
    """Convert left quaternions l of 4D rotations that turn only space to 3D quaternions, [N, 4] -> [N, 4].

    A 4D rotation M_left(l) M_right(r) of 4DGS turns only space if r is a positive multiple of (l0, -l1, -l2, l3), and
    only then. It is then the 3D rotation with the quaternion wxyz = (l0, l3, -l2, l1). This function is its own
    inverse, so it also converts a 3D quaternion to l.

    Derivation: `rotation4d(l, r)` maps v = x + y i + z j + t k to l v r*. It maps the axis k of time to itself if
    r = k* l k. It then maps u = v k* = t - z i + y j - x k to l u l*, a 3D rotation in which (z, -y, x) stands for the
    axis (x, y, z).
    """
    w, x, y, z = quaternions.unbind(-1)
    return torch.stack([w, z, -y, x], -1)


def partner(left: Tensor) -> Tensor:
    """Return right quaternions r, such that the 4D rotations M_left(l) M_right(r) turn only space, [N, 4] -> [N, 4]."""
    return left * left.new_tensor([1, -1, -1, 1])


def quaternion(rotations: Tensor) -> Tensor:
    """Convert rotation matrices to quaternions wxyz, [N, 3, 3] -> [N, 4]."""
    xyzw = Rotation.from_matrix(rotations.double().cpu().numpy()).as_quat()
    return torch.from_numpy(xyzw).roll(1, -1).to(rotations)


def rotation4d(left: Tensor, right: Tensor) -> Tensor:
    """Compute 4D rotations M_left(l) M_right(r) of two quaternions, [N, 4] and [N, 4] -> [N, 4, 4] (4DGS, eq. 7)."""
    a, b, c, d = F.normalize(left, dim=-1).unbind(-1)
    p, q, r, s = F.normalize(right, dim=-1).unbind(-1)
    M_left = torch.stack([a, -b, -c, -d, b, a, -d, c, c, d, a, -b, d, -c, b, a], -1).unflatten(-1, (4, 4))
    M_right = torch.stack([p, q, r, s, -q, p, -s, r, -r, s, p, -q, -s, -r, q, p], -1).unflatten(-1, (4, 4))
    return M_left @ M_right
