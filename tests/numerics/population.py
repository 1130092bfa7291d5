"""Test slices of many random ill-conditioned Gaussians against float64: a million of 7DGS, thousands of other models.

The exact slices are those of the torch model in float64. mpmath would need weeks for a million Gaussians, so each audit
compares them with mpmath on a few (`verify`).
"""

import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
from torch import Generator, Tensor

from gsbench.models.beta import joint_factor, softplus_inverse
from gsbench.models.factors import CholeskyLayout
from gsbench.models.slicing import SCHEMES
from numerics import slices
from numerics.cases import ONE_SCHEME, Bound, Cell, backends_with
from numerics.slices import LN_10, Observed, SliceErrors, SliceTruth, ordinary

CHUNK = 50_000  # Gaussians in one chunk, to limit memory
SUBTRACTING = 50_000  # Gaussians that are sliced by the schemes that subtract covariances
NEVER = -110.0  # log lambda; its exp is zero in float32, so that no Gaussian is culled at any query
PERCENTILE = 0.999  # the quantile of errors over random Gaussians that must be below the bound
SEED = 0
MOVING = ("dgs", "dbs", "ubs", "freetime")
VERIFIED = 8  # Gaussians that are computed in mpmath too


def hard_slices(name: str, N: int, backends: list[str]) -> tuple[list[Cell], float]:
    """Measure the errors of N slices in float32: of 7DGS in a factor order, or of another model. Return a result for
    each scheme and backend, and the largest error of the truth against mpmath."""
    observed, cells = draw(Generator().manual_seed(SEED), name, N), []
    exact = truth(observed)
    case = "hard_slices" if name in MOVING else f"hard_slices_{name}"
    for scheme in (ONE_SCHEME,) if name in MOVING else SCHEMES:
        count = N if scheme in (ONE_SCHEME, "square_root") else min(N, SUBTRACTING)
        for backend in backends_with(scheme, observed.model, backends):
            start = time.perf_counter()
            errors = judge(rows(observed, slice(count)), exact, scheme, backend)
            ms = 1e3 * (time.perf_counter() - start)
            # Of 7DGS, means lose digits by any scheme where the block of time and direction is ill-conditioned.
            forward = errors.forward if name in MOVING else errors.shape
            at = ("population", case, observed.model, scheme, backend)
            measured = (percentile(forward), percentile(errors.gradient), float(errors.bad.double().mean()), ms)
            cells.append(Cell(*at, *measured, Bound(), f"{count} slices"))
    return cells, verify(observed)


def percentile(errors: Tensor) -> float:
    """Return the 99.9th percentile of errors; NaN counts as infinite."""
    return float(np.quantile(np.nan_to_num(errors.numpy(), nan=np.inf), PERCENTILE, method="higher"))


def rows(observed: Observed, which: slice) -> Observed:
    """Return the Gaussians that `which` selects."""
    return replace(observed, raw={name: value[which] for name, value in observed.raw.items()})


def chunks(observed: Observed) -> Iterator[slice]:
    """Yield which Gaussians to compute together."""
    return (slice(i, i + CHUNK) for i in range(0, len(observed.raw["means"]), CHUNK))


def truth(observed: Observed, weights: Tensor | None = None) -> SliceTruth:
    """Compute the slices and the gradient of a loss by the torch model in float64; `weights` are those of its terms."""
    parts = [_truth(rows(observed, which), None if weights is None else weights[which]) for which in chunks(observed)]
    return SliceTruth(*map(torch.cat, zip(*parts, strict=True)))


def _truth(observed: Observed, weights: Tensor | None) -> SliceTruth:
    model, raw = slices.load(observed, "square_root", "reference")
    double = {name: value.detach().double().requires_grad_() for name, value in raw.items()}
    zero = torch.zeros(len(double["means"]), 14 if "betas" in double else 13, dtype=torch.float64)
    outputs, _ = slices.differentiate(model.double(), double, observed, zero)
    random, scale = slices.weights_of(outputs, observed.raw["means"])
    weights = random if weights is None else weights
    return SliceTruth(outputs, weights, scale, slices.differentiate(model, double, observed, weights)[1])


def judge(observed: Observed, exact: SliceTruth, scheme: str, backend: str) -> SliceErrors:
    """Measure the errors of Gaussians in float32 by one scheme and backend; `exact` may have more of them."""
    parts = []
    for which in chunks(observed):
        some = rows(observed, which)
        at = slice(which.start, which.start + len(some.raw["means"]))
        parts.append(slices.errors_of(some, SliceTruth(*(x[at] for x in exact)), scheme, backend))
    return SliceErrors(*map(torch.cat, zip(*parts, strict=True)))


def verify(observed: Observed, count: int = VERIFIED) -> float:
    """Return the largest relative error of the float64 `truth` against mpmath, on the first `count` Gaussians."""
    first = rows(observed, slice(count))
    exact = slices.truth(first)
    approximate = truth(first, exact.weights)
    errors = slices.compare(approximate.outputs, approximate.gradient, exact)
    return float(torch.maximum(errors.forward, errors.gradient).max())


def draw(g: Generator, name: str, N: int, decades: Tensor | float = 5.0) -> Observed:
    """Draw N random Gaussians of 7DGS in a factor order, or of another model, about one size away from the query."""
    return draw_moving(g, name, N) if name in MOVING else draw_factors(g, name, N, decades)


def draw_factors(g: Generator, order: str, N: int, decades: Tensor | float = 5.0) -> Observed:
    """Draw N random 7D Gaussians with ill-conditioned triangular factors. Diagonal entries are 10^-u with u uniform in
    [0, decades], and entries below are standard normal.

    Means are at the origin, and so are the camera and the time: direction and time are exactly 0, without rounding. No
    Gaussian fades, however far its mean time and direction.
    """
    letters = slices.letters_of(order)
    layout = CholeskyLayout(letters, "raw")
    raw = {"log_diagonal": -LN_10 * decades * torch.rand(N, 7, generator=g, dtype=torch.float64)}
    raw |= layout.split(torch.randn(N, 21, generator=g, dtype=torch.float64))
    observed = [letters.index("d") + i for i in range(3)] + [letters.index("t")]  # rows of the factor
    L = layout.factor(raw["log_diagonal"], raw)[:, observed]
    offset = (L @ torch.randn(N, 7, 1, generator=g, dtype=torch.float64))[..., 0]
    raw |= {
        "means": torch.zeros(N, 3),
        "directions": offset[:, :3],
        "times": offset[:, 3:],
        "opacities": torch.zeros(N),
    }
    options = {"factor_order": order, "off_diagonal": "raw"}
    single = {name: value.float() for name, value in raw.items()}
    return Observed("7dgs", single, torch.zeros(3), 0.0, {"direction": NEVER, "time": NEVER}, options)


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
