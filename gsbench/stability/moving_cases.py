"""Define numerically hard inputs for slices of dGS, dBS, UBS and FreeTimeGS: extreme lives, couplings and exponents.

The audit's short form tests the first model of each case.
"""

import math

import torch
from torch import Generator, Tensor
from torch.nn.functional import normalize

from gsbench.kernels.headers import ALPHA_MIN
from gsbench.stability.cases import case
from gsbench.stability.slicing_cases import COUNT, LN_10, Observed

COUPLINGS = {"dgs_interpolated": "interpolated", "dgs_o": "none"}  # models that are dGS with another `coupling`
MODELS = ("dgs", *COUPLINGS, "dbs", "dbs_static", "ubs", "ubs_static", "freetime")
TIME = float(torch.tensor(0.4))
SPREAD = 0.3  # standard deviation of raw parameters


def family(model: str) -> str:
    """Return the name of the model's formulas: dgs, dbs, ubs or freetime."""
    return model.split("_")[0]


def ordinary(g: Generator, model: str, N: int = COUNT) -> Observed:
    """Draw random visible Gaussians like those at the start of training, which are not numerically hard."""

    def random(*shape: int) -> Tensor:
        return SPREAD * torch.randn(N, *shape, generator=g)

    means, center, kind = torch.rand(N, 3, generator=g) * 2 - 1, torch.tensor([0.3, -0.2, -4.0]), family(model)
    timed = not model.endswith("_static")
    C = 3 + timed
    raw = {"means": means, "opacities": random() / SPREAD}
    if timed:
        times = TIME + random(1) / 3
        raw["times"] = times.logit() if kind == "dgs" else times
    if kind == "freetime":
        return Observed(model, raw | {"scales": random(3) - 1, "quats": random(4), "durations": random(1) - 1,
                                      "velocities": random(3)}, center, TIME)  # fmt: skip
    raw["directions"] = normalize(means - center, dim=-1) + random(3)
    raw["scales"] = random(3 + (C if kind == "ubs" else 0)) - 1
    if kind == "dgs":
        raw |= {"quats": random(4), "shares": random(2) - 1}
    else:
        raw |= {"skew": random(3), "betas": random(1 + C)}
    if kind == "ubs":
        raw["lower"] = random(3 * C + C * (C - 1) // 2)
        return Observed(model, raw, center, TIME)
    return Observed(model, raw | {"precision": random(7 if timed else 6), "coupling": random(3 * C)}, center, TIME)


def set_life(observed: Observed, log_life: float) -> None:
    """Set the logarithms of the Gaussians' sizes in time; the time of UBS then correlates with nothing."""
    raw = observed.raw
    match family(observed.model):
        case "freetime":
            raw["durations"][:] = log_life
        case "ubs":
            raw["scales"][:, 6] = inverse_softplus(log_life)
            raw["lower"][:, 12:] = 0
        case _:
            raw["precision"][:, 6] = -log_life


def inverse_softplus(log_size: float) -> float:
    """Return x with softplus(x) = exp(log_size)."""
    if log_size < -16:
        return log_size
    return math.exp(log_size) if log_size > 4 else math.log(math.expm1(math.exp(log_size)))


def set_times(observed: Observed, times: Tensor) -> None:
    """Set the mean times [N], which for dGS are inside (0, 1)."""
    observed.raw["times"][:, 0] = times.clamp(1e-6, 1 - 1e-6).logit() if family(observed.model) == "dgs" else times


def set_view(observed: Observed, log_precision: float) -> None:
    """Set the logarithms of the Gaussians' precisions in direction, without correlation in dGS and dBS."""
    if "precision" in observed.raw:
        observed.raw["precision"][:, :6] = torch.tensor([log_precision, 0, log_precision, 0, 0, log_precision])
    else:
        observed.raw["scales"][:, 3:6] = inverse_softplus(-log_precision)


@case("slicing", *MODELS)
def ordinary_moving_gaussians(g: Generator, severity: float, model: str) -> Observed:  # noqa: ARG001
    """Use ordinary Gaussians of models that move 3D Gaussians or have Beta profiles, as the baseline of their cases."""
    return ordinary(g, model)


@case("slicing", "dbs", "dgs", "ubs", "freetime")
def far_from_time_and_direction(g: Generator, severity: float, model: str) -> Observed:
    """Use mean times and directions that are 10^3 sizes away: opacity must underflow to 0 with gradient 0, not NaN."""
    observed = ordinary(g, model)
    set_life(observed, -3 * LN_10 * severity)
    set_times(observed, torch.full((COUNT,), TIME + 0.5 * severity))
    if model != "freetime":
        set_view(observed, 3 * LN_10 * severity)
        observed.raw["directions"] *= 1 - 2 * severity
    return observed


@case("slicing", "freetime", "dgs", "dbs", "ubs")
def short_life(g: Generator, severity: float, model: str) -> Observed:
    """Use lives of 1e-7, the shortest, at 0 to 10^3 lives from the mean time.

    In dGS the mean time is a sigmoid, which float32 rounds to 3e-8, and the mean moves by this over the square of the
    life. So lives are 10^-2 there.
    """
    observed = ordinary(g, model)
    decades = (2 if model == "dgs" else 7) * severity
    set_life(observed, -decades * LN_10)
    set_times(observed, TIME + 10**-decades * torch.tensor([0.0, 0.5, -1.0, 1e3 * severity]))
    return observed


@case("slicing", "freetime", "dgs", "ubs")
def endless_life(g: Generator, severity: float, model: str) -> Observed:
    """Use Gaussians with a nearly infinite life (log size in time 80), as training makes static ones."""
    observed = ordinary(g, model)
    set_life(observed, 80 * severity)
    return observed


@case("slicing", "ubs", "freetime")
def flat_and_huge(g: Generator, severity: float, model: str) -> Observed:
    """Use Gaussians with one size at the lower limit, one at the upper limit of 9e6, and one ordinary size."""
    observed = ordinary(g, model)
    scales = observed.raw["scales"]
    scales[:, 0] = -80 * severity
    scales[:, 1] = 80 * severity if model == "freetime" else 1e7 * severity
    return observed


@case("slicing", "dgs", "ubs", "dbs", "dgs_interpolated")
def strong_coupling(g: Generator, severity: float, model: str) -> Observed:
    """Let means move by 10^2 of their size with time and direction; in UBS these then nearly determine the position.

    With that the conditional covariance of UBS is a small remainder of the covariance.
    """
    observed = ordinary(g, model)
    raw, times = observed.raw, 10 ** (2 * severity)
    near = normalize(raw["means"] - observed.center, dim=-1)
    raw["directions"] = near + (raw["directions"] - near) / (3 * times if family(model) != "ubs" else 1)
    if "betas" in raw:
        raw["betas"][:, 1:] = SPREAD  # full motion
    if "shares" in raw:
        raw["shares"][:] = 10 * severity
    if "lower" in raw:
        raw["lower"] *= times
    if "coupling" in raw:
        set_life(observed, -LN_10 * severity)
        set_times(observed, TIME + 0.03 * torch.randn(COUNT, generator=g))
        raw["coupling"] *= times
        raw["precision"][:, :6] *= times ** torch.tensor([0.0, 1.0, 0.0, 1.0, 1.0, 0.0])
    return observed


@case("slicing", "dgs", "dbs", "freetime")
def vectors_of_any_length(g: Generator, severity: float, model: str) -> Observed:
    """Use couplings, quaternions and mean directions of length 1e-6 and 1e6: models normalise a copy of them."""
    observed = ordinary(g, model)
    lengths = 10 ** (severity * torch.tensor([-6.0, 6.0, -3.0, 3.0]))[:, None]
    for name in ("coupling", "quats", *(["directions"] if model == "dgs" else [])):
        if name in observed.raw:
            observed.raw[name] *= lengths
    return observed


@case("slicing", "freetime", "dgs", "ubs")
def opacity_at_its_limit(g: Generator, severity: float, model: str) -> Observed:
    """Set the opacities at the mean time and view 1e-3 above or below 1/255, where a Gaussian begins to be rendered."""
    observed = ordinary(g, model)
    set_times(observed, torch.full((COUNT,), TIME))
    if "directions" in observed.raw:
        observed.raw["directions"] = normalize(observed.raw["means"] - observed.center, dim=-1)
    observed.raw["opacities"] = (ALPHA_MIN * (1 + 1e-3 * torch.tensor([1.0, -1.0, 2.0, -2.0]))).logit() * severity
    return observed


@case("slicing", "dbs", "ubs")
def exponents_at_their_limits(g: Generator, severity: float, model: str) -> Observed:
    """Use the largest exponents b = 4 e^16 at distances of 1e-4, the least, and b just below 4, where motion is full.

    Large exponents multiply ln(1 - tanh y^2) of small y, which must not lose digits.
    """
    observed = ordinary(g, model)
    logs = severity * torch.tensor([80.0, -80.0, -1e-4, 5.0])
    observed.raw["betas"] = logs[:, None] + (1 - severity) * observed.raw["betas"]
    observed.raw["betas"][:, 0] *= torch.tensor([1.0, 1.0, -1.0, -1.0])
    set_view(observed, -3.5 * LN_10 * severity)
    set_life(observed, 3.5 * LN_10 * severity)
    return observed


@case("slicing", "dgs", "ubs")
def camera_on_a_moving_mean(g: Generator, severity: float, model: str) -> Observed:
    """Put the camera on a mean or up to 1e-3 away: a view direction of 0/0 must become 0."""
    observed = ordinary(g, model)
    aside = torch.tensor([0.0, 1e-12, 1e-6, 1e-3])[:, None] + 1 - severity
    observed.center = torch.zeros(3)
    observed.raw["means"] = aside * torch.tensor([[1.0, -2.0, 0.5]])
    observed.raw["directions"] = 0.5 * torch.randn(COUNT, 3, generator=g)
    set_view(observed, -1.0)
    return observed


@case("slicing", *MODELS)
def moving_opacities_at_their_ends(g: Generator, severity: float, model: str) -> Observed:
    """Use opacity logits of -200 to 200: exp overflows at 89."""
    observed = ordinary(g, model)
    observed.raw["opacities"] = severity * torch.tensor([-200.0, -89.0, 20.0, 200.0])
    return observed
