"""Compute factors F of covariances S = F F^T from raw parameters: triangular (6DGS, 7DGS) or rotated (3DGS, 4DGS)."""

import torch
import torch.nn.functional as F
from scipy.spatial.transform import Rotation
from torch import Tensor

from gsbench.errors import InputError, did_you_mean
from gsbench.kernels.headers import LOG_SIZE_MAX
from gsbench.models.slicing import triangularise

OFF_DIAGONALS = ("relative", "raw", "row_scaled")  # forms of `Triangle`; math/off_diagonal.h has them in this order
KINDS = ("shape", "motion", "coupling")  # kinds of entries below the diagonal


def sizes(logs: Tensor) -> Tensor:
    """Compute exp of log sizes of any shape, clamped to +-LOG_SIZE_MAX; a clamped one has a gradient of zero."""
    return logs.clamp(-LOG_SIZE_MAX, LOG_SIZE_MAX).exp()


class Triangle:
    """The layout of a triangular factor over p, t and d: which entries are shape, motion and coupling.

    Below the diagonal of L there are three kinds of entries. Each has its own unit and so its own learning rate.
    `shape`, in the rows and columns of p, is the skew of a slice relative to the Gaussian's size. `motion`, in the rows
    of p and the columns of t and d, is how far a slice moves for one standard deviation of t or d, in world units; in a
    factor over (p, t, d) it is how far t and d move for one of p. `coupling` is the rest, among t and d.
    """

    def __init__(self, letters: str, form: str = "relative") -> None:
        """Lay out the factor whose rows are `letters`, such as "dddtppp".

        Args:
            letters: the variable of each row: "p", "t" or "d".
            form: `relative`: entries of shape are in units of their row's diagonal, so that they mean the same for a
                Gaussian of any size; `raw`: a parameter is the entry itself, as in the 7DGS paper; `row_scaled`: an
                entry is (2 sigmoid(x) - 1) times its row's diagonal, as in the authors' later code.

        Raises:
            InputError: the form is unknown.
        """
        if form not in OFF_DIAGONALS:
            raise InputError(f"off_diagonal '{form}' is not known. {did_you_mean(form, OFF_DIAGONALS)}")
        self.form = form
        self.letters = letters
        below = [(i, j) for i in range(len(letters)) for j in range(i)]  # row by row, as `split` takes them
        places: dict[str, list[int]] = {"shape": [], "motion": [], "coupling": []}
        for place, (i, j) in enumerate(below):
            in_space = (letters[i] + letters[j]).count("p")
            places[("coupling", "motion", "shape")[in_space]].append(place)
        self.places = places  # by kind, the places of its entries among all
        self.kinds = tuple(kind for kind in KINDS if places[kind])  # a factor over (t, p) has no coupling
        self.rows = [i for i, _ in below]
        order = [place for kind in KINDS for place in places[kind]]
        self.columns = sorted(range(len(order)), key=order.__getitem__)  # of (shape, motion, coupling), for each place
        relative = {"relative": places["shape"], "raw": [], "row_scaled": range(len(below))}[form]
        self.is_relative = torch.tensor([place in relative for place in range(len(below))])

    def pair(self, place: int) -> tuple[str, str]:
        """Return the variables of the row and the column of an entry below the diagonal."""
        row = self.rows[place]
        return self.letters[row], self.letters[place - row * (row - 1) // 2]

    def factor(self, log_diagonal: Tensor, kinds: dict[str, Tensor]) -> Tensor:
        """Compute the lower triangular L, whose diagonal is positive by exp (7DGS, section 4.1).

        Args:
            log_diagonal: [N, n] logarithms of the diagonal.
            kinds: the parameters of `self.kinds`, [N, 3], [N, 3 k] and [N, k (k - 1) / 2] for n = k + 3.
        """  # [N, n, n]
        n = log_diagonal.shape[-1]
        diagonal = sizes(log_diagonal)
        x = self.join(kinds)
        if self.form == "row_scaled":
            x = 2 * torch.sigmoid(x) - 1
        x = torch.where(self.is_relative.to(x.device), x * diagonal[:, self.rows], x)
        rows = zip(x.split(list(range(n)), -1), diagonal.split(1, -1), strict=True)
        return torch.stack([F.pad(torch.cat(row, -1), (0, n - 1 - i)) for i, row in enumerate(rows)], 1)

    def parameters(self, factor: Tensor) -> dict[str, Tensor]:
        """Invert `factor`: compute log_diagonal, shape, motion and coupling of any square factor [N, n, n] of S.

        The form `row_scaled` cannot express entries as large as their row's diagonal; they are cut to 99.9 % of it.
        """
        n = factor.shape[-1]
        L, _ = triangularise(factor, n)
        L = L * torch.where(L.diagonal(dim1=1, dim2=2) < 0, -1.0, 1.0)[:, None, :]
        diagonal = L.diagonal(dim1=1, dim2=2)
        i, j = torch.tril_indices(n, n, -1, device=factor.device)
        x = L[:, i, j]
        x = torch.where(self.is_relative.to(x.device), x / diagonal[:, self.rows], x)
        if self.form == "row_scaled":
            x = 2 * torch.atanh(x.clamp(-0.999, 0.999))
        return {"log_diagonal": diagonal.log()} | self.split(x)

    def split(self, below: Tensor) -> dict[str, Tensor]:
        """Sort the parameters below the diagonal, [N, n (n - 1) / 2] row by row, by their kind."""
        return {kind: below[:, self.places[kind]] for kind in self.kinds}

    def join(self, kinds: dict[str, Tensor]) -> Tensor:
        """Invert `split`."""
        return torch.cat([kinds[kind] for kind in self.kinds], -1)[:, self.columns]


def rotation(quaternions: Tensor) -> Tensor:
    """Compute the rotation matrices of quaternions wxyz of any length but zero, [N, 4] -> [N, 3, 3]."""
    w, x, y, z = F.normalize(quaternions, dim=-1).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def turn_of_space(quaternions: Tensor) -> Tensor:
    """Compute the quaternion of the rotation of space that a left one makes with its partner, [N, 4] -> [N, 4].

    M_left(l) M_right(r) keeps the axis of t only for r = (l0, -l1, -l2, l3), up to its length. It then rotates space as
    `rotation` does by (l0, l3, -l2, l1), because x comes first and t last in these matrices. The function is its own
    inverse, so it also computes the left quaternion of a rotation of space.
    """
    w, x, y, z = quaternions.unbind(-1)
    return torch.stack([w, z, -y, x], -1)


def partner(left: Tensor) -> Tensor:
    """Return the right quaternions with which left ones rotate space only, [N, 4]; see `turn_of_space`."""
    return left * left.new_tensor([1, -1, -1, 1])


def quaternion(rotations: Tensor) -> Tensor:
    """Compute the quaternions wxyz of rotation matrices [N, 3, 3], [N, 4], by scipy."""
    xyzw = Rotation.from_matrix(rotations.double().cpu().numpy()).as_quat()
    return torch.from_numpy(xyzw).roll(1, -1).to(rotations)


def rotation4d(left: Tensor, right: Tensor) -> Tensor:
    """Compute the 4D rotation M_left(l) M_right(r) of two quaternions, [N, 4] and [N, 4] -> [N, 4, 4] (4DGS, eq. 7)."""
    a, b, c, d = F.normalize(left, dim=-1).unbind(-1)
    p, q, r, s = F.normalize(right, dim=-1).unbind(-1)
    M_left = torch.stack([a, -b, -c, -d, b, a, -d, c, c, d, a, -b, d, -c, b, a], -1).unflatten(-1, (4, 4))
    M_right = torch.stack([p, q, r, s, -q, p, -s, r, -r, s, p, -q, -s, -r, q, p], -1).unflatten(-1, (4, 4))
    return M_left @ M_right


def quaternions_in_space(quats: Tensor) -> tuple[Tensor, Tensor]:  # [N, 4] wxyz
    """Return the two quaternions of `rotation4d` that turn (x, y, z) by a quaternion wxyz and leave t as it is.

    `rotation4d(l, r)` maps v = x + y i + z j + t k to l v r*. It leaves k as it is where r = k* l k, and then turns
    v k* = t - z i + y j - x k by l: the axis (x, y, z) is (z, -y, x) there.
    """
    w, x, y, z = quats.unbind(-1)
    return torch.stack([w, z, -y, x], -1), torch.stack([w, -z, y, x], -1)
