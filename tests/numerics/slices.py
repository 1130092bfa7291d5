"""Test the conditional 3D Gaussians of every model in float32 against mpmath: extreme Gaussians, a camera and a time.

The first cases are of the models that condition a covariance (4DGS, 6DGS, 7DGS), the others of those that move 3D
Gaussians or have Beta profiles (dGS, dBS, UBS, FreeTimeGS). Of the latter, the audit's short form tests the first model
of each case.
"""

import functools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Generator, Tensor, nn
from torch.nn.functional import normalize

from gsbench.kernels.backends import BACKENDS
from gsbench.kernels.headers import ALPHA_MIN, LOG_SIZE_MAX
from gsbench.models import CameraTime, GaussianModel, build
from gsbench.models.cholesky import FACTOR_ORDERS, WIDTH
from gsbench.models.factors import CholeskyLayout
from gsbench.models.gaussian_batch import tensors_of
from gsbench.models.slicing import SCHEMES, subtract
from numerics import oracle
from numerics.cases import COPIES, ONE_SCHEME, Case, Cell, backends_with, case, device_of, fastest, worst

COUNT = 4  # Gaussians in a case; the truth of each takes about a hundred evaluations in mpmath
LN_10 = math.log(10)
TRIANGULAR = ("6dgs", "7dgs")
TIME_LIKE = ("4dgs", "7dgs")
JOINT = ("4dgs", "6dgs", "7dgs")
COUPLINGS = {"dgs_interpolated": "interpolated", "dgs_o": "none"}  # models that are dGS with another `coupling`
MOVING = ("dgs", *COUPLINGS, "dbs", "dbs_static", "ubs", "ubs_static", "freetime")
TIME = 0.4
SPREAD = 0.3  # standard deviation of raw parameters


@dataclass
class Observed:
    """Gaussians of one model, and the camera centre and time for which conditional 3D Gaussians are computed."""

    model: str
    raw: dict[str, Tensor]  # float32, by the model's own names
    center: Tensor
    time: float = TIME
    log_lambda: dict[str, float] = field(default_factory=dict)
    options: dict[str, str] = field(default_factory=dict)  # of the model, beside those in OPTIONS

    @property
    def family(self) -> str:
        """The name of the model's formulas, such as dgs."""
        return self.model.split("_")[0]

    @property
    def has_sphere(self) -> bool:
        """Whether directions are compared with unit vectors."""
        return "directions" in self.raw

    def towards(self) -> Tensor:
        """The directions [N, 3] from the camera to the means."""
        return normalize(self.raw["means"] - self.center, dim=-1)


def ordinary(g: Generator, model: str, N: int = COUNT) -> Observed:
    """Draw random visible Gaussians like those at the start of training, which are not numerically hard."""
    return (_joint if model in JOINT else _moving)(g, model, N)


def _joint(g: Generator, model: str, N: int) -> Observed:
    observed = Observed(model, {"means": torch.rand(N, 3, generator=g) * 2 - 1}, torch.tensor([0.3, -0.2, -4.0]))
    raw = observed.raw
    raw["opacities"] = torch.randn(N, generator=g)
    if model == "4dgs":
        raw["times"] = TIME + 0.1 * torch.randn(N, 1, generator=g)
        raw["scales"] = torch.randn(N, 4, generator=g) * SPREAD - 1
        raw["left_quats"], raw["right_quats"] = (torch.randn(N, 4, generator=g) for _ in range(2))
        observed.log_lambda = {"time": 0.0}
        return observed
    n = len(variables(model))
    raw["directions"] = observed.towards() + 0.2 * torch.randn(N, 3, generator=g)
    raw["log_diagonal"] = SPREAD * torch.randn(N, n, generator=g) - 0.5
    raw |= CholeskyLayout(variables(model)).split(SPREAD * torch.randn(N, n * (n - 1) // 2, generator=g))
    observed.log_lambda = {"direction": math.log(0.35)}
    if model == "7dgs":
        raw["times"] = TIME + 0.1 * torch.randn(N, 1, generator=g)
        observed.log_lambda["time"] = math.log(0.35)
    return observed


def _moving(g: Generator, model: str, N: int) -> Observed:
    def random(*shape: int) -> Tensor:
        return SPREAD * torch.randn(N, *shape, generator=g)

    raw = {"means": torch.rand(N, 3, generator=g) * 2 - 1, "opacities": random() / SPREAD}
    observed = Observed(model, raw, torch.tensor([0.3, -0.2, -4.0]), single(TIME))
    kind, timed = observed.family, not model.endswith("_static")
    C = 3 + timed
    if timed:
        times = observed.time + random(1) / 3
        raw["times"] = times.logit() if kind == "dgs" else times
    if kind == "freetime":
        raw |= {"scales": random(3) - 1, "quats": random(4), "durations": random(1) - 1, "velocities": random(3)}
        return observed
    raw["directions"] = observed.towards() + random(3)
    raw["scales"] = random(3 + (C if kind == "ubs" else 0)) - 1
    if kind == "dgs":
        raw |= {"quats": random(4), "shares": random(2) - 1}
    else:
        raw |= {"skew": random(3), "betas": random(1 + C)}
    if kind == "ubs":
        raw["lower"] = random(3 * C + C * (C - 1) // 2)
    else:
        raw |= {"precision": random(7 if timed else 6), "coupling": random(3 * C)}
    return observed


def single(x: float) -> float:
    """Round to float32."""
    return float(torch.tensor(x, dtype=torch.float32))


def hard(*models: str) -> Callable[..., Any]:
    """Return a decorator that makes a case of a function `(observed, severity, g)` that changes ordinary Gaussians."""

    def enter(harden: Callable[[Observed, float, Generator], None]) -> Any:
        @functools.wraps(harden)
        def build(g: Generator, severity: float, model: str) -> Observed:
            observed = ordinary(g, model)
            harden(observed, severity, g)
            return observed

        return case("slicing", *models)(build)

    return enter


# ---- parts of 4DGS, 6DGS and 7DGS


def variables(model: str) -> str:
    """Return the variable of each row of the triangular factor: d (direction), t (time) or p (position)."""
    return "dddtppp" if model == "7dgs" else "dddppp"


def letters_of(order: str) -> str:
    """Return the same for 7DGS in a factor order."""
    return "".join(x * WIDTH[x] for x in FACTOR_ORDERS[order])


def _rows(observed: Observed, variable: str) -> list[int]:
    return [i for i, name in enumerate(variables(observed.model)) if name == variable]


def sizes(observed: Observed, variable: str) -> Tensor:
    """Return the log sizes (log diagonal entries) [N, width] of position, time or direction, as a view."""
    if observed.model == "4dgs":
        return observed.raw["scales"][:, 3:] if variable == "t" else observed.raw["scales"][:, :3]
    rows = _rows(observed, variable)
    return observed.raw["log_diagonal"][:, rows[0] : rows[-1] + 1]


def all_sizes(observed: Observed) -> Tensor:
    """Return all log sizes [N, n], as a view."""
    return observed.raw["scales" if observed.model == "4dgs" else "log_diagonal"]


def set_below(observed: Observed, variable: str, times: float = 1.0, plus: float = 0.0) -> None:
    """Multiply the entries left of the diagonal in one variable's rows of the triangular factor, and add to them."""
    layout = CholeskyLayout(variables(observed.model))
    below = layout.join(observed.raw)
    entries = [i * (i - 1) // 2 + j for i in _rows(observed, variable) for j in range(i)]
    below[:, entries] = below[:, entries] * times + plus
    observed.raw |= layout.split(below)


def upright(observed: Observed) -> None:
    """Let time correlate with nothing: 4D Gaussians are not rotated, the rows of time have no entry left of it."""
    if observed.model == "4dgs":
        for name in ("left_quats", "right_quats"):
            observed.raw[name][:] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    else:
        set_below(observed, "t", times=0.0)


# ---- parts of dGS, dBS, UBS and FreeTimeGS


def set_life(observed: Observed, log_life: float) -> None:
    """Set the logarithms of the Gaussians' sizes in time; the time of UBS then correlates with nothing."""
    match observed.family:
        case "freetime":
            observed.raw["durations"][:] = log_life
        case "ubs":
            observed.raw["scales"][:, 6] = inverse_softplus(log_life)
            observed.raw["lower"][:, 12:] = 0
        case _:
            observed.raw["precision"][:, 6] = -log_life


def set_times(observed: Observed, times: Tensor) -> None:
    """Set the mean times [N], which for dGS are inside (0, 1)."""
    is_logit = observed.family == "dgs"
    observed.raw["times"][:, 0] = times.clamp(1e-6, 1 - 1e-6).logit() if is_logit else times


def set_view(observed: Observed, log_precision: float) -> None:
    """Set the logarithms of the Gaussians' precisions in direction, without correlation in dGS and dBS."""
    if "precision" in observed.raw:
        observed.raw["precision"][:, :6] = torch.tensor([log_precision, 0, log_precision, 0, 0, log_precision])
    else:
        observed.raw["scales"][:, 3:6] = inverse_softplus(-log_precision)


def inverse_softplus(log_size: float) -> float:
    """Return x with softplus(x) = exp(log_size)."""
    if log_size < -16:
        return log_size
    return math.exp(log_size) if log_size > 4 else math.log(math.expm1(math.exp(log_size)))


# ---- cases of 4DGS, 6DGS and 7DGS, some of them also of the others


@hard(*JOINT, *MOVING)
def ordinary_gaussians(observed: Observed, severity: float, g: Generator) -> None:
    """Use ordinary Gaussians, for which nothing is numerically hard, as the baseline of the hard cases."""


@hard(*JOINT)
def diagonals_over_eight_decades(observed: Observed, severity: float, g: Generator) -> None:
    """Use factors with diagonal entries from 1 to 1e-8: forming the covariance S squares the condition number. The
    camera is on the means, so that the view direction is exactly 0 and only the factor is tested."""
    raw, logs = observed.raw, all_sizes(observed)
    logs[:] = -8 * LN_10 * severity * torch.rand(logs.shape, generator=g)
    if observed.model == "4dgs":
        return
    layout = CholeskyLayout(variables(observed.model))
    raw |= layout.split(torch.randn(layout.join(raw).shape, generator=g))
    observed.center, raw["means"][:] = torch.ones(3), 1.0
    narrowest = sizes(observed, "d").amin(1, keepdim=True).clamp(min=-LOG_SIZE_MAX).exp()
    raw["directions"] = 0.3 * narrowest * torch.randn(COUNT, 3, generator=g)
    if "times" in raw:
        observed.time = 0.0
        raw["times"] = 0.3 * torch.randn(COUNT, 1, generator=g)


@hard(*TRIANGULAR)
def narrow_in_direction(observed: Observed, severity: float, g: Generator) -> None:
    """Use Gaussians that are visible from a range of directions 10^-3 wide, such as highlights. Float32 stores a unit
    direction to 6e-8, which is 6e-5 of this width; no algorithm can be more exact."""
    width = 10 ** (-3 * severity)
    sizes(observed, "d")[:] = -3 * LN_10 * severity
    set_below(observed, "d", times=width)
    observed.raw["directions"] = observed.towards() + width * torch.randn(COUNT, 3, generator=g)


@hard(*JOINT)
def nearly_certain(observed: Observed, severity: float, g: Generator) -> None:
    """Correlate position with time or direction to 1 - 1e-12, so that the subtraction S_pp - K S_qp cancels. The
    difference of these nearly equal matrices is the conditional covariance."""
    thin = -severity * 0.5 * math.log(5e11)  # sqrt(1 - rho^2) = sqrt(2e-12)
    if observed.model == "4dgs":
        half = math.pi / 8  # left and right rotations of 22.5 degrees turn z into t by 45
        for name in ("left_quats", "right_quats"):
            observed.raw[name][:] = torch.tensor([math.cos(half), math.sin(half), 0.0, 0.0])
        observed.raw["scales"][:, 2] = observed.raw["scales"][:, 3] + thin
        return
    set_below(observed, "p", times=0.0, plus=1.0)
    sizes(observed, "p")[:] = thin


@hard(*TIME_LIKE)
def instant(observed: Observed, severity: float, g: Generator) -> None:
    """Use Gaussians with nearly no extent in time (log sigma_t = -80), as 4DGS learns for single frames of a video.
    Half of the Gaussians have their mean exactly at the rendered time."""
    upright(observed)
    sizes(observed, "t")[:] = -80 * severity
    observed.raw["times"][::2] = single(observed.time)


@hard(*TIME_LIKE)
def static(observed: Observed, severity: float, g: Generator) -> None:
    """Use Gaussians with nearly infinite extent in time (log sigma_t = 80); training makes static ones so long."""
    if observed.model == "4dgs":
        upright(observed)
    sizes(observed, "t")[:] = 80 * severity


@hard(*JOINT)
def far_from_the_query(observed: Observed, severity: float, g: Generator) -> None:
    """Use Gaussians whose mean time and direction are 10^3 standard deviations away from those of the view. The opacity
    must underflow to 0 with gradient 0, not to 0 x inf = NaN. Met in practice: 4DGaussians issue 35."""
    if observed.model == "4dgs":
        upright(observed)
    for name, variable in (("times", "t"), ("directions", "d")):
        if name in observed.raw:
            sizes(observed, variable)[:] = -severity * 3 * LN_10
            observed.raw[name] += 1.0


@hard(*JOINT)
def insensitive(observed: Observed, severity: float, g: Generator) -> None:
    """Let lambda go to 0: opacity no longer depends on time and direction, and only the mean does. Lambda is the
    coefficient in the exponent by which opacity decreases with the distance in time or direction."""
    observed.log_lambda = dict.fromkeys(observed.log_lambda, -110.0 * severity)  # exp(-110) is 0 in float32


@hard(*JOINT)
def oversensitive(observed: Observed, severity: float, g: Generator) -> None:
    """Set lambda to 10^4, as when training increases lambda without bound: opacity is 0 except near mu_t and mu_d.
    Lambda is the coefficient in the exponent by which opacity decreases with the distance in time or direction."""
    observed.log_lambda = dict.fromkeys(observed.log_lambda, 4 * LN_10 * severity)
    near = 0.3 * 10 ** (-2 * severity)
    if observed.has_sphere:
        observed.raw["directions"] = observed.towards() + near * torch.randn(COUNT, 3, generator=g)
    if "times" in observed.raw:
        observed.raw["times"] = observed.time + near * torch.randn(COUNT, 1, generator=g)


@hard(*JOINT, "dgs", "ubs")
def camera_on_a_mean(observed: Observed, severity: float, g: Generator) -> None:
    """Put the camera on a mean or up to 1e-3 away: a view direction of 0/0 must become 0. This happens in walk-throughs
    and in SLAM."""
    aside = torch.tensor([0.0, 1e-12, 1e-6, 1e-3])[:, None] + 1 - severity
    observed.center = torch.zeros(3)
    observed.raw["means"] = aside * torch.tensor([[1.0, -2.0, 0.5]])
    if observed.has_sphere:
        observed.raw["directions"] = 0.5 * torch.randn(COUNT, 3, generator=g)
    if observed.model in MOVING:
        set_view(observed, -1.0)


@hard(*TRIANGULAR)
def direction_off_the_sphere(observed: Observed, severity: float, g: Generator) -> None:
    """Put the mean direction mu_d 10^4 away from the unit sphere, as training may, because mu_d is not normalised."""
    observed.raw["directions"] *= 10 ** (4 * severity)
    sizes(observed, "d")[:] += 4 * LN_10 * severity


@hard(*JOINT)
def refinement_pushes_sizes(observed: Observed, severity: float, g: Generator) -> None:
    """Shift log sizes by +-80, as AGR (networks) may do: in float32 exp overflows at 89, and its square at 45."""
    logs = all_sizes(observed)
    logs += 80 * severity * torch.where(torch.rand(logs.shape, generator=g) < 0.5, -1.0, 1.0)


@hard("4dgs")
def vanishing_quaternion(observed: Observed, severity: float, g: Generator) -> None:
    """Use quaternions of length 1e-6, as weight decay makes: models normalise a copy, not the parameters."""
    for name in ("left_quats", "right_quats"):
        observed.raw[name] *= 10 ** (-6 * severity)


@hard(*JOINT, *MOVING)
def opacities_at_their_ends(observed: Observed, severity: float, g: Generator) -> None:
    """Use opacity logits of -200 to 200, as a PLY with opacities of 0 and 1 has: exp overflows at 89."""
    observed.raw["opacities"] = severity * torch.tensor([-200.0, -89.0, 20.0, 200.0])


# ---- cases of dGS, dBS, UBS and FreeTimeGS


@hard("dbs", "dgs", "ubs", "freetime")
def far_from_time_and_direction(observed: Observed, severity: float, g: Generator) -> None:
    """Use mean times and directions that are 10^3 sizes away: opacity must underflow to 0 with gradient 0, not NaN."""
    set_life(observed, -3 * LN_10 * severity)
    set_times(observed, torch.full((COUNT,), observed.time + 0.5 * severity))
    if observed.has_sphere:
        set_view(observed, 3 * LN_10 * severity)
        observed.raw["directions"] *= 1 - 2 * severity


@hard("freetime", "dgs", "dbs", "ubs")
def short_life(observed: Observed, severity: float, g: Generator) -> None:
    """Use lives of 1e-7, the shortest, at 0 to 10^3 lives from the mean time. In dGS the mean time is a sigmoid, which
    float32 rounds to 3e-8, and the mean moves by this over the square of the life. So lives are 10^-2 there."""
    decades = (2 if observed.model == "dgs" else 7) * severity
    set_life(observed, -decades * LN_10)
    set_times(observed, observed.time + 10**-decades * torch.tensor([0.0, 0.5, -1.0, 1e3 * severity]))


@hard("freetime", "dgs", "ubs")
def endless_life(observed: Observed, severity: float, g: Generator) -> None:
    """Use Gaussians with a nearly infinite life (log size in time 80), as training makes static ones."""
    set_life(observed, 80 * severity)


@hard("ubs", "freetime")
def flat_and_huge(observed: Observed, severity: float, g: Generator) -> None:
    """Use Gaussians with one size at the lower limit, one at the upper limit of 9e6, and one ordinary size."""
    observed.raw["scales"][:, 0] = -80 * severity
    observed.raw["scales"][:, 1] = 80 * severity if observed.model == "freetime" else 1e7 * severity


@hard("dgs", "ubs", "dbs", "dgs_interpolated")
def strong_coupling(observed: Observed, severity: float, g: Generator) -> None:
    """Let means move by 10^2 of their size with time and direction; in UBS these then nearly determine the position.
    With that the conditional covariance of UBS is a small remainder of the covariance."""
    raw, times, near = observed.raw, 10 ** (2 * severity), observed.towards()
    raw["directions"] = near + (raw["directions"] - near) / (3 * times if observed.model != "ubs" else 1)
    if "betas" in raw:
        raw["betas"][:, 1:] = SPREAD  # full motion
    if "shares" in raw:
        raw["shares"][:] = 10 * severity
    if "lower" in raw:
        raw["lower"] *= times
    if "coupling" in raw:
        set_life(observed, -LN_10 * severity)
        set_times(observed, observed.time + 0.03 * torch.randn(COUNT, generator=g))
        raw["coupling"] *= times
        raw["precision"][:, :6] *= times ** torch.tensor([0.0, 1.0, 0.0, 1.0, 1.0, 0.0])


@hard("dgs", "dbs", "freetime")
def vectors_of_any_length(observed: Observed, severity: float, g: Generator) -> None:
    """Use couplings, quaternions and mean directions of length 1e-6 and 1e6: models normalise a copy of them."""
    lengths = 10 ** (severity * torch.tensor([-6.0, 6.0, -3.0, 3.0]))[:, None]
    for name in ("coupling", "quats", *(["directions"] if observed.model == "dgs" else [])):
        if name in observed.raw:
            observed.raw[name] *= lengths


@hard("freetime", "dgs", "ubs")
def opacity_at_its_limit(observed: Observed, severity: float, g: Generator) -> None:
    """Set the opacities at the mean time and view 1e-3 above or below 1/255, where a Gaussian begins to be rendered."""
    set_times(observed, torch.full((COUNT,), observed.time))
    if observed.has_sphere:
        observed.raw["directions"] = observed.towards()
    observed.raw["opacities"] = (ALPHA_MIN * (1 + 1e-3 * torch.tensor([1.0, -1.0, 2.0, -2.0]))).logit() * severity


@hard("dbs", "ubs")
def exponents_at_their_limits(observed: Observed, severity: float, g: Generator) -> None:
    """Use the largest exponents b = 4 e^16 at distances of 1e-4, the least, and b just below 4, where motion is full.
    Large exponents multiply ln(1 - tanh y^2) of small y, which must not lose digits."""
    logs = severity * torch.tensor([80.0, -80.0, -1e-4, 5.0])
    observed.raw["betas"] = logs[:, None] + (1 - severity) * observed.raw["betas"]
    observed.raw["betas"][:, 0] *= torch.tensor([1.0, 1.0, -1.0, -1.0])
    set_view(observed, -3.5 * LN_10 * severity)
    set_life(observed, 3.5 * LN_10 * severity)


# ---- the errors of a case

OPTIONS: dict[str, dict[str, Any]] = {
    "6dgs": {"lambda_d": 0.35, "directional_half": False},
    "7dgs": {"lambda_d": 0.35, "lambda_t": 0.35},
} | {name: {"coupling": coupling} for name, coupling in COUPLINGS.items()}
LEAST_GRADIENT = 1e-20  # errors of a smaller gradient are relative to this, because float32 underflows


class SliceTruth(NamedTuple):
    """The exact conditional mean, covariance and opacity of N Gaussians, and the gradient of a loss."""

    outputs: Tensor  # [N, 13] float64: mean (3), covariance (9), opacity; [N, 14] with the exponent of a Beta profile
    weights: Tensor  # [N, 13]: the loss is the sum of weights x outputs
    scale: Tensor  # [N]: errors of the mean are divided by this
    gradient: Tensor  # [N, parameters], in the order of `Observed.raw`


class SliceErrors(NamedTuple):
    """The relative errors of the slices of N Gaussians."""

    shape: Tensor  # [N] of the covariance
    forward: Tensor  # [N] the largest of mean, covariance, opacity and exponent
    gradient: Tensor  # [N]
    bad: Tensor  # [N] bool: not finite, or an indefinite covariance
    drawn: Tensor  # [N] bool: opaque enough to be rendered; of other slices only the opacity counts


def judge(case: Case, backends: list[str], schemes: Sequence[str] = SCHEMES, copies: int = COPIES) -> Iterator[Cell]:
    """Yield the errors in one case for each model, scheme and backend; timed are `copies` of the Gaussians."""
    for model in case.subjects:
        observed = case(model=model)
        exact = truth(observed)
        for scheme in schemes if model in JOINT else (ONE_SCHEME,):
            for backend in backends_with(scheme, model, backends):
                errors = errors_of(observed, exact, scheme, backend)
                gaussians, raw = load(observed, scheme, backend, copies)
                weights = exact.weights.repeat(copies, 1)
                ms = fastest(functools.partial(differentiate, gaussians, raw, observed, weights))
                at = (case.area, case.name, model, scheme, backend)
                measured = (worst(errors.forward), worst(errors.gradient), errors.bad.double().mean().item(), ms)
                yield Cell(*at, *measured, case.bound, f"{int(errors.drawn.sum())} of {COUNT} drawn")


def errors_of(observed: Observed, exact: SliceTruth, scheme: str, backend: str) -> SliceErrors:
    """Measure the errors of slices in float32 by one scheme and backend."""
    gaussians, raw = load(observed, scheme, backend)
    errors = compare(*differentiate(gaussians, raw, observed, exact.weights), exact)
    return errors._replace(bad=errors.bad | indefinite(gaussians, raw))


def truth(observed: Observed) -> SliceTruth:
    """Compute exact conditional Gaussians in mpmath, and the exact gradient of a loss. The loss is a random weighted
    sum of mean, covariance and opacity; mean and covariance are divided by their size. If a Gaussian is too faint to be
    rendered, only its opacity counts."""
    function = exact_slice(observed)
    rows = torch.cat([value.reshape(len(value), -1) for value in observed.raw.values()], 1).tolist()
    points = [[*x, *mean] for x, mean in zip(rows, observed.raw["means"].tolist(), strict=True)]
    outputs = torch.tensor([[float(v) for v in oracle.evaluate(function, x)] for x in points], dtype=torch.float64)
    weights, scale = weights_of(outputs, observed.raw["means"])
    gradients = [
        [float(v) for v in oracle.gradient(function, x, weight, first=len(rows[0]))]
        for x, weight in zip(points, weights.tolist(), strict=True)
    ]
    return SliceTruth(outputs, weights, scale, torch.tensor(gradients, dtype=torch.float64))


def weights_of(outputs: Tensor, means: Tensor) -> tuple[Tensor, Tensor]:
    """Return the weights of the loss of `truth`, as large as `outputs` [N, 13], and the scale of the means [N]."""
    weights = torch.randn(outputs.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    mean = means.double()
    scale = mean.norm(dim=1) + (outputs[:, :3] - mean).norm(dim=1) + outputs[:, [3, 7, 11]].sum(1).sqrt()
    weights[:, :3] /= scale[:, None]
    weights[:, 3:12] /= outputs[:, 3:12].norm(dim=1, keepdim=True)
    weights[:, 13:] /= outputs[:, 13:]
    weights[outputs[:, 12] < ALPHA_MIN, :12] = 0  # it is culled, so its mean and covariance do not matter
    return weights, scale


def exact_slice(observed: Observed) -> oracle.Function:
    """Return the mpmath function from the raw parameters of a Gaussian to its conditional 3D Gaussian. The time and the
    learned coefficients lambda_t and lambda_d are rounded to float32, because the models get them in float32."""
    layout = {name: value[0].numel() for name, value in observed.raw.items()}
    time: float | None = single(observed.time)
    options: dict[str, Any] = OPTIONS.get(observed.model, {})
    if observed.model in JOINT:
        options = {"log_lambda": {name: single(value) for name, value in observed.log_lambda.items()}}
    if observed.model in ("6dgs", "7dgs"):
        time = time if observed.model == "7dgs" else None
        order = observed.options.get("factor_order")
        options |= {"order": letters_of(order) if order else variables(observed.model)}
        options |= {"half": 0.5 if observed.model == "7dgs" else 1.0}
        options |= {"relative": observed.options.get("off_diagonal") != "raw"}
    return functools.partial(
        oracle.SLICES[observed.family], layout=layout, center=observed.center.tolist(), time=time, **options
    )


def load(observed: Observed, scheme: str, backend: str, copies: int = 1) -> tuple[GaussianModel, dict[str, Tensor]]:
    """Make a model, and raw parameters that repeat the Gaussians of a case `copies` times."""
    name = "dgs" if observed.model in COUPLINGS else observed.model
    options = OPTIONS.get(observed.model, {}) | observed.options | ({"scheme": scheme} if name in JOINT else {})
    model = build(name, backend=BACKENDS[backend], **options)
    for name, value in observed.log_lambda.items():
        model.log_lambda[name] = nn.Parameter(torch.tensor(value))
    model.to(device_of(backend))
    rows = torch.arange(len(observed.raw["means"])).repeat(copies)
    return model, {name: value[rows].requires_grad_() for name, value in observed.raw.items()}


def differentiate(
    model: GaussianModel, raw: dict[str, Tensor], observed: Observed, weights: Tensor
) -> tuple[Tensor, Tensor]:
    """Compute conditional 3D Gaussians in the type of `raw`, and the gradients of raw parameters; both as float64. The
    outputs are those of `SliceTruth`. The gradients are [N, parameters]."""
    device = device_of(model.backend.name)
    there = {name: value.to(device) for name, value in raw.items()}
    moment = torch.tensor(observed.time).to(there["means"]) if "time" in model.observes else None
    sliced = model.slice_geometry(there, CameraTime(observed.center.to(there["means"]), moment))
    mean, F, opacity, *shapes = (x.cpu().double() for x in tensors_of(sliced))
    outputs = torch.cat([mean, (F @ F.mT).flatten(1), opacity[:, None], *(b[:, None] for b in shapes)], 1)
    gradients = torch.autograd.grad(outputs, list(raw.values()), weights, materialize_grads=True)
    return outputs.detach(), torch.cat([g.reshape(len(g), -1).double() for g in gradients], 1)


def compare(outputs: Tensor, gradient: Tensor, exact: SliceTruth) -> SliceErrors:
    """Compute the errors of slices [N, 13] and gradients [N, parameters]: relative, for the opacity absolute."""
    wrong = outputs - exact.outputs
    drawn = exact.outputs[:, 12] >= ALPHA_MIN
    shape = wrong[:, 3:12].norm(dim=1) / exact.outputs[:, 3:12].norm(dim=1)
    place = wrong[:, :3].norm(dim=1) / exact.scale
    geometry = torch.where(drawn, torch.maximum(shape, place), 0.0)
    others = torch.cat([wrong[:, 12:13], wrong[:, 13:] / exact.outputs[:, 13:]], 1).abs().amax(1)
    slope = (gradient - exact.gradient).norm(dim=1) / exact.gradient.norm(dim=1).clamp(min=LEAST_GRADIENT)
    bad = ~(outputs.isfinite().all(1) & gradient.isfinite().all(1))
    return SliceErrors(shape, torch.maximum(geometry, others), slope, bad, drawn)


@torch.no_grad()
def indefinite(model: GaussianModel, raw: dict[str, Tensor]) -> Tensor:
    """Return which conditional covariances [N] have a negative eigenvalue or are not finite. The scheme `square_root`
    returns a factor F of the covariance F F^T, which has no negative eigenvalue, as models without schemes do."""
    scheme = str(getattr(model, "scheme", "square_root"))
    if scheme == "square_root":
        return torch.zeros(len(raw["means"]), dtype=torch.bool)
    cov = subtract(model.factors(raw), scheme)[1].double()
    finite = cov.isfinite().all((1, 2))
    least = torch.linalg.eigvalsh(torch.where(finite[:, None, None], cov, 0.0))[:, 0]
    return ~finite | (least < 0)
