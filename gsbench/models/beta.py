"""Define what models with Beta profiles of alpha share (UBS, dBS): sizes, rotation, exponents and opacity factors.

Liu et al., "Universal Beta Splatting", ICLR 2026.
"""

import math
from dataclasses import replace
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor

from gsbench.kernels.headers import BETA_LOG_MIN, LOG_SIZE_MAX
from gsbench.models.base import SHRINK, GaussianModel, Raw
from gsbench.models.elementary import exp, log, log1p
from gsbench.models.sliced import reach
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
    """  # fmt: skip

    initial_opacity: ClassVar[float] = 0.5

    def factors(self, raw: Raw) -> Tensor:
        """Compute the factors F of the covariances F F^T of conditional 3D Gaussians, [N, 3, 3], the same at all times.

        By default they are (I + A) S with sizes S and a skew-symmetric A, a rotation to first order.
        """
        return skew_factor(raw["scales"], raw["skew"])

    def initial_geometry(self, points: Points, distances: Tensor, generator: torch.Generator) -> Raw:
        """Return spheres without rotation that end at the distances [N] of the points to their neighbours."""
        N, time = len(distances), "time" in self.observes
        view = VIEW_BETA if time else 0.0
        raw = {
            "directions": torch.rand(N, 3, generator=generator) * 2 - 1,
            "scales": softplus_inverse(distances)[:, None].repeat(1, 3),
            "skew": torch.zeros(N, 3),
            "betas": torch.tensor([0.0, view, view, view] + [0.0] * time).repeat(N, 1),
        }
        return raw | {"times": torch.rand(N, 1, generator=generator)} if time else raw

    def spatial_scales(self) -> Tensor:
        """Return the sizes S of the Gaussians that look like the profiles, [N, 3]; gradients reach S, not b."""
        raw = dict(self.splats.items())
        return positive(raw["scales"][:, :3]) / reach(profiles(raw)).detach()[:, None]

    def log_sizes(self, index: int) -> Tensor:
        """Return the logarithms of the sizes of the Gaussian `index`, in position and then in other variables."""
        return positive(self.splats["scales"].detach()[index]).log()

    def hold_sizes(self, least: Tensor) -> None:
        """Raise the sizes such that the Gaussians that look like the profiles are at least `least` [N] large."""
        raw = {name: value.data for name, value in self.splats.items()}
        raw["scales"][:, :3].clamp_(min=softplus_inverse(least * reach(profiles(raw)))[:, None])

    def spread(self, rows: Tensor) -> Tensor:
        """Return the factors of the conditional covariances of the Gaussians `rows` [M], [M, 3, 3]."""
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


def opacity_factor(white: Tensor, betas: Tensor) -> Tensor:
    """Compute the opacity factor prod_i (1 - tanh(y_i^2))^b_i, [N], as in UBS.

    With x = y^2, ln(1 - tanh(x)) = -ln(1 + (e^2x - 1) / 2) loses no digits of a small x, which a large b multiplies.

    Args:
        white: whitened distances y of the direction and time of a query from their means, [N, C].
        betas: the parameters of the exponents, [N, 1 + C]; the first is that of the alpha profile.
    """
    doubled = (2 * white.square()).clamp(max=FADED)
    logs = (-log1p(torch.expm1(doubled) / 2)).clamp(min=BETA_LOG_MIN)
    return exp((exponents(betas[:, 1:]) * logs).sum(-1))


def positive(x: Tensor) -> Tensor:
    """Compute the sizes softplus(x), held within exp(+-LOG_SIZE_MAX)."""
    return F.softplus(x).clamp(math.exp(-LOG_SIZE_MAX), math.exp(LOG_SIZE_MAX))


def softplus_inverse(y: Tensor) -> Tensor:
    """Return x with softplus(x) = y, for y > 0."""
    return y + log(-torch.expm1(-y))


def skew_factor(scales: Tensor, skew: Tensor) -> Tensor:
    """Compute factors (I + A) diag(s) from parameters of sizes [N, 3] and the numbers A_01, A_02, A_12 [N, 3]."""
    one, (a, b, c) = torch.ones_like(skew[:, 0]), skew.unbind(-1)
    turn = torch.stack([one, a, b, -a, one, c, -b, -c, one], -1).unflatten(-1, (3, 3))
    return turn * positive(scales)[:, None, :]
