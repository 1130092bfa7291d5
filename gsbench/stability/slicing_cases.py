"""Define numerically hard inputs for conditional 3D Gaussians: extreme Gaussians, a camera and a time."""

import math
from dataclasses import dataclass, field

import torch
from torch import Generator, Tensor

from gsbench.kernels.headers import LOG_SIZE_MAX
from gsbench.models.factors import Triangle
from gsbench.stability.cases import case

COUNT = 4  # Gaussians in a case; the truth of each takes about a hundred evaluations in mpmath
LN_10 = math.log(10)
TIME_LIKE = ("4dgs", "7dgs")
TRIANGULAR = ("6dgs", "7dgs")
ALL = ("4dgs", "6dgs", "7dgs")


@dataclass
class Observed:
    """Gaussians of one model, and the camera centre and time for which conditional 3D Gaussians are computed."""

    model: str
    raw: dict[str, Tensor]  # float32, by the model's own names
    center: Tensor
    time: float
    log_lambda: dict[str, float] = field(default_factory=dict)


def variables(model: str) -> str:
    """Return the variable of each row of the triangular factor: d (direction), t (time) or p (position)."""
    return "dddtppp" if model == "7dgs" else "dddppp"


def ordinary(g: Generator, model: str) -> Observed:
    """Draw random visible Gaussians like those at the start of training, which are not numerically hard."""
    means = torch.rand(COUNT, 3, generator=g) * 2 - 1
    center, time = torch.tensor([0.3, -0.2, -4.0]), 0.4
    raw = {"means": means, "opacities": torch.randn(COUNT, generator=g)}
    if model == "4dgs":
        raw["times"] = time + 0.1 * torch.randn(COUNT, 1, generator=g)
        raw["scales"] = torch.randn(COUNT, 4, generator=g) * 0.3 - 1
        raw["left_quats"], raw["right_quats"] = (torch.randn(COUNT, 4, generator=g) for _ in range(2))
        return Observed(model, raw, center, time, {"time": 0.0})
    n = len(variables(model))
    towards = torch.nn.functional.normalize(means - center, dim=-1)
    raw["directions"] = towards + 0.2 * torch.randn(COUNT, 3, generator=g)
    raw["log_diagonal"] = 0.3 * torch.randn(COUNT, n, generator=g) - 0.5
    raw |= Triangle(variables(model)).split(0.3 * torch.randn(COUNT, n * (n - 1) // 2, generator=g))
    log_lambda = {"direction": math.log(0.35)}
    if model == "7dgs":
        raw["times"] = time + 0.1 * torch.randn(COUNT, 1, generator=g)
        log_lambda["time"] = math.log(0.35)
    return Observed(model, raw, center, time, log_lambda)


def sizes(observed: Observed, variable: str) -> Tensor:
    """Return the log sizes (log diagonal entries) [COUNT, width] of position, time or direction, as a view."""
    if observed.model == "4dgs":
        return observed.raw["scales"][:, 3:] if variable == "t" else observed.raw["scales"][:, :3]
    rows = [i for i, name in enumerate(variables(observed.model)) if name == variable]
    return observed.raw["log_diagonal"][:, rows[0] : rows[-1] + 1]


def below(observed: Observed) -> Tensor:
    """Return the entries below the diagonal of the triangular factors, [COUNT, n (n - 1) / 2], row by row."""
    return Triangle(variables(observed.model)).join(observed.raw)


def set_below(observed: Observed, values: Tensor) -> None:
    """Set the entries below the diagonal of the triangular factors."""
    observed.raw |= Triangle(variables(observed.model)).split(values)


def upright(observed: Observed) -> None:
    """Remove the rotation of 4D Gaussians, so that their fourth axis is time."""
    for name in ("left_quats", "right_quats"):
        observed.raw[name][:] = torch.tensor([1.0, 0.0, 0.0, 0.0])


def entries(observed: Observed, variable: str) -> list[int]:
    """Return the indices of the entries in one variable's rows, among all entries below the diagonal."""
    rows = [i for i, name in enumerate(variables(observed.model)) if name == variable]
    return [i * (i - 1) // 2 + j for i in rows for j in range(i)]


@case("slicing", *ALL)
def ordinary_gaussians(g: Generator, severity: float, model: str) -> Observed:  # noqa: ARG001
    """Use ordinary Gaussians, for which nothing is numerically hard, as the baseline of the hard cases."""
    return ordinary(g, model)


@case("slicing", *ALL)
def diagonals_over_eight_decades(g: Generator, severity: float, model: str) -> Observed:
    """Use factors with diagonal entries from 1 to 1e-8: forming the covariance S squares the condition number.

    The camera is on the means, so that the view direction is exactly 0 and only the factor is tested.
    """
    observed = ordinary(g, model)
    name = "scales" if model == "4dgs" else "log_diagonal"
    observed.raw[name] = -8 * LN_10 * severity * torch.rand(observed.raw[name].shape, generator=g)
    if model == "4dgs":
        return observed
    set_below(observed, torch.randn(below(observed).shape, generator=g))
    observed.center, observed.raw["means"][:] = torch.ones(3), 1.0
    narrowest = sizes(observed, "d").amin(1, keepdim=True).clamp(min=-LOG_SIZE_MAX).exp()
    observed.raw["directions"] = 0.3 * narrowest * torch.randn(COUNT, 3, generator=g)
    if "times" in observed.raw:
        observed.time = 0.0
        observed.raw["times"] = 0.3 * torch.randn(COUNT, 1, generator=g)
    return observed


@case("slicing", *TRIANGULAR)
def narrow_in_direction(g: Generator, severity: float, model: str) -> Observed:
    """Use Gaussians that are visible from a range of directions 10^-3 wide, such as highlights.

    Float32 stores a unit direction to 6e-8, which is 6e-5 of this width; no algorithm can be more exact.
    """
    observed = ordinary(g, model)
    sizes(observed, "d")[:] = -3 * LN_10 * severity
    values = below(observed)
    values[:, entries(observed, "d")] *= 10 ** (-3 * severity)
    set_below(observed, values)
    offset = observed.raw["means"] - observed.center
    spread = 10 ** (-3 * severity) * torch.randn(COUNT, 3, generator=g)
    observed.raw["directions"] = torch.nn.functional.normalize(offset, dim=-1) + spread
    return observed


@case("slicing", *ALL)
def nearly_certain(g: Generator, severity: float, model: str) -> Observed:
    """Correlate position with time or direction to 1 - 1e-12, so that the subtraction S_pp - K S_qp cancels.

    The difference of these nearly equal matrices is the conditional covariance.
    """
    observed = ordinary(g, model)
    thin = -severity * 0.5 * math.log(5e11)  # sqrt(1 - rho^2) = sqrt(2e-12)
    if model == "4dgs":
        half = math.pi / 8  # left and right rotations of 22.5 degrees turn z into t by 45
        for name in ("left_quats", "right_quats"):
            observed.raw[name][:] = torch.tensor([math.cos(half), math.sin(half), 0.0, 0.0])
        observed.raw["scales"][:, 2] = observed.raw["scales"][:, 3] + thin
        return observed
    values = below(observed)
    values[:, entries(observed, "p")] = 1.0
    set_below(observed, values)
    sizes(observed, "p")[:] = thin
    return observed


@case("slicing", *TIME_LIKE)
def instant(g: Generator, severity: float, model: str) -> Observed:
    """Use Gaussians with nearly no extent in time (log sigma_t = -80), as 4DGS learns for single frames of a video.

    Half of the Gaussians have their mean exactly at the rendered time.
    """
    observed = ordinary(g, model)
    if model == "4dgs":
        upright(observed)
    else:
        values = below(observed)
        values[:, entries(observed, "t")] = 0.0
        set_below(observed, values)
    sizes(observed, "t")[:] = -80 * severity
    observed.raw["times"][::2] = float(torch.tensor(observed.time))
    return observed


@case("slicing", *TIME_LIKE)
def static(g: Generator, severity: float, model: str) -> Observed:
    """Use Gaussians with nearly infinite extent in time (log sigma_t = 80); training makes static ones so long."""
    observed = ordinary(g, model)
    if model == "4dgs":
        upright(observed)
    sizes(observed, "t")[:] = 80 * severity
    return observed


@case("slicing", *ALL)
def far_from_the_query(g: Generator, severity: float, model: str) -> Observed:
    """Use Gaussians whose mean time and direction are 10^3 standard deviations away from those of the view.

    The opacity must underflow to 0 with gradient 0, not to 0 x inf = NaN. Met in practice: 4DGaussians issue 35.
    """
    observed = ordinary(g, model)
    if model == "4dgs":
        upright(observed)
    for variable in "td" if model == "7dgs" else "t" if model == "4dgs" else "d":
        sizes(observed, variable)[:] = -severity * 3 * LN_10
    if "times" in observed.raw:
        observed.raw["times"] += 1.0
    if "directions" in observed.raw:
        observed.raw["directions"] += 1.0
    return observed


@case("slicing", *ALL)
def insensitive(g: Generator, severity: float, model: str) -> Observed:
    """Let lambda go to 0: opacity no longer depends on time and direction, and only the mean does.

    Lambda is the coefficient in the exponent by which opacity decreases with the distance in time or direction.
    """
    observed = ordinary(g, model)
    observed.log_lambda = dict.fromkeys(observed.log_lambda, -110.0 * severity)  # exp(-110) is 0 in float32
    return observed


@case("slicing", *ALL)
def oversensitive(g: Generator, severity: float, model: str) -> Observed:
    """Set lambda to 10^4, as when training increases lambda without bound: opacity is 0 except near mu_t and mu_d.

    Lambda is the coefficient in the exponent by which opacity decreases with the distance in time or direction.
    """
    observed = ordinary(g, model)
    observed.log_lambda = dict.fromkeys(observed.log_lambda, 4 * LN_10 * severity)
    near = 10 ** (-2 * severity)
    if "directions" in observed.raw:
        towards = torch.nn.functional.normalize(observed.raw["means"] - observed.center, dim=-1)
        observed.raw["directions"] = towards + near * 0.3 * torch.randn(COUNT, 3, generator=g)
    if "times" in observed.raw:
        observed.raw["times"] = observed.time + near * 0.3 * torch.randn(COUNT, 1, generator=g)
    return observed


@case("slicing", *ALL)
def camera_on_a_mean(g: Generator, severity: float, model: str) -> Observed:
    """Put the camera on a mean or up to 1e-3 away: a view direction of 0/0 must become 0.

    This happens in walk-throughs and in SLAM.
    """
    observed = ordinary(g, model)
    aside = torch.tensor([0.0, 1e-12, 1e-6, 1e-3])[:, None] + 1 - severity
    observed.center = torch.zeros(3)
    observed.raw["means"] = aside * torch.tensor([[1.0, -2.0, 0.5]])
    if "directions" in observed.raw:
        observed.raw["directions"] = 0.5 * torch.randn(COUNT, 3, generator=g)
    return observed


@case("slicing", *TRIANGULAR)
def direction_off_the_sphere(g: Generator, severity: float, model: str) -> Observed:
    """Put the mean direction mu_d 10^4 away from the unit sphere, as training may, because mu_d is not normalised."""
    observed = ordinary(g, model)
    observed.raw["directions"] *= 10 ** (4 * severity)
    sizes(observed, "d")[:] += 4 * LN_10 * severity
    return observed


@case("slicing", *ALL)
def refinement_pushes_sizes(g: Generator, severity: float, model: str) -> Observed:
    """Shift log sizes by +-80, as AGR (networks) may do: in float32 exp overflows at 89, and its square at 45."""
    observed = ordinary(g, model)
    name = "scales" if model == "4dgs" else "log_diagonal"
    sign = torch.where(torch.rand(observed.raw[name].shape, generator=g) < 0.5, -1.0, 1.0)
    observed.raw[name] += 80 * severity * sign
    return observed


@case("slicing", "4dgs")
def vanishing_quaternion(g: Generator, severity: float, model: str) -> Observed:
    """Use quaternions of length 1e-6, as weight decay makes: models normalise a copy, not the parameters."""
    observed = ordinary(g, model)
    for name in ("left_quats", "right_quats"):
        observed.raw[name] *= 10 ** (-6 * severity)
    return observed


@case("slicing", *ALL)
def opacities_at_their_ends(g: Generator, severity: float, model: str) -> Observed:
    """Use opacity logits of -200 to 200, as a PLY with opacities of 0 and 1 has: exp overflows at 89."""
    observed = ordinary(g, model)
    observed.raw["opacities"] = severity * torch.tensor([-200.0, -89.0, 20.0, 200.0])
    return observed
