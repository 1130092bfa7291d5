"""Model scenes by dBS: dGS with Beta profiles (2026).

The equations are those of "direct conditioning", a text under review for NeurIPS 2026, with the constants of the
authors' code.
"""

import math
from typing import Any, ClassVar

import torch
from torch import Tensor

from gsbench.kernels.moving import slice_direct_beta
from gsbench.kernels.tensors import check_positive
from gsbench.models.base import Raw
from gsbench.models.beta import BetaModel, exponents, opacity_factor, positive, profiles, shift_weights
from gsbench.models.dgs import COUPLING_SPREAD, TIME_PRECISION, coupling_matrix, precision_factor
from gsbench.models.elementary import log
from gsbench.models.factors import sizes
from gsbench.models.moving3d import MovingGaussians3D
from gsbench.models.query import Query, unit
from gsbench.models.registry import register
from gsbench.models.sliced import Conditioned, Geometry, reach
from gsbench.scenes.scene import Points


@register("dbs")
class DirectBetaModel(BetaModel, MovingGaussians3D, gates=True):
    """dBS: Gaussians with Beta profiles that move and fade with the direction d from the camera and the time t.

    Let q = (d, t), delta = q - mu_q, and V_qq = L L^T the precision over direction and time. Then

        z       = L^T delta                    opacity = sigmoid(o) prod_i (1 - tanh(z_i^2))^b_i
        mean    = mu_p + V_pq diag(min(b_q / 4, 1)) V_qq delta         V_pq = s Theta / |Theta|, s: mean of three sizes
        cov     = (I + A) S S^T (I + A)^T, for all times and directions

    No gradient flows through d. L is lower triangular over direction and has one entry for time.
    """  # fmt: skip

    observes: ClassVar[tuple[str, ...]] = ("time", "direction")
    centers: ClassVar[tuple[str, ...]] = ("means", "times", "directions")
    geometry: ClassVar[tuple[str, ...]] = ("scales", "skew", "precision", "coupling", "betas")
    moving: ClassVar[tuple[str, ...]] = ("times", "directions", "precision", "coupling")

    def __init__(self, *, view_precision: float = 1.0, **options: Any) -> None:
        """Make a model without Gaussians.

        Args:
            view_precision: the initial diagonal of L over direction. The authors use 2.5 for the cloud of 7DGS-PBR, 0.4
                for its other scenes, and 1.0 elsewhere.
            options: the options of `GatedModel`.

        Raises:
            InputError: an option is out of its range.
        """
        super().__init__(**options)
        check_positive(view_precision, "view_precision")
        self.view_precision = view_precision

    def initial_geometry(self, points: Points, distances: Tensor, generator: torch.Generator) -> Raw:
        """Return spheres with mean directions uniform in [-1, 1]^3 and mean times uniform in [0, 1]."""
        raw = super().initial_geometry(points, distances, generator)
        N, view = len(distances), math.log(self.view_precision)
        precision = [view, 0.0, view, 0.0, 0.0, view] + [math.log(TIME_PRECISION)] * ("time" in self.observes)
        raw["precision"] = torch.tensor(precision).repeat(N, 1)
        raw["coupling"] = COUPLING_SPREAD * torch.randn(N, 3 * (raw["betas"].shape[1] - 1), generator=generator)
        return raw

    def condition(self, raw: Raw, query: Query) -> Conditioned:
        """Return moved means, covariance factors, opacity factors and the exponents of the profiles."""
        return super().condition(raw, query)._replace(shapes=profiles(raw))

    def static(self, raw: Raw) -> Conditioned:
        """Return the Gaussians at their means, with their profiles."""
        return super().static(raw)._replace(shapes=profiles(raw))

    def change(self, raw: Raw, query: Query) -> tuple[Tensor, Tensor]:
        """Return how far the means move [N, 3] and the factors of the opacities [N], by the formulas of the class."""
        delta = unit(raw["means"] - query.center).detach() - raw["directions"]
        if "time" in self.observes:
            assert query.time is not None
            delta = torch.cat([delta, query.time - raw["times"]], -1)
        L = precision_factor(raw["precision"])
        white = (L.mT @ delta[..., None])[..., 0]
        V_pq = coupling_matrix(raw["coupling"], positive(raw["scales"]))
        moved = V_pq @ (shift_weights(raw["betas"]) * (L @ white[..., None])[..., 0])[..., None]
        return moved[..., 0], opacity_factor(white, raw["betas"])

    def slice_geometry(self, raw: Raw, query: Query) -> Geometry:
        """Compute the moved 3D Gaussians and their exponents by the backend's kernel if it has one, else in torch."""
        if not self.backend.serves(raw["means"]):
            return super().slice_geometry(raw, query)
        geometry = slice_direct_beta(
            raw["means"],
            raw["directions"],
            raw["times"] if "time" in self.observes else None,
            raw["scales"],
            raw["skew"],
            raw["precision"],
            raw["coupling"],
            raw["betas"],
            raw["opacities"],
            query.center,
            query.time,
            conditioned=self.conditioned,
        )
        return Geometry(*geometry)

    def lifetimes(self) -> tuple[Tensor, Tensor] | None:
        """Return mean times [N] and standard deviations [N] of the Gaussians exp(-b z^2); None without time.

        They bound the opacity factors (1 - tanh(z^2))^b, with z = L_tt (t - mu_t).
        """
        if "time" not in self.observes:
            return None
        L_tt = sizes(self.splats["precision"].detach()[:, -1])
        b = exponents(self.splats["betas"].detach()[:, -1])
        return self.splats["times"].detach()[:, 0], 1 / (reach(b) * L_tt)

    def hold_lifetimes(self, least: float) -> None:
        """Lower the entry L_tt of each precision such that the lifetime is at least `least`."""
        b = exponents(self.splats["betas"].detach()[:, -1])
        self.splats["precision"].data[:, -1].clamp_(max=-log(reach(b) * least))


@register("dbs_static")
class StaticDirectBetaModel(DirectBetaModel, gates=True):
    """dBS over direction alone, for scenes without time."""

    observes: ClassVar[tuple[str, ...]] = ("direction",)
    centers: ClassVar[tuple[str, ...]] = ("means", "directions")
    moving: ClassVar[tuple[str, ...]] = ("directions", "precision", "coupling")
