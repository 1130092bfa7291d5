"""Test slices of many random ill-conditioned Gaussians against float64: a million of 7DGS, thousands of other models.

The exact slices are those of the torch model in float64. mpmath would need weeks for a million Gaussians, so each audit
compares them with mpmath on a few (`verify`, `verify_moving`).
"""

import time
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Generator, Tensor, nn

from gsbench.kernels.backends import BACKENDS
from gsbench.models import CameraTime, build
from gsbench.models.beta import joint_factor, softplus_inverse
from gsbench.models.cholesky import FACTOR_ORDERS, CholeskyModel
from gsbench.models.factors import KINDS, CholeskyLayout
from gsbench.models.slicing import SCHEMES
from numerics import oracle, slices
from numerics.cases import ONE_SCHEME, Bound, Cell, backends_with, device_of
from numerics.slices import LN_10, Observed, ordinary

Floats = NDArray[np.float64]
CHUNK = 50_000  # Gaussians in one chunk, to limit memory
SUBTRACTING = 50_000  # Gaussians that are sliced by the schemes that subtract covariances
BELOW = np.tril_indices(7, -1)
NEVER = -110.0  # log lambda; its exp is zero in float32, so that no Gaussian is culled at any query
PERCENTILE = 0.999  # the quantile of errors over random Gaussians that must be below the bound
SEED = 0
MOVING = ("dgs", "dbs", "ubs", "freetime")
VERIFIED, VERIFIED_MOVING = 8, 2  # Gaussians that are computed in mpmath too


@dataclass(frozen=True)
class Hard:
    """Raw parameters of 7D Gaussians with ill-conditioned covariance factors and means at the origin. They are
    conditioned on time 0 and on a camera at the origin, so that direction and time are exactly 0, without rounding."""

    log_diagonal: Tensor  # [N, 7] float32
    off_diagonal: Tensor  # [N, 21] entries of the factor, row by row
    offset: Tensor  # [N, 4] mu_d, mu_t

    def __len__(self) -> int:
        return len(self.offset)

    def rows(self, which: slice) -> "Hard":
        """Return the Gaussians that `which` selects."""
        return Hard(self.log_diagonal[which], self.off_diagonal[which], self.offset[which])


@dataclass(frozen=True)
class PopulationTruth:
    """The exact conditional means and covariances, and the gradient of a loss by the raw parameters of the factor."""

    mean: Tensor  # [N, 3]
    cov: Tensor  # [N, 3, 3]
    gradient: Tensor  # [N, 28]


@dataclass(frozen=True)
class Errors:
    """The relative errors of covariance and gradient of each Gaussian; NaN and infinity are kept."""

    cov: Floats
    gradient: Floats
    bad: NDArray[np.bool_]  # not finite, or an indefinite covariance


def percentile(errors: Floats) -> float:
    """Return the 99.9th percentile of errors; NaN counts as infinite."""
    return float(np.quantile(np.nan_to_num(errors, nan=np.inf), PERCENTILE, method="higher"))


# ---- 7DGS


def hard_slices(order: str, N: int, backends: list[str]) -> tuple[list[Cell], float]:
    """Measure the errors of N slices of 7DGS whose factors have diagonal entries down to 1e-5. Return a result for each
    scheme and backend, and the largest error of the truth against mpmath."""
    hard = draw(Generator().manual_seed(SEED), N, order)
    exact, cells = truth(hard, order), []
    for scheme in SCHEMES:
        count = N if scheme == "square_root" else min(N, SUBTRACTING)
        for backend in backends_with(scheme, "7dgs", backends):
            start = time.perf_counter()
            errors = judge(hard.rows(slice(count)), exact, order, scheme, backend)
            ms = 1e3 * (time.perf_counter() - start)
            at = ("population", f"hard_slices_{order}", "7dgs", scheme, backend)
            measured = (percentile(errors.cov), percentile(errors.gradient), float(errors.bad.mean()), ms)
            cells.append(Cell(*at, *measured, Bound(), f"{count} slices"))
    return cells, verify(hard, order)


def draw(generator: Generator, N: int, order: str, decades: Tensor | float = 5.0) -> Hard:
    """Draw N random 7D Gaussians with ill-conditioned triangular factors. Diagonal entries are 10^-u with u uniform in
    [0, decades], and entries below are standard normal. The direction and time of the view are about one standard
    deviation from the means of the Gaussians."""
    u = torch.rand(N, 7, generator=generator, dtype=torch.float64)
    log_diagonal = -(decades * u) * np.log(10.0)
    off_diagonal = torch.randn(N, 21, generator=generator, dtype=torch.float64)
    L = factor(Hard(log_diagonal, off_diagonal, u))
    q = conditioned(order)
    offset = np.einsum("nij,nj->ni", L[:, q], torch.randn(N, 7, generator=generator, dtype=torch.float64).numpy())
    return Hard(log_diagonal.float(), off_diagonal.float(), torch.from_numpy(offset).float())


def factor(hard: Hard) -> Floats:
    """Return the lower triangular factors [N, 7, 7] of the 7D covariances in float64."""
    L = np.zeros((len(hard), 7, 7))
    L[:, *BELOW] = hard.off_diagonal.double().numpy()
    L[:, range(7), range(7)] = np.exp(hard.log_diagonal.double().numpy())
    return L


def conditioned(order: str) -> list[int]:
    """Return the indices of those rows of the triangular factor that belong to direction (first) and time (last)."""
    return [4, 5, 6, 3] if order == "paper" else [0, 1, 2, 3]


def weights(N: int) -> tuple[Tensor, Tensor]:
    """Return fixed random weights of means [N, 3] and covariances [N, 3, 3] in the loss."""
    random = np.random.default_rng(1)
    W = random.standard_normal((N, 3, 3))
    return torch.from_numpy(random.standard_normal((N, 3))), torch.from_numpy(W + W.transpose(0, 2, 1))


def truth(hard: Hard, order: str) -> PopulationTruth:
    """Compute the exact conditional means and covariances, and the gradient of a loss, in float64. The loss is w . mean
    / |mean| + <W, cov> / |cov| with the random `weights` w and W, and exact |mean| and |cov|."""
    model, (w, W) = all_seen(order, "square_root", "reference").double(), weights(len(hard))
    double = Hard(*(x.double() for x in (hard.log_diagonal, hard.off_diagonal, hard.offset)))
    parts = [_differentiated(model, double, w, W, slice(i, i + CHUNK))[0] for i in range(0, len(hard), CHUNK)]
    return PopulationTruth(*map(torch.cat, zip(*parts, strict=True)))


def _differentiated(
    model: CholeskyModel, hard: Hard, w: Tensor, W: Tensor, rows: slice, exact: PopulationTruth | None = None
) -> tuple[tuple[Tensor, Tensor, Tensor], Tensor]:
    """Slice Gaussians `rows` in their type, relative to `exact`; None: to themselves. Return means, covariances and
    gradients of the loss in float64, and which covariances are indefinite or whose factors are not finite."""
    some = hard.rows(rows)
    leaves = some.log_diagonal.clone().requires_grad_(), some.off_diagonal.clone().requires_grad_()
    raw = raw_parameters(Hard(*leaves, some.offset), model)
    there = {name: value.to(device_of(model.backend.name)) for name, value in raw.items()}
    out = model.slice_geometry(there, at_the_origin(model, some.offset.dtype))
    mean, F = out.means.cpu(), out.factors.cpu().double()
    cov = F @ F.mT
    sizes = (mean.detach(), cov.detach()) if exact is None else (exact.mean[rows], exact.cov[rows])
    loss = (w[rows] * mean / sizes[0].norm(dim=1, keepdim=True)).sum()
    loss = loss + (W[rows] * cov / sizes[1].norm(dim=(1, 2), keepdim=True)).sum()
    gradient = torch.cat(torch.autograd.grad(loss, leaves), 1).double()
    bad = slices.indefinite(model, raw) | ~F.isfinite().all((1, 2))
    return (mean.detach(), cov.detach(), gradient), bad.detach()


def verify(hard: Hard, order: str, count: int = VERIFIED) -> float:
    """Return the largest relative error of the float64 `truth` against mpmath, on the first `count` Gaussians."""
    some = hard.rows(slice(count))
    approximate = truth(some, order)
    w, W = (x.numpy() for x in weights(count))
    exact, largest = _oracle(order), 0.0
    for i in range(count):
        raw = [some.log_diagonal[i], some.off_diagonal[i], torch.zeros(3), some.offset[i], torch.zeros(1)]
        x = torch.cat(raw).tolist()
        values = np.array(oracle.evaluate(exact, x), float)
        mean, cov = values[:3], values[3:12]
        weight = np.concatenate([w[i] / np.linalg.norm(mean), W[i].ravel() / np.linalg.norm(cov), [0]])
        gradient = np.array(oracle.gradient(exact, x, weight.tolist(), first=28), float)
        for got, true in ((approximate.cov[i].flatten().numpy(), cov), (approximate.gradient[i].numpy(), gradient)):
            largest = max(largest, float(np.linalg.norm(got - true) / np.linalg.norm(true)))
    return largest


def _oracle(order: str) -> oracle.Function:
    layout = {"log_diagonal": 7, "shape": 3, "motion": 12, "coupling": 6}
    layout |= {"means": 3, "directions": 3, "times": 1, "opacities": 1}
    names = "".join(x * (1 if x == "t" else 3) for x in FACTOR_ORDERS[order])
    log_lambda = {"direction": NEVER, "time": NEVER}
    places = CholeskyLayout(names).places
    kinds = [7 + place for kind in KINDS for place in places[kind]]
    return lambda x: oracle.slice_triangular(
        [*x[:7], *(x[i] for i in kinds), *x[28:]], layout, [0.0] * 3, 0.0, names, 0.5, log_lambda, relative=False
    )


def judge(hard: Hard, exact: PopulationTruth, order: str, scheme: str, backend: str) -> Errors:
    """Measure the float32 errors of the conditional 3D Gaussians by one scheme and backend."""
    model, (w, W), parts = all_seen(order, scheme, backend), weights(len(hard)), []
    for i in range(0, len(hard), CHUNK):
        rows = slice(i, i + CHUNK)
        (mean, cov, gradient), bad = _differentiated(model, hard, w, W, rows, exact)
        bad |= ~(mean.isfinite().all(1) & gradient.isfinite().all(1))
        cov_error = (cov - exact.cov[rows]).norm(dim=(1, 2)) / exact.cov[rows].norm(dim=(1, 2))
        gradient_error = (gradient - exact.gradient[rows]).norm(dim=1) / exact.gradient[rows].norm(dim=1)
        parts.append((cov_error.numpy(), gradient_error.numpy(), bad.numpy()))
    return Errors(*(np.concatenate(x) for x in zip(*parts, strict=True)))


def all_seen(order: str, scheme: str, backend: str) -> CholeskyModel:
    """Make a 7DGS model in which opacity does not depend on time and direction (the factors f_temp and f_dir are 1)."""
    form = {"factor_order": order, "scheme": scheme, "off_diagonal": "raw", "backend": BACKENDS[backend]}
    model = build("7dgs", lambda_d=1.0, lambda_t=1.0, **form)
    for name in ("direction", "time"):
        model.log_lambda[name] = nn.Parameter(torch.tensor(NEVER))
    return model.to(device_of(backend))


def at_the_origin(model: CholeskyModel, dtype: torch.dtype = torch.float32) -> CameraTime:
    """Return the viewpoint and the time at which `Hard` Gaussians are sliced, on the device of a model."""
    there = {"device": device_of(model.backend.name), "dtype": dtype}
    return CameraTime(torch.zeros(3, **there), torch.zeros((), **there))


def raw_parameters(hard: Hard, model: CholeskyModel) -> dict[str, Tensor]:
    """Return the raw parameters of the given 7D Gaussians for a model made by `all_seen`."""
    directions, times = hard.offset.split([3, 1], 1)
    return {
        "means": torch.zeros_like(directions),
        "directions": directions,
        "times": times,
        "log_diagonal": hard.log_diagonal,
        **model.layout.split(hard.off_diagonal),
        "opacities": torch.zeros_like(times[:, 0]),
    }


# ---- dGS, dBS, UBS and FreeTimeGS


def moving_slices(name: str, N: int, backends: list[str]) -> tuple[list[Cell], float]:
    """Measure the errors of N random slices of a model in float32. Return a result for each backend, and the largest
    error of the truth against mpmath."""
    observed, cells = draw_moving(Generator().manual_seed(SEED), name, N), []
    exact = moving_truth(observed)
    for backend in backends:
        start = time.perf_counter()
        model, raw = slices.load(observed, ONE_SCHEME, backend)
        errors = slices.compare(*slices.differentiate(model, raw, observed, exact.weights), exact)
        ms = 1e3 * (time.perf_counter() - start)
        forward, gradient = (percentile(x.numpy()) for x in (errors.forward, errors.gradient))
        at, bad = ("population", "hard_slices", name, ONE_SCHEME, backend), errors.bad.double().mean().item()
        cells.append(Cell(*at, forward, gradient, bad, ms, Bound(), f"{N} slices"))
    return cells, verify_moving(observed)


def moving_truth(observed: Observed, weights: Tensor | None = None) -> slices.SliceTruth:
    """Compute the slices and the gradient of a loss by the torch model in float64."""
    model, raw = slices.load(observed, ONE_SCHEME, "reference")
    double = {name: value.detach().double().requires_grad_() for name, value in raw.items()}
    zero = torch.zeros(len(double["means"]), 14 if "betas" in double else 13, dtype=torch.float64)
    outputs, _ = slices.differentiate(model.double(), double, observed, zero)
    random, scale = slices.weights_of(outputs, observed.raw["means"])
    weights = random if weights is None else weights
    return slices.SliceTruth(outputs, weights, scale, slices.differentiate(model, double, observed, weights)[1])


def verify_moving(observed: Observed) -> float:
    """Return the largest error of `moving_truth` against mpmath, on the first Gaussians."""
    first = replace(observed, raw={name: value[:VERIFIED_MOVING] for name, value in observed.raw.items()})
    exact = slices.truth(first)
    approximate = moving_truth(first, exact.weights)
    errors = slices.compare(approximate.outputs, approximate.gradient, exact)
    return float(torch.maximum(errors.forward, errors.gradient).max())


def draw_moving(g: Generator, model: str, N: int) -> Observed:
    """Draw N random Gaussians with sizes 10^-u, u uniform in [0, 5], about one size away from the time and direction.
    In dGS, dBS and FreeTimeGS the lives and widths of view are 10^-v, v uniform in [-1, 2]."""
    observed = ordinary(g, model, N)
    raw = observed.raw

    def normal(width: int) -> Tensor:
        return torch.randn(N, width, generator=g)

    def logs(width: int, least: float, most: float) -> Tensor:
        return -LN_10 * (least + (most - least) * torch.rand(N, width, generator=g))

    if "betas" in raw:
        raw["betas"] = normal(raw["betas"].shape[1])
        raw["scales"][:, :3] = softplus_inverse(logs(3, 0, 5).exp().double()).float()
    else:
        raw["scales"] = logs(3, 0, 5)
    towards = observed.towards()
    if model == "freetime":
        raw["durations"], raw["velocities"] = logs(1, -1, 2), normal(3)
        raw["times"] = observed.time + raw["durations"].exp() * normal(1)
    elif model == "ubs":
        raw["scales"][:, 3:] = softplus_inverse(logs(4, 0, 5).exp().double()).float()
        raw["lower"] = normal(raw["lower"].shape[1])
        offset = (joint_factor(raw)[:, 3:] @ normal(7)[..., None])[..., 0]
        raw["directions"], raw["times"] = towards - offset[:, :3], observed.time - offset[:, 3:]
    else:
        raw["precision"], raw["coupling"] = normal(7), normal(12)
        diagonal = [0, 2, 5, 6]
        raw["precision"][:, diagonal] = -logs(4, -1, 2)
        offset = normal(4) * raw["precision"][:, diagonal].neg().exp()
        raw["directions"] = towards - offset[:, :3]
        times = observed.time - offset[:, 3:]
        raw["times"] = times.clamp(1e-3, 1 - 1e-3).logit() if model == "dgs" else times
    return observed
