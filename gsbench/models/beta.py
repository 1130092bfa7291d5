"""Define UBS, and what models with Beta profiles of alpha share: sizes, rotation, exponents and opacity factors.

Liu et al., "Universal Beta Splatting", ICLR 2026, with the constants of the authors' code.
"""

import math
from dataclasses import replace
from typing import Any, ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor

from gsbench.errors import check_known
from gsbench.kernels.headers import BETA_LOG_MIN, LOG_SIZE_MAX
from gsbench.kernels.slices import slice_universal
from gsbench.kernels.tensors import check_positive
from gsbench.models.base import SHRINK, GaussianModel, Raw
from gsbench.models.camera_time import CameraTime, initial_times, unit
from gsbench.models.gaussian_batch import Conditioned, reach
from gsbench.models.portable_math import exp, expm1, log, log1p, sqrt
from gsbench.models.registry import register
from gsbench.models.slicing import Reduced, cholesky3, gain_of, reduce, triangularise, whiten
from gsbench.scenes.gaussian_ply import TrainedGaussians
from gsbench.scenes.scene import Points

LARGEST_SHIFT = 4.0  # the exponent at which a variable has its full effect on the mean
FADED = 20.0  # a 2 y^2 at which ln(1 - tanh(y^2)) is below BETA_LOG_MIN
VIEW_BETA = -3.0  # initial `betas` of direction in a model with time: exponents of 0.2, so directions start weak


class BetaModel(GaussianModel):
    """The base class of models whose alpha has a Beta profile, with an exponent b for each Gaussian.

        alpha = opacity (1 - r^2)^b for r < 1, else 0        b = 4 exp(beta)

    The distance r is measured by the projected covariance, so a profile ends at one standard deviation. It looks like a
    Gaussian whose standard deviations are smaller by sqrt(2 b). Sizes are softplus(x) of their parameters x.
    """

    initial_opacity: ClassVar[float] = 0.5

    def factors(self, raw: Raw) -> Tensor:
        """Compute the factors F of the covariances F F^T of conditional 3D Gaussians, [N, 3, 3], the same at all times.

        By default they are (I + A) S with sizes S and a skew-symmetric A, a rotation to first order.
        """
        return skew_factor(raw["scales"], raw["skew"])

    def initial_geometry(self, points: Points, distances: Tensor, generator: torch.Generator) -> Raw:
        """Return spheres without rotation that end at the distances [N] of the points to their neighbours.

        Mean directions are random in the cube [-1, 1]^3, and mean times in [0, 1], as in the authors' code.
        """
        N, has_time = len(distances), "time" in self.observes
        betas = [0.0, *([VIEW_BETA] * 3 if has_time else [0.0] * 3), *([0.0] if has_time else [])]
        raw = {
            "directions": torch.rand(N, 3, generator=generator) * 2 - 1,
            "scales": softplus_inverse(distances)[:, None].repeat(1, 3),
            "skew": torch.zeros(N, 3),
            "betas": torch.tensor(betas).repeat(N, 1),  # alpha's profile, direction x, y, z, time
        }
        return raw | {"times": initial_times(points, generator, margin=0)} if has_time else raw

    def spatial_scales(self) -> Tensor:
        """Return the sizes S of the Gaussians that look like the profiles, [N, 3]; gradients reach S, not b."""
        raw = dict(self.splats.items())
        return positive(raw["scales"][:, :3]) / reach(profiles(raw)).detach()[:, None]

    def hold_sizes(self, least: Tensor) -> None:
        """Raise the sizes such that the Gaussians that look like the profiles are at least `least` [N] large."""
        raw = {name: value.data for name, value in self.splats.items()}
        raw["scales"][:, :3].clamp_(min=softplus_inverse(least * reach(profiles(raw)))[:, None])

    def spread(self, rows: Tensor) -> Tensor:
        return self.factors(self.raw_of(rows))

    def shrink_rows(self, rows: Tensor, factors: Tensor) -> None:
        """Do nothing: the authors relocate without a change of size, because the factors are those of Gaussians."""

    def split(self, raw: Raw, generator: torch.Generator) -> Raw:
        """Sample the means of children from the Gaussian that looks like the profile, and make sizes 1.6 x smaller."""
        z = torch.randn(raw["means"].shape, generator=generator).to(raw["means"])
        means = raw["means"] + (self.factors(raw) @ z[..., None])[..., 0] / reach(profiles(raw))[:, None]
        space, rest = raw["scales"][:, :3], raw["scales"][:, 3:]
        return {"means": means, "scales": torch.cat([softplus_inverse(positive(space) / SHRINK), rest], -1)}

    def shaped_as(self, trained: TrainedGaussians, raw: Raw) -> Raw:
        """Return spheres of the volumes of trained 3D Gaussians, larger by the reach of their profiles."""
        larger = trained.log_scales + log(reach(profiles(raw)))[:, None]
        return GaussianModel.shaped_as(self, replace(trained, log_scales=larger), raw)


def exponents(betas: Tensor) -> Tensor:
    """Compute the exponents 4 exp(beta) of Beta profiles and opacity factors."""
    return 4 * exp(betas.clamp(-LOG_SIZE_MAX, LOG_SIZE_MAX))


def profiles(raw: Raw) -> Tensor:
    """Compute the exponents b of the alpha profiles, [N]."""
    return exponents(raw["betas"][:, 0])


def shift_weights(betas: Tensor) -> Tensor:
    """Return by how much time and direction move means, min(b / 4, 1), for parameters `betas` [N, 1 + C]: [N, C]."""
    return (exponents(betas[:, 1:]) / LARGEST_SHIFT).clamp(max=1)


def opacity_factor(
    white: Tensor,  # [N, C] whitened distances y of the direction and time of a query from their means
    betas: Tensor,  # [N, 1 + C] the parameters of the exponents; the first is that of the alpha profile
) -> Tensor:  # [N]
    """Compute the opacity factor prod_i (1 - tanh(y_i^2))^b_i, as in UBS.

    With x = y^2, ln(1 - tanh(x)) = -ln(1 + (e^2x - 1) / 2) loses no digits of a small x, which a large b multiplies.
    """
    doubled = (2 * white.square()).clamp(max=FADED)
    logs = (-log1p(expm1(doubled) / 2)).clamp(min=BETA_LOG_MIN)
    return exp((exponents(betas[:, 1:]) * logs).sum(-1))


def positive(x: Tensor) -> Tensor:
    """Compute the sizes softplus(x), held within exp(+-LOG_SIZE_MAX)."""
    return F.softplus(x).clamp(math.exp(-LOG_SIZE_MAX), math.exp(LOG_SIZE_MAX))


def softplus_inverse(y: Tensor) -> Tensor:
    """Return x with softplus(x) = y, for y > 0."""
    return y + log(-expm1(-y))


def skew_factor(scales: Tensor, skew: Tensor) -> Tensor:
    """Compute factors (I + A) diag(s) from parameters of sizes [N, 3] and the numbers A_01, A_02, A_12 [N, 3]."""
    unit_diagonal, (a, b, c) = torch.ones_like(skew[:, 0]), skew.unbind(-1)
    turn = torch.stack([unit_diagonal, a, b, -a, unit_diagonal, c, -b, -c, unit_diagonal], -1).unflatten(-1, (3, 3))
    return turn * positive(scales)[:, None, :]


MODULATIONS = ("whitened", "raw")
NOISE = 1e-5  # initial standard deviation of entries that start at a constant


@register("ubs")
class UniversalBetaModel(BetaModel):
    """UBS: a covariance S over position p, direction d and time t, and an exponent b for each of these variables.

    With q = (d, t), delta = q - mu_q and S = [(I + A) S_p, 0; L_qp, L_q] [...]^T, reduced to [T_qq 0; T_pq T_pp]:

        y       = T_qq^-1 delta                B = diag(min(b_q / 4, 1))
        mean    = mu_p + T_pq B y              opacity = sigmoid(o) prod_i (1 - tanh(y_i^2))^b_i
        cov     = T_pp T_pp^T + T_pq (I - B) T_pq^T, for all times and directions

    So b = 4 gives the conditional Gaussian of 7DGS, and a small exponent lets time or direction move and hide the
    Gaussian less. Gradients flow through d, unlike in the authors' code.
    """

    observes: ClassVar[tuple[str, ...]] = ("time", "direction")
    centers: ClassVar[tuple[str, ...]] = ("means", "times", "directions")
    geometry: ClassVar[tuple[str, ...]] = ("scales", "skew", "lower", "betas")
    kernel = slice_universal
    takes_views = True

    def __init__(
        self,
        *,
        time_size: float = 1.0,  # the initial size of the Gaussians in time
        view_size: float = 1.0,  # their initial size in direction
        # Where B acts. `whitened`: as in the class. `raw`: mean = mu_p + K B delta and cov = S_pp - K B S_qp with
        # K = S_pq S_qq^-1, as in the authors' code. This matrix is not symmetric; its upper triangle is used, and where
        # that is indefinite the Gaussian becomes flat.
        modulation: str = "whitened",
        **options: Any,
    ) -> None:
        super().__init__(**options)
        check_known("modulation", modulation, MODULATIONS)
        check_positive(time_size, "time_size")
        check_positive(view_size, "view_size")
        self.modulation = modulation
        self.initial_sizes = [view_size] * 3 + [time_size] * ("time" in self.observes)

    def initial_geometry(self, points: Points, distances: Tensor, generator: torch.Generator) -> Raw:
        """Return spheres of given size in direction and time, with almost no covariance between the variables."""
        raw = super().initial_geometry(points, distances, generator)
        N, C = len(distances), raw["betas"].shape[1] - 1

        def noise(count: int) -> Tensor:
            return NOISE * torch.randn(N, count, generator=generator)

        raw["scales"] = torch.cat([raw["scales"], softplus_inverse(torch.tensor(self.initial_sizes) + noise(C))], -1)
        raw["skew"] = noise(3)
        raw["lower"] = noise(3 * C + C * (C - 1) // 2)
        return raw

    def condition(self, raw: Raw, query: CameraTime) -> Conditioned:
        """Condition on direction and time; Beta weights of their offsets delta shift means and narrow covariances."""
        reduced = reduce(joint_factor(raw))
        offsets = [unit(raw["means"] - query.center) - raw["directions"]]
        if "time" in self.observes:
            assert query.time is not None
            offsets.append(query.time - raw["times"])
        delta = torch.cat(offsets, -1)
        white = whiten(reduced.T_qq, delta)
        weights = shift_weights(raw["betas"])
        if self.modulation == "whitened":
            shift = (reduced.T_pq * (weights * white)[:, None]).sum(-1)
        else:
            shift = (gain_of(reduced.T_pq, reduced.T_qq) * (weights * delta)[:, None]).sum(-1)
        factors = self._modulated(reduced, weights)
        profile = profiles(raw)
        return Conditioned(raw["means"] + shift, factors, opacity_factor(white, raw["betas"]), profile)

    def uses_kernel(self, raw: Raw) -> bool:
        return self.modulation == "whitened" and super().uses_kernel(raw)

    def hold_lifetimes(self, least: float) -> None:
        """Raise the size of time such that the Gaussian exp(-b y_t^2) of each opacity factor is at least `least` long.

        This Gaussian bounds the opacity factor (1 - tanh(y_t^2))^b.
        """
        b = exponents(self.splats["betas"].detach()[:, -1])
        self.splats["scales"].data[:, -1].clamp_(min=softplus_inverse(reach(b) * least))

    def factors(self, raw: Raw) -> Tensor:
        return self._modulated(reduce(joint_factor(raw)), shift_weights(raw["betas"]))

    def _modulated(self, reduced: Reduced, weights: Tensor) -> Tensor:  # weights: [N, k] the diagonal of B
        """Compute factors [N, 3, 3] of the covariances of the class, or of those that `modulation=raw` has."""
        T_qq, T_pq, T_pp = reduced
        if self.modulation == "whitened":
            narrowing = 1 - weights
            is_positive = narrowing > 0  # at 0 the gradient of the root is infinite
            root = torch.where(is_positive, sqrt(torch.where(is_positive, narrowing, 1.0)), 0.0)
            rows = torch.cat([T_pp, T_pq * root[:, None]], -1)  # [N, 3, 3 + k], a factor of the sum
            return triangularise(rows, 3)[0]
        S_pq = T_pq @ T_qq.mT
        cov = T_pp @ T_pp.mT + T_pq @ T_pq.mT - (gain_of(T_pq, T_qq) * weights[:, None]) @ S_pq.mT
        return cholesky3(cov.mT)  # reads the lower triangle


@register("ubs_static")
class StaticUniversalBetaModel(UniversalBetaModel):
    """UBS over position and direction, for scenes without time."""

    observes: ClassVar[tuple[str, ...]] = ("direction",)
    centers: ClassVar[tuple[str, ...]] = ("means", "directions")


def joint_factor(raw: Raw) -> Tensor:
    """Compute factors [(I + A) S_p, 0; L_qp, L_q] of covariances over (p, q), [N, 3 + C, 3 + C].

    The parameters `lower` are the entries of the last C rows below the diagonal, row by row.
    """
    scales, lower = raw["scales"], raw["lower"]
    space = skew_factor(scales[:, :3], raw["skew"])
    n = scales.shape[1]
    rows = [torch.cat([space, space.new_zeros(len(space), 3, n - 3)], -1)]
    diagonal = positive(scales)
    first = 0
    for i in range(3, n):
        row = [lower[:, first : first + i], diagonal[:, i : i + 1], lower.new_zeros(len(lower), n - 1 - i)]
        rows.append(torch.cat(row, -1)[:, None])
        first += i
    return torch.cat(rows, 1)
