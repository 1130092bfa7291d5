"""Compute exact conditional Gaussians, alphas, colours and gradients in mpmath, by the formulas of the papers.

The code shares nothing with the models. It forms, inverts and subtracts covariances, which is safe with DIGITS decimal
digits: the hardest case (a factor with four diagonal entries of 1e-7) has a squared condition number of 1e56, too large
for 50 digits. Gradients are central differences with a step of 1e-30, so that their error is about 1e-60 of the third
derivative.
"""

from collections.abc import Callable, Sequence
from typing import Any

from mpmath import mp, mpf

DIGITS = 120
STEP = mpf(10) ** -30
LOG_SIZE_MAX = 16  # larger log sizes act as this one, by definition (docs/stability.md)
TIME_OPACITY_FACTOR_MIN = mpf("0.05")  # 4DGS culls a Gaussian unless its f_temp is above this
UNDEFINED = mpf(10) ** -20  # |v|^2 of a vector too short to have a direction; it becomes zero

Vector = list[Any]  # of mpf
Matrix = list[Vector]
Function = Callable[[Vector], Vector]


def gradient(function: Function, at: Sequence[float], weights: Sequence[float], first: int | None = None) -> Vector:
    """Compute the gradient of the dot product `weights . function(x)` at the point x = `at` by central differences.

    If `first` is given, return only the derivatives with respect to the first `first` entries of x.
    """
    with mp.workdps(DIGITS):
        x = [mpf(v) for v in at]
        w = [mpf(v) for v in weights]
        out = []
        for i, value in enumerate(x[:first]):
            sides = []
            for moved in (value + STEP, value - STEP):
                x[i] = moved
                sides.append(mp.fdot(w, function(x)))
            x[i] = value
            out.append((sides[0] - sides[1]) / (2 * STEP))
        return out


def evaluate(function: Function, at: Sequence[float]) -> Vector:
    """Evaluate `function(at)` with DIGITS decimal digits."""
    with mp.workdps(DIGITS):
        return function([mpf(v) for v in at])


# ---- slices: mean (3), covariance (9, by rows) and opacity of the conditional 3D Gaussian


def slice_triangular(x: Vector, layout: dict[str, int], order: str, half: float, log_lambda: dict[str, float],
                     center: Sequence[float], time: float | None, relative: bool = True) -> Vector:  # fmt: skip
    """Compute the conditional 3D Gaussian of a 6DGS or 7DGS Gaussian in mpmath (7DGS eq. 9 to 12).

    Return mean (3), covariance (9, by rows) and opacity.

    Args:
        x: the raw parameters (before exp and sigmoid), concatenated.
        layout: the name and the length of each parameter in x.
        order: the variable of each row of the triangular factor, such as "dddtppp" (direction, time, position).
        half: the constant in the exponent of the opacity factor for direction, 0.5 or 1.
        log_lambda: ln lambda_d ("direction") and ln lambda_t ("time"), the learned scales of these exponents.
        center: the camera's centre.
        time: the time at which to slice; None for 6DGS.
        relative: whether off-diagonal entries between position rows are in units of their row's diagonal entry.
    """
    raw = unpack(x, layout)
    n = len(order)
    L = [[mpf(0)] * i + [size_of(raw["log_diagonal"][i])] for i in range(n)]
    kinds = {0: iter(raw["coupling"]), 1: iter(raw["motion"]), 2: iter(raw["shape"])}  # by how many of two are p
    for i in range(n):
        for j in range(i):
            in_space = (order[i] == "p") + (order[j] == "p")
            L[i][j] = next(kinds[in_space]) * (L[i][i] if relative and in_space == 2 else 1)
    lower = [[mp.fdot(L[i][: j + 1], L[j]) for j in range(i + 1)] for i in range(n)]
    S = [[lower[max(i, j)][min(i, j)] for j in range(n)] for i in range(n)]
    p, d, t = ([i for i in range(n) if order[i] == name] for name in "pdt")
    direction = unit([m - mpf(c) for m, c in zip(raw["means"], center, strict=True)])
    delta = [a - b for a, b in zip(direction, raw["directions"], strict=True)]
    exponent = half * mp.exp(mpf(log_lambda["direction"])) * _mahalanobis(block(S, d, d), delta)
    if time is not None:
        delta = [*delta, mpf(time) - raw["times"][0]]
        exponent += mp.exp(mpf(log_lambda["time"])) * delta[3] ** 2 / S[t[0]][t[0]] / 2
    mean, cov = _condition(S, p, d + t, raw["means"], delta)
    return [*mean, *cov, mp.exp(-exponent) * sigmoid(raw["opacities"][0])]


def slice_rotated(x: Vector, layout: dict[str, int], log_lambda: dict[str, float], time: float) -> Vector:
    """Compute the conditional 3D Gaussian of a 4DGS Gaussian in mpmath: mean (3), covariance (9, by rows) and opacity.

    The 4D covariance is (R s)(R s)^T with the diagonal matrix s of the four sizes. Two quaternions l and r give the
    rotation R = M_left(l) M_right(r) (4DGS eq. 5 to 9).
    """
    raw = unpack(x, layout)
    a, b, c, d = normalised(raw["left_quats"])
    p, q, r, s = normalised(raw["right_quats"])
    left = [[a, -b, -c, -d], [b, a, -d, c], [c, d, a, -b], [d, -c, b, a]]
    right = [[p, q, r, s], [-q, p, -s, r], [-r, s, p, -q], [-s, -r, q, p]]
    size = [size_of(x) for x in raw["scales"]]
    F = [[mp.fdot(left[i], [row[j] for row in right]) * size[j] for j in range(4)] for i in range(4)]
    S = [[mp.fdot(a, b) for b in F] for a in F]
    delta = mpf(time) - raw["times"][0]
    f_temp = mp.exp(-mp.exp(mpf(log_lambda["time"])) * delta**2 / S[3][3] / 2)
    mean, cov = _condition(S, [0, 1, 2], [3], raw["means"], [delta])
    return [*mean, *cov, f_temp * sigmoid(raw["opacities"][0]) if f_temp > TIME_OPACITY_FACTOR_MIN else mpf(0)]


def _condition(S: Matrix, p: list[int], q: list[int], mean: Vector, delta: Vector) -> tuple[Vector, Vector]:
    """Return the conditional mean mu_p + K delta and the conditional covariance S_pp - K S_qp, with K = S_pq S_qq^-1.

    Here p are the rows of position, q those of time and direction, and delta is the given q minus mu_q.
    """
    S_pq = block(S, p, q)
    K = solve(block(S, q, q), S_pq)
    moved = [m + mp.fdot(k, delta) for m, k in zip(mean, K, strict=True)]
    return moved, [S[p[i]][p[j]] - mp.fdot(K[i], S_pq[j]) for i in range(3) for j in range(3)]


# ---- splats: alpha of one Gaussian at pixels


def alphas(x: Vector, viewmat: Sequence[Sequence[float]], K: Sequence[Sequence[float]], size: tuple[int, int],
           pixels: Sequence[tuple[float, float]], eps2d: float) -> Vector:  # fmt: skip
    """Compute the alpha of one Gaussian at pixel centres in mpmath, without the cut-offs of 3DGS at 0.999 and 1/255.

    Alpha is opacity exp(-r^2 / 2), with the squared distances r^2 of `distances`. If x has an exponent b, it is
    opacity (1 - r^2)^b where r < 1, and zero elsewhere (Universal Beta Splatting).

    Args:
        x: mean (3), factor (9), opacity, and the exponent of a Beta profile.
        viewmat: as in `distances`, like the other arguments.
        K: see there.
        size: see there.
        pixels: see there.
        eps2d: see there.
    """
    squares = distances(x, viewmat, K, size, pixels, eps2d)
    if len(x) == 13:
        return [x[12] * mp.exp(-r2 / 2) for r2 in squares]
    return [x[12] * (1 - r2) ** x[13] if r2 < 1 else mpf(0) for r2 in squares]


def distances(x: Vector, viewmat: Sequence[Sequence[float]], K: Sequence[Sequence[float]], size: tuple[int, int],
              pixels: Sequence[tuple[float, float]], eps2d: float) -> Vector:  # fmt: skip
    """Compute r^2 = d^T S^-1 d at pixel centres in mpmath, by EWA splatting (Zwicker et al. 2001 eq. 29).

    Here d is the offset of the pixel from the projected mean, and S the 2D covariance.

    Args:
        x: mean (3) and factor (9); further entries are ignored.
        viewmat: world to camera.
        K: intrinsics.
        size: width and height of the image, pixels.
        pixels: the pixel centres.
        eps2d: added to the diagonal of the 2D covariance, pixels^2.
    """
    mean, F = x[:3], [x[3:6], x[6:9], x[9:12]]
    W = [[mpf(v) for v in row] for row in viewmat]
    px, py, pz = (mp.fdot(row[:3], mean) + row[3] for row in W[:3])
    (fx, _, cx), (_, fy, cy) = ([mpf(v) for v in row] for row in K[:2])
    u, v = fx * px / pz + cx, fy * py / pz + cy
    # The Jacobian is taken at the mean, moved to at most 15 % of the image outside of it (3DGS).
    tangents = [(min(max(u, -mpf(3) / 20 * size[0]), mpf(23) / 20 * size[0]) - cx) / fx,
                (min(max(v, -mpf(3) / 20 * size[1]), mpf(23) / 20 * size[1]) - cy) / fy]  # fmt: skip
    J = [[fx / pz, mpf(0), -fx * tangents[0] / pz], [mpf(0), fy / pz, -fy * tangents[1] / pz]]
    M = [[mp.fsum(J[a][b] * W[b][c] * F[c][e] for b in range(3) for c in range(3)) for e in range(3)] for a in range(2)]
    xx, xy, yy = (mp.fdot(M[a], M[b]) + (mpf(eps2d) if a == b else 0) for a, b in ((0, 0), (0, 1), (1, 1)))
    det = xx * yy - xy * xy
    a, b, c = yy / det, -2 * xy / det, xx / det
    offsets = ((i - u, j - v) for i, j in pixels)
    return [dx * (a * dx + b * dy) + c * dy * dy for dx, dy in offsets]


# ---- colours


def colors(x: Vector, layout: dict[str, int], center: Sequence[float], waves: int, time: float) -> Vector:
    """Compute the RGB colour of one Gaussian in mpmath, from SH and Fourier coefficients (3DGS; 4DGS eq. 12).

    The colour is max(0, 1/2 + sum of beta Y_lm(d) cos(2 pi n (t - mu_t))) with coefficients beta, SH up to degree 3 in
    the signs of 3DGS, and frequencies n. If the camera is on the mean, the direction d is undefined, and only the
    constant Y_00 is used.

    Args:
        x: means, times and sh, concatenated.
        layout: the name and the length of each parameter in x.
        center: the camera's centre.
        waves: the number of frequencies in time, including frequency 0.
        time: the time at which to compute the colour.
    """
    raw = unpack(x, layout)
    dx, dy, dz = unit([m - mpf(c) for m, c in zip(raw["means"], center, strict=True)])
    defined = any((dx, dy, dz))
    basis = [_harmonic(degree, order, dx, dy, dz) if defined or degree == 0 else mpf(0)
             for degree in range(4) for order in range(-degree, degree + 1)]  # fmt: skip
    cosines = [mp.cos(2 * mp.pi * n * (mpf(time) - raw["times"][0])) for n in range(waves)]
    Y = [c * y for c in cosines for y in basis]
    return [max(mpf(0), mp.fdot(Y, raw["sh"][channel::3]) + mpf(1) / 2) for channel in range(3)]


LEGENDRE = ((1,), (0, 1), (-0.5, 0, 1.5), (0, -1.5, 0, 2.5))  # coefficients of P_l by powers


def _harmonic(degree: int, order: int, x: Any, y: Any, z: Any) -> Any:
    """Evaluate one real spherical harmonic of degree l and order m at the unit vector (x, y, z).

    The value is N_lm (d^m P_l / dz^m) times the real or imaginary part of (x + i y)^m, with Legendre polynomial P_l,
    normalisation N_lm and the Condon-Shortley phase (-1)^m, as in 3DGS.
    """
    m = abs(order)
    scale = mp.sqrt((2 * degree + 1) / (4 * mp.pi) * mp.factorial(degree - m) / mp.factorial(degree + m))
    legendre = [mpf(c) for c in LEGENDRE[degree]]
    for _ in range(m):
        legendre = [i * c for i, c in enumerate(legendre)][1:]
    power = mp.mpc(x, y) ** m
    part = power.imag if order < 0 else power.real
    value = scale * mp.fsum(c * z**i for i, c in enumerate(legendre)) * part
    return value if order == 0 else (-1) ** m * mp.sqrt(2) * value


# ---- small parts


def unit(v: Vector) -> Vector:
    """Normalise the vector v; return zero if v is too short to have a direction."""
    square = mp.fdot(v, v)
    return [x / mp.sqrt(square) for x in v] if square > UNDEFINED else [mpf(0)] * 3


def size_of(log: Any) -> Any:
    """Return exp of a log size, which is limited to +-LOG_SIZE_MAX."""
    return mp.exp(min(max(log, mpf(-LOG_SIZE_MAX)), mpf(LOG_SIZE_MAX)))


def sigmoid(x: Any) -> Any:
    """Return 1 / (1 + exp(-x))."""
    return 1 / (1 + mp.exp(-x))


def normalised(q: Vector) -> Vector:
    """Normalise the vector q; if it is shorter than 1e-12, divide it by 1e-12."""
    length = max(mp.sqrt(mp.fdot(q, q)), mpf("1e-12"))  # as torch's normalize
    return [x / length for x in q]


def unpack(x: Vector, layout: dict[str, int]) -> dict[str, Vector]:
    """Return the parameters in x by name; `layout` has their names and lengths. Further entries of x are ignored."""
    parts, first = {}, 0
    for name, count in layout.items():
        parts[name] = x[first : first + count]
        first += count
    return parts


def block(S: Matrix, rows: list[int], columns: list[int]) -> Matrix:
    """Return the given rows and columns of S."""
    return [[S[i][j] for j in columns] for i in rows]


def _mahalanobis(S: Matrix, delta: Vector) -> Any:
    return mp.fdot(delta, solve(S, [delta])[0])


def solve(A: Matrix, B: Matrix) -> Matrix:
    """Solve A x = b by Gaussian elimination for each row b of B, for a positive definite matrix A; return the rows x.

    No pivoting is needed, because the arithmetic has many digits.
    """
    n = len(A)
    rows = [[*row, *(b[i] for b in B)] for i, row in enumerate(A)]
    for i in range(n):
        for k in range(i + 1, n):
            factor = rows[k][i] / rows[i][i]
            rows[k][i + 1 :] = [x - factor * y for x, y in zip(rows[k][i + 1 :], rows[i][i + 1 :], strict=True)]
    found: Matrix = []
    for column in range(n, n + len(B)):
        x: Vector = [mpf(0)] * n
        for i in reversed(range(n)):
            x[i] = (rows[i][column] - mp.fdot(rows[i][i + 1 : n], x[i + 1 :])) / rows[i][i]
        found.append(x)
    return found
