"""Model scenes by UBS, Universal Beta Splatting: Beta profiles over position, direction and time (2026).

Liu et al., "Universal Beta Splatting", ICLR 2026, with the constants of the authors' code.
"""

from typing import Any, ClassVar

import torch
from torch import Tensor

from gsbench.errors import InputError, did_you_mean
from gsbench.kernels.slices import slice_universal
from gsbench.kernels.tensors import check_positive
from gsbench.models.base import Raw
from gsbench.models.beta import (
    BetaModel,
    exponents,
    opacity_factor,
    positive,
    profiles,
    shift_weights,
    skew_factor,
    softplus_inverse,
)
from gsbench.models.elementary import sqrt
from gsbench.models.query import Query, unit
from gsbench.models.registry import register
from gsbench.models.sliced import Conditioned, Geometry, reach
from gsbench.models.slicing import Reduced, cholesky3, gain_of, reduce, triangularise, whiten
from gsbench.scenes.scene import Points

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
    """  # fmt: skip

    observes: ClassVar[tuple[str, ...]] = ("time", "direction")
    centers: ClassVar[tuple[str, ...]] = ("means", "times", "directions")
    geometry: ClassVar[tuple[str, ...]] = ("scales", "skew", "lower", "betas")

    def __init__(
        self, *, time_size: float = 1.0, view_size: float = 1.0, modulation: str = "whitened", **options: Any
    ) -> None:
        """Make a model without Gaussians.

        Args:
            time_size: the initial size of the Gaussians in time.
            view_size: their initial size in direction.
            modulation: where B acts. `whitened`: as in the class. `raw`: mean = mu_p + K B delta and cov = S_pp - K B
                S_qp with K = S_pq S_qq^-1, as in the authors' code. This matrix is not symmetric; its upper triangle is
                used, and where that is indefinite the Gaussian becomes flat.
            options: the options of `GaussianModel`.

        Raises:
            InputError: an option is out of its range.
        """
        super().__init__(**options)
        if modulation not in MODULATIONS:
            raise InputError(f"modulation '{modulation}' is not known. {did_you_mean(modulation, MODULATIONS)}")
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

    def condition(self, raw: Raw, query: Query) -> Conditioned:
        """Return means, covariance factors, opacity factors and exponents of profiles, by the formulas of the class."""
        reduced = reduce(joint_factor(raw))
        parts = [unit(raw["means"] - query.center) - raw["directions"]]
        if "time" in self.observes:
            assert query.time is not None
            parts.append(query.time - raw["times"])
        delta = torch.cat(parts, -1)
        white = whiten(reduced.T_qq, delta)
        weights = shift_weights(raw["betas"])
        if self.modulation == "whitened":
            shift = (reduced.T_pq * (weights * white)[:, None]).sum(-1)
        else:
            shift = (gain_of(reduced.T_pq, reduced.T_qq) * (weights * delta)[:, None]).sum(-1)
        factors = self._modulated(reduced, weights)
        profile = profiles(raw)
        return Conditioned(raw["means"] + shift, factors, opacity_factor(white, raw["betas"]), profile)

    def slice_geometry(self, raw: Raw, query: Query) -> Geometry:
        """Compute conditional 3D Gaussians by a kernel, or in torch if the backend has none for the modulation."""
        if self.modulation != "whitened" or not self.backend.serves(raw["means"]):
            return super().slice_geometry(raw, query)
        geometry = slice_universal(
            raw["means"],
            raw["directions"],
            raw["times"] if "time" in self.observes else None,
            raw["scales"],
            raw["skew"],
            raw["lower"],
            raw["betas"],
            raw["opacities"],
            query.center,
            query.time,
        )
        return Geometry(*geometry)

    def hold_lifetimes(self, least: float) -> None:
        """Raise the size of time such that the Gaussian exp(-b y_t^2) of each opacity factor is at least `least` long.

        This Gaussian bounds the opacity factor (1 - tanh(y_t^2))^b.
        """
        b = exponents(self.splats["betas"].detach()[:, -1])
        self.splats["scales"].data[:, -1].clamp_(min=softplus_inverse(reach(b) * least))

    def factors(self, raw: Raw) -> Tensor:
        """Compute the factors of the conditional covariances, [N, 3, 3], by the formula of the class."""
        return self._modulated(reduce(joint_factor(raw)), shift_weights(raw["betas"]))

    def _modulated(self, reduced: Reduced, weights: Tensor) -> Tensor:
        T_qq, T_pq, T_pp = reduced
        if self.modulation == "whitened":
            left = 1 - weights
            root = torch.where(left > 0, sqrt(torch.where(left > 0, left, 1.0)), 0.0)  # its gradient at 0 is infinite
            rows = torch.cat([T_pp, T_pq * root[:, None]], -1)
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
