"""Compute exact slices of dGS, dBS, UBS and FreeTimeGS Gaussians in mpmath, by the formulas of the papers.

As in `oracle`, the code shares nothing with the models. A slice is mean (3), covariance (9, by rows), opacity and, of a
Beta profile, its exponent b. The raw parameters x of a Gaussian (before exp, softplus and sigmoid) may be followed by a
copy of its mean. dGS and dBS take the view direction from this copy, because no gradient flows through it.
"""

from collections.abc import Sequence
from typing import Any

from mpmath import mp, mpf

from gsbench.stability.oracle import Matrix, Vector, block, normalised, sigmoid, size_of, solve, unit, unpack

FADING = mpf(35) / 100  # lambda_o of dGS
LEAST_FADING = mpf("1.2e-7")  # the least 1 - tanh of UBS and dBS
SURELY_LEAST = 100  # y^2 beyond which 1 - tanh(y^2) is below it


def slice_direct(
    x: Vector, layout: dict[str, int], center: Sequence[float], time: float, coupling: str = "text"
) -> Vector:
    """Compute the 3D Gaussian of a dGS Gaussian; `coupling` is the model's option.

    Args:
        x: the raw parameters, concatenated, and the copy of the mean.
        layout: the name and the length of each parameter in x.
        center: the camera's centre.
        time: the time at which to slice.
        coupling: how the mean moves: `text`, `interpolated` or `none`.
    """
    raw = unpack(x, layout)
    delta = _difference(_direction(x[-3:], center), unit(raw["directions"]))
    delta.append(mpf(time) - sigmoid(raw["times"][0]))
    white, pulled = _whitened(raw["precision"], delta)
    view, moment = (sigmoid(share) for share in raw["shares"])
    shares = [view, view, view, moment]
    shift = [share * a for share, a in zip(shares, pulled, strict=True)]
    if coupling == "interpolated":
        shift = [a + (1 - share) * b for a, share, b in zip(shift, shares, delta, strict=True)]
    if coupling == "none":
        shift = [mpf(0)] * 4
    sizes = [size_of(log) for log in raw["scales"]]
    mean = _coupled(raw["means"], raw["coupling"], sizes, shift)
    fading = mp.exp(-FADING * mp.fdot(white, white))
    return [*mean, *_covariance(_rotation(raw["quats"]), sizes), sigmoid(raw["opacities"][0]) * fading]


def slice_direct_beta(x: Vector, layout: dict[str, int], center: Sequence[float], time: float) -> Vector:
    """Compute the 3D Gaussian of a dBS Gaussian, of direction alone if it has no mean time; see `slice_direct`."""
    raw = unpack(x, layout)
    delta = _delta(raw, _direction(x[-3:], center), time)
    white, pulled = _whitened(raw["precision"], delta)
    shape, *exponents = (4 * size_of(beta) for beta in raw["betas"])
    shift = [min(b / 4, mpf(1)) * a for b, a in zip(exponents, pulled, strict=True)]
    sizes = [_softplus_size(value) for value in raw["scales"]]
    mean = _coupled(raw["means"], raw["coupling"], sizes, shift)
    opacity = sigmoid(raw["opacities"][0]) * _beta_fading(white, exponents)
    return [*mean, *_covariance(_turn(raw["skew"]), sizes), opacity, shape]


def slice_free_time(x: Vector, layout: dict[str, int], center: Sequence[float], time: float) -> Vector:  # noqa: ARG001
    """Compute the 3D Gaussian of a FreeTimeGS Gaussian, which does not depend on `center`; see `slice_direct`."""
    raw = unpack(x, layout)
    delta = mpf(time) - raw["times"][0]
    mean = [m + v * delta for m, v in zip(raw["means"], raw["velocities"], strict=True)]
    fading = mp.exp(-((delta / size_of(raw["durations"][0])) ** 2) / 2)
    sizes = [size_of(log) for log in raw["scales"]]
    return [*mean, *_covariance(_rotation(raw["quats"]), sizes), sigmoid(raw["opacities"][0]) * fading]


def slice_universal(x: Vector, layout: dict[str, int], center: Sequence[float], time: float) -> Vector:
    """Compute the conditional 3D Gaussian of a UBS Gaussian, of direction alone if it has no mean time.

    It forms the covariance S of position p and q = (direction, time), and subtracts. With S_qq = T T^T, P = S_pq T^-T,
    y = T^-1 delta and B = diag(min(b / 4, 1)), the mean is mu_p + P B y and the covariance S_pp - P B P^T. See
    `slice_direct` for the arguments.
    """
    raw = unpack(x, layout)
    delta = _delta(raw, _direction(raw["means"], center), time)
    sizes = [_softplus_size(value) for value in raw["scales"]]
    n, lower = len(sizes), iter(raw["lower"])
    F = [[a * s for a, s in zip(row, sizes, strict=False)] + [mpf(0)] * (n - 3) for row in _turn(raw["skew"])]
    F += [[next(lower) for _ in range(i)] + [sizes[i]] + [mpf(0)] * (n - 1 - i) for i in range(3, n)]
    below = [[mp.fdot(F[i][: max(3, j + 1)], F[j]) for j in range(i + 1)] for i in range(n)]  # the rest of F[j] is zero
    S = [[below[max(i, j)][min(i, j)] for j in range(n)] for i in range(n)]
    p, q = list(range(3)), list(range(3, n))
    T = _cholesky(block(S, q, q))
    white, *P = solve(T, [delta, *block(S, p, q)])
    shape, *exponents = (4 * size_of(beta) for beta in raw["betas"])
    PB = [[a * min(b / 4, mpf(1)) for a, b in zip(row, exponents, strict=True)] for row in P]
    mean = [m + mp.fdot(row, white) for m, row in zip(raw["means"], PB, strict=True)]
    cov = [S[i][j] - mp.fdot(PB[i], P[j]) for i in p for j in p]
    return [*mean, *cov, sigmoid(raw["opacities"][0]) * _beta_fading(white, exponents), shape]


SLICES = {"dgs": slice_direct, "dbs": slice_direct_beta, "freetime": slice_free_time, "ubs": slice_universal}


# ---- small parts


def _difference(a: Vector, b: Vector) -> Vector:
    return [x - y for x, y in zip(a, b, strict=True)]


def _direction(mean: Vector, center: Sequence[float]) -> Vector:
    return unit(_difference(mean, [mpf(c) for c in center]))


def _delta(raw: dict[str, Vector], direction: Vector, time: float) -> Vector:
    """Return q - mu_q for the direction and, if the Gaussian has a mean time, the time."""
    return _difference([*direction, mpf(time)] if "times" in raw else direction,
                       raw["directions"] + raw.get("times", []))  # fmt: skip


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
    n, theta, size = len(shift), normalised(coupling), mp.fsum(sizes) / 3
    return [mean[i] + size * mp.fdot(theta[n * i : n * (i + 1)], shift) for i in range(3)]


def _beta_fading(white: Vector, exponents: Vector) -> Any:
    """Return the opacity factor prod_i (1 - tanh(y_i^2))^b_i; 1 - tanh is at least LEAST_FADING."""
    kept = [LEAST_FADING if y * y > SURELY_LEAST else max(1 - mp.tanh(y * y), LEAST_FADING) for y in white]
    return mp.exp(mp.fsum(b * mp.log(x) for b, x in zip(exponents, kept, strict=True)))


def _softplus_size(x: Any) -> Any:
    size = mp.log1p(mp.exp(x))
    return size if 1e-6 < size < 1e6 else size_of(mp.log(size))  # which holds it within exp(+-16)


def _rotation(quaternion: Vector) -> Matrix:
    w, x, y, z = normalised(quaternion)
    return [[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]]  # fmt: skip


def _turn(skew: Vector) -> Matrix:
    a, b, c = skew
    one = mpf(1)
    return [[one, a, b], [-a, one, c], [-b, -c, one]]


def _covariance(turn: Matrix, sizes: Vector) -> Vector:
    """Return the nine entries of (R S)(R S)^T by rows, for a matrix R and sizes S."""
    F = [[a * s for a, s in zip(row, sizes, strict=True)] for row in turn]
    return [mp.fdot(a, b) for a in F for b in F]


def _cholesky(S: Matrix) -> Matrix:
    n = len(S)
    T = [[mpf(0)] * n for _ in range(n)]
    for i in range(n):
        for j in range(i + 1):
            rest = S[i][j] - mp.fdot(T[i][:j], T[j][:j])
            T[i][j] = mp.sqrt(rest) if i == j else rest / T[j][j]
    return T
