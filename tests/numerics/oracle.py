"""Compute exact slices, alphas, colours and gradients of one Gaussian in mpmath, by the formulas of the papers.

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
LOG_SIZE_MAX = 16  # larger log sizes act as this one, by definition
TIME_OPACITY_FACTOR_MIN = mpf("0.05")  # 4DGS culls a Gaussian unless its f_temp is above this
UNDEFINED = mpf(10) ** -20  # |v|^2 of a vector too short to have a direction; it becomes zero
FADING = mpf(35) / 100  # lambda_o of dGS
LEAST_FADING = mpf("1.2e-7")  # the least 1 - tanh of UBS and dBS
SURELY_LEAST = 100  # y^2 beyond which 1 - tanh(y^2) is below it

Vector = list[Any]  # of mpf
Matrix = list[Vector]
Function = Callable[[Vector], Vector]
Layout = dict[str, int]  # the name and the length of each parameter in a vector


def gradient(function: Function, at: Sequence[float], weights: Sequence[float], first: int | None = None) -> Vector:
    """Compute the gradient of the dot product `weights . function(x)` at the point x = `at` by central differences. If
    `first` is given, return only the derivatives with respect to the first `first` entries of x."""
    with mp.workdps(DIGITS):
        x, w, slopes = [mpf(v) for v in at], [mpf(v) for v in weights], []
        for i, value in enumerate(x[:first]):
            sides = []
            for moved in (value + STEP, value - STEP):
                x[i] = moved
                sides.append(mp.fdot(w, function(x)))
            x[i] = value
            slopes.append((sides[0] - sides[1]) / (2 * STEP))
        return slopes


def evaluate(function: Function, at: Sequence[float]) -> Vector:
    """Evaluate `function(at)` with DIGITS decimal digits."""
    with mp.workdps(DIGITS):
        return function([mpf(v) for v in at])


# ---- slices: mean (3), covariance (9, by rows), opacity and, of a Beta profile, its exponent b
#
# x has the raw parameters of a Gaussian (before exp, softplus and sigmoid), by `layout`, and may end with a copy of its
# mean. dGS and dBS take the view direction from this copy, because no gradient flows through it.


def slice_triangular(
    x: Vector,
    layout: Layout,
    center: Sequence[float],
    time: float | None,
    order: str,
    half: float,
    log_lambda: dict[str, float],
    relative: bool = True,
) -> Vector:
    """Compute the conditional 3D Gaussian of a 6DGS or 7DGS Gaussian (7DGS eq. 9 to 12).

    Args:
        x: the raw parameters.
        layout: the parameters in x.
        center: the camera's centre.
        time: the time at which to slice; None for 6DGS.
        order: the variable of each row of the triangular factor, such as "dddtppp" (direction, time, position).
        half: the constant in the exponent of the opacity factor for direction, 0.5 or 1.
        log_lambda: ln lambda_d ("direction") and ln lambda_t ("time"), the learned scales of these exponents.
        relative: whether off-diagonal entries between position rows are in units of their row's diagonal entry.
    """
    raw, n = unpack(x, layout), len(order)
    L = [[mpf(0)] * i + [size_of(raw["log_diagonal"][i])] for i in range(n)]
    kinds = {0: iter(raw["coupling"]), 1: iter(raw["motion"]), 2: iter(raw["shape"])}  # by how many of two are p
    for i in range(n):
        for j in range(i):
            in_space = (order[i] == "p") + (order[j] == "p")
            L[i][j] = next(kinds[in_space]) * (L[i][i] if relative and in_space == 2 else 1)
    S = _gram(L)
    p, d, t = ([i for i in range(n) if order[i] == name] for name in "pdt")
    delta = _minus(_direction(raw["means"], center), raw["directions"])
    distance = mp.fdot(delta, solve(_block(S, d, d), [delta])[0])
    exponent = half * mp.exp(mpf(log_lambda["direction"])) * distance
    if time is not None:
        delta = [*delta, mpf(time) - raw["times"][0]]
        exponent += mp.exp(mpf(log_lambda["time"])) * delta[3] ** 2 / S[t[0]][t[0]] / 2
    mean, cov = _condition(S, p, d + t, raw["means"], delta)
    return [*mean, *cov, mp.exp(-exponent) * _sigmoid(raw["opacities"][0])]


def slice_rotated(
    x: Vector, layout: Layout, center: Sequence[float], time: float, log_lambda: dict[str, float]
) -> Vector:
    """Compute the conditional 3D Gaussian of a 4DGS Gaussian, which does not depend on `center` (4DGS eq. 5 to 9). The
    4D covariance is (R s)(R s)^T with the diagonal matrix s of the four sizes. Two quaternions l and r give the
    rotation R = M_left(l) M_right(r)."""
    raw = unpack(x, layout)
    a, b, c, d = _normalised(raw["left_quats"])
    p, q, r, s = _normalised(raw["right_quats"])
    left = [[a, -b, -c, -d], [b, a, -d, c], [c, d, a, -b], [d, -c, b, a]]
    right = [[p, q, r, s], [-q, p, -s, r], [-r, s, p, -q], [-s, -r, q, p]]
    size = [size_of(x) for x in raw["scales"]]
    S = _gram([[mp.fdot(left[i], [row[j] for row in right]) * size[j] for j in range(4)] for i in range(4)])
    delta = mpf(time) - raw["times"][0]
    f_temp = mp.exp(-mp.exp(mpf(log_lambda["time"])) * delta**2 / S[3][3] / 2)
    mean, cov = _condition(S, [0, 1, 2], [3], raw["means"], [delta])
    return [*mean, *cov, f_temp * _sigmoid(raw["opacities"][0]) if f_temp > TIME_OPACITY_FACTOR_MIN else mpf(0)]


def slice_direct(x: Vector, layout: Layout, center: Sequence[float], time: float, coupling: str = "text") -> Vector:
    """Compute the 3D Gaussian of a dGS Gaussian, whose mean moves by `coupling`: `text`, `interpolated` or `none`."""
    raw = unpack(x, layout)
    delta = _minus(_direction(x[-3:], center), _unit(raw["directions"]))
    delta.append(mpf(time) - _sigmoid(raw["times"][0]))
    white, pulled = _whitened(raw["precision"], delta)
    view, moment = (_sigmoid(share) for share in raw["shares"])
    shares = [view, view, view, moment]
    shift = [share * a for share, a in zip(shares, pulled, strict=True)]
    if coupling == "interpolated":
        shift = [a + (1 - share) * b for a, share, b in zip(shift, shares, delta, strict=True)]
    if coupling == "none":
        shift = [mpf(0)] * 4
    sizes = [size_of(log) for log in raw["scales"]]
    mean = _coupled(raw["means"], raw["coupling"], sizes, shift)
    fading = mp.exp(-FADING * mp.fdot(white, white))
    return [*mean, *_covariance(_rotation(raw["quats"]), sizes), _sigmoid(raw["opacities"][0]) * fading]


def slice_direct_beta(x: Vector, layout: Layout, center: Sequence[float], time: float) -> Vector:
    """Compute the 3D Gaussian of a dBS Gaussian, of direction alone if it has no mean time."""
    raw = unpack(x, layout)
    white, pulled = _whitened(raw["precision"], _delta(raw, _direction(x[-3:], center), time))
    shape, *exponents = (4 * size_of(beta) for beta in raw["betas"])
    shift = [min(b / 4, mpf(1)) * a for b, a in zip(exponents, pulled, strict=True)]
    sizes = [_softplus_size(value) for value in raw["scales"]]
    mean = _coupled(raw["means"], raw["coupling"], sizes, shift)
    opacity = _sigmoid(raw["opacities"][0]) * _beta_fading(white, exponents)
    return [*mean, *_covariance(_turn(raw["skew"]), sizes), opacity, shape]


def slice_free_time(x: Vector, layout: Layout, center: Sequence[float], time: float) -> Vector:
    """Compute the 3D Gaussian of a FreeTimeGS Gaussian, which does not depend on `center`."""
    raw = unpack(x, layout)
    delta = mpf(time) - raw["times"][0]
    mean = [m + v * delta for m, v in zip(raw["means"], raw["velocities"], strict=True)]
    fading = mp.exp(-((delta / size_of(raw["durations"][0])) ** 2) / 2)
    sizes = [size_of(log) for log in raw["scales"]]
    return [*mean, *_covariance(_rotation(raw["quats"]), sizes), _sigmoid(raw["opacities"][0]) * fading]


def slice_universal(x: Vector, layout: Layout, center: Sequence[float], time: float) -> Vector:
    """Compute the conditional 3D Gaussian of a UBS Gaussian, of direction alone if it has no mean time. With S_qq = T
    T^T, P = S_pq T^-T, y = T^-1 delta and B = diag(min(b / 4, 1)), the mean is mu_p + P B y and the covariance S_pp - P
    B P^T, for position p and q = (direction, time)."""
    raw = unpack(x, layout)
    delta = _delta(raw, _direction(raw["means"], center), time)
    sizes = [_softplus_size(value) for value in raw["scales"]]
    n, lower = len(sizes), iter(raw["lower"])
    F = [[a * s for a, s in zip(row, sizes, strict=False)] for row in _turn(raw["skew"])]
    F += [[next(lower) for _ in range(i)] + [sizes[i]] for i in range(3, n)]
    S, p, q = _gram(F), list(range(3)), list(range(3, n))
    T = mp.cholesky(mp.matrix(_block(S, q, q))).tolist()
    white, *P = solve(T, [delta, *_block(S, p, q)])
    shape, *exponents = (4 * size_of(beta) for beta in raw["betas"])
    PB = [[a * min(b / 4, mpf(1)) for a, b in zip(row, exponents, strict=True)] for row in P]
    mean = [m + mp.fdot(row, white) for m, row in zip(raw["means"], PB, strict=True)]
    cov = [S[i][j] - mp.fdot(PB[i], P[j]) for i in p for j in p]
    return [*mean, *cov, _sigmoid(raw["opacities"][0]) * _beta_fading(white, exponents), shape]


SLICES = {
    "4dgs": slice_rotated,
    "6dgs": slice_triangular,
    "7dgs": slice_triangular,
    "dgs": slice_direct,
    "dbs": slice_direct_beta,
    "freetime": slice_free_time,
    "ubs": slice_universal,
}


def _condition(S: Matrix, p: list[int], q: list[int], mean: Vector, delta: Vector) -> tuple[Vector, Vector]:
    """Return the conditional mean mu_p + K delta and the conditional covariance S_pp - K S_qp, with K = S_pq S_qq^-1.
    Here p are the rows of position, q those of time and direction, and delta is q minus mu_q."""
    S_pq = _block(S, p, q)
    K = solve(_block(S, q, q), S_pq)
    moved = [m + mp.fdot(k, delta) for m, k in zip(mean, K, strict=True)]
    return moved, [S[p[i]][p[j]] - mp.fdot(K[i], S_pq[j]) for i in range(3) for j in range(3)]


def _delta(raw: dict[str, Vector], direction: Vector, time: float) -> Vector:
    """Return q - mu_q for the direction and, if the Gaussian has a mean time, the time."""
    return _minus([*direction, mpf(time)] if "times" in raw else direction, raw["directions"] + raw.get("times", []))


def _whitened(precision: Vector, delta: Vector) -> tuple[Vector, Vector]:
    """Return L^T delta and L L^T delta; L is lower triangular over direction, and has one entry for time."""
    n, below = len(delta), iter(precision)
    L = [[mpf(0)] * n for _ in range(n)]
    for i in range(3):
        for j in range(i + 1):
            L[i][j] = size_of(next(below)) if i == j else next(below)
    if n > 3:
        L[3][3] = size_of(next(below))
    white = [mp.fsum(L[i][j] * delta[i] for i in range(n)) for j in range(n)]
    return white, [mp.fdot(row, white) for row in L]


def _coupled(mean: Vector, coupling: Vector, sizes: Vector, shift: Vector) -> Vector:
    """Return mean + V_pq shift, with V_pq = s Theta / |Theta| and the mean s of the three sizes."""
    n, theta, size = len(shift), _normalised(coupling), mp.fsum(sizes) / 3
    return [mean[i] + size * mp.fdot(theta[n * i : n * (i + 1)], shift) for i in range(3)]


def _beta_fading(white: Vector, exponents: Vector) -> Any:
    """Return the opacity factor prod_i (1 - tanh(y_i^2))^b_i; 1 - tanh is at least LEAST_FADING."""
    kept = [LEAST_FADING if y * y > SURELY_LEAST else max(1 - mp.tanh(y * y), LEAST_FADING) for y in white]
    return mp.exp(mp.fsum(b * mp.log(x) for b, x in zip(exponents, kept, strict=True)))


def _rotation(quaternion: Vector) -> Matrix:
    w, x, y, z = _normalised(quaternion)
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]


def _turn(skew: Vector) -> Matrix:
    a, b, c = skew
    return [[mpf(1), a, b], [-a, mpf(1), c], [-b, -c, mpf(1)]]


def _covariance(turn: Matrix, sizes: Vector) -> Vector:
    """Return the nine entries of (R S)(R S)^T by rows, for a matrix R and sizes S."""
    F = [[a * s for a, s in zip(row, sizes, strict=True)] for row in turn]
    return [mp.fdot(a, b) for a in F for b in F]


# ---- splats: alpha of one Gaussian at pixels


def alphas(
    x: Vector,
    viewmat: Sequence[Sequence[float]],
    K: Sequence[Sequence[float]],
    size: tuple[int, int],
    pixels: Sequence[tuple[float, float]],
    eps2d: float,
) -> Vector:
    """Compute the alpha of one Gaussian at pixel centres, without the cut-offs of 3DGS at 0.999 and 1/255. Alpha is
    opacity exp(-r^2 / 2), with the r^2 and the arguments of `distances`; x goes on with the opacity. If x has an
    exponent b too, alpha is opacity (1 - r^2)^b where r < 1, and zero elsewhere (Universal Beta Splatting)."""
    squares = distances(x, viewmat, K, size, pixels, eps2d)
    if len(x) == 13:
        return [x[12] * mp.exp(-r2 / 2) for r2 in squares]
    return [x[12] * (1 - r2) ** x[13] if r2 < 1 else mpf(0) for r2 in squares]


def distances(
    x: Vector,
    viewmat: Sequence[Sequence[float]],
    K: Sequence[Sequence[float]],
    size: tuple[int, int],
    pixels: Sequence[tuple[float, float]],
    eps2d: float,
) -> Vector:
    """Compute r^2 = d^T S^-1 d at pixel centres, by EWA splatting (Zwicker et al. 2001 eq. 29).

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
    tangents = [
        (min(max(at, -mpf(3) / 20 * extent), mpf(23) / 20 * extent) - c) / f
        for at, extent, c, f in ((u, size[0], cx, fx), (v, size[1], cy, fy))
    ]
    J = [[fx / pz, mpf(0), -fx * tangents[0] / pz], [mpf(0), fy / pz, -fy * tangents[1] / pz]]
    M = [[mp.fsum(J[a][b] * W[b][c] * F[c][e] for b in range(3) for c in range(3)) for e in range(3)] for a in range(2)]
    xx, xy, yy = (mp.fdot(M[a], M[b]) + (mpf(eps2d) if a == b else 0) for a, b in ((0, 0), (0, 1), (1, 1)))
    det = xx * yy - xy * xy
    a, b, c = yy / det, -2 * xy / det, xx / det
    offsets = ((i - u, j - v) for i, j in pixels)
    return [dx * (a * dx + b * dy) + c * dy * dy for dx, dy in offsets]


# ---- colours


def colors(x: Vector, layout: Layout, center: Sequence[float], waves: int, time: float) -> Vector:
    """Compute the RGB colour of one Gaussian from SH and Fourier coefficients (3DGS; 4DGS eq. 12). The colour is max(0,
    1/2 + sum of beta Y_lm(d) cos(2 pi n (t - mu_t))) with coefficients beta, SH up to degree 3 in the signs of 3DGS,
    and frequencies n < `waves`. If the camera is on the mean, the direction d is undefined, and only the constant Y_00
    is used."""
    raw = unpack(x, layout)
    direction = _direction(raw["means"], center)
    basis = [
        harmonic(degree, order, *direction) if any(direction) or degree == 0 else mpf(0)
        for degree in range(4)
        for order in range(-degree, degree + 1)
    ]
    cosines = [mp.cos(2 * mp.pi * n * (mpf(time) - raw["times"][0])) for n in range(waves)]
    Y = [c * y for c in cosines for y in basis]
    return [max(mpf(0), mp.fdot(Y, raw["sh"][channel::3]) + mpf(1) / 2) for channel in range(3)]


LEGENDRE = ((1,), (0, 1), (-0.5, 0, 1.5), (0, -1.5, 0, 2.5))  # coefficients of P_l by powers


def harmonic(degree: int, order: int, x: Any, y: Any, z: Any) -> Any:
    """Evaluate one real spherical harmonic of degree l and order m at the unit vector (x, y, z). The value is N_lm (d^m
    P_l / dz^m) times the real or imaginary part of (x + i y)^m, with Legendre polynomial P_l, normalisation N_lm and
    the Condon-Shortley phase (-1)^m, as in 3DGS."""
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


def size_of(log: Any) -> Any:
    """Return exp of a log size, which is limited to +-LOG_SIZE_MAX."""
    return mp.exp(min(max(log, mpf(-LOG_SIZE_MAX)), mpf(LOG_SIZE_MAX)))


def _softplus_size(x: Any) -> Any:
    size = mp.log1p(mp.exp(x))
    return size if 1e-6 < size < 1e6 else size_of(mp.log(size))  # which holds it within exp(+-16)


def _sigmoid(x: Any) -> Any:
    return 1 / (1 + mp.exp(-x))


def _minus(a: Vector, b: Vector) -> Vector:
    return [x - y for x, y in zip(a, b, strict=True)]


def _direction(mean: Vector, center: Sequence[float]) -> Vector:
    return _unit(_minus(mean, [mpf(c) for c in center]))


def _unit(v: Vector) -> Vector:
    """Normalise a vector; return zero if it is too short to have a direction."""
    square = mp.fdot(v, v)
    return [x / mp.sqrt(square) for x in v] if square > UNDEFINED else [mpf(0)] * 3


def _normalised(q: Vector) -> Vector:
    """Normalise a vector; if it is shorter than 1e-12, divide it by 1e-12, as torch's normalize."""
    length = max(mp.sqrt(mp.fdot(q, q)), mpf("1e-12"))
    return [x / length for x in q]


def unpack(x: Vector, layout: Layout) -> dict[str, Vector]:
    """Return the parameters in x by name; further entries are ignored."""
    parts, first = {}, 0
    for name, count in layout.items():
        parts[name] = x[first : first + count]
        first += count
    return parts


def _block(S: Matrix, rows: list[int], columns: list[int]) -> Matrix:
    return [[S[i][j] for j in columns] for i in rows]


def _gram(F: Matrix) -> Matrix:
    """Return F F^T; rows may end early, for the rest is zero."""
    below = [[mp.fdot(a, b) for b in F[: i + 1]] for i, a in enumerate(F)]
    return [[below[max(i, j)][min(i, j)] for j in range(len(F))] for i in range(len(F))]


def solve(A: Matrix, B: Matrix) -> Matrix:
    """Solve A x = b by Gaussian elimination for each row b of B; return the rows x. No pivoting is needed for a
    positive definite or triangular matrix A, because the arithmetic has many digits."""
    n = len(A)
    rows = [[*row, *(b[i] for b in B)] for i, row in enumerate(A)]
    for i in range(n):
        for k in range(i + 1, n):
            factor = rows[k][i] / rows[i][i]
            rows[k][i + 1 :] = [x - factor * y for x, y in zip(rows[k][i + 1 :], rows[i][i + 1 :], strict=True)]
    solutions: Matrix = []
    for column in range(n, n + len(B)):
        x: Vector = [mpf(0)] * n
        for i in reversed(range(n)):
            x[i] = (rows[i][column] - mp.fdot(rows[i][i + 1 : n], x[i + 1 :])) / rows[i][i]
        solutions.append(x)
    return solutions
