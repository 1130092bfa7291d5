"""Define dGS and dBS: 3D Gaussians that keep one shape, while means and opacities change with direction and time.

The equations are those of "direct conditioning", a text under review for NeurIPS 2026, with the constants of the
authors' code. `MovingGaussians3D` is also the base of FreeTimeGS and others.
"""

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor

from gsbench.errors import check_known
from gsbench.kernels.headers import DIRECT_FADING
from gsbench.kernels.slices import slice_direct, slice_direct_beta, slice_static
from gsbench.kernels.tensors import check_positive
from gsbench.models.base import Raw
from gsbench.models.beta import BetaModel, exponents, opacity_factor, positive, profiles, shift_weights
from gsbench.models.camera_time import CameraTime, initial_times, times_inside, unit
from gsbench.models.effect_sets import EffectSets
from gsbench.models.factors import sizes
from gsbench.models.gated import OPACITY_MARGIN
from gsbench.models.gaussian_batch import Conditioned, Geometry, reach
from gsbench.models.gaussians3d import Gaussians3DModel
from gsbench.models.portable_math import exp, log, logit
from gsbench.models.registry import register
from gsbench.scenes.scene import Points


class MovingGaussians3D(Gaussians3DModel):
    """3D Gaussians of 3DGS (rotation and scales) whose means and opacities depend on time or direction.

    Density control is that of 3DGS: a split makes two children that are 1.6 times smaller and move like their parent.
    """

    moving: ClassVar[tuple[str, ...]]  # names of the raw parameters that a static Gaussian does not use

    @abstractmethod
    def change(self, raw: Raw, query: CameraTime) -> tuple[Tensor, Tensor]:
        """Return how far the means move [N, 3] and the factors of the opacities [N], for a camera centre and a time."""

    @abstractmethod
    def lifetimes(self) -> tuple[Tensor, Tensor] | None:
        """Return mean [N] and standard deviation [N] of each opacity as a function of time; None without time."""

    def condition(self, raw: Raw, query: CameraTime) -> Conditioned:
        shift, opacity_factor = self.change(raw, query)
        return Conditioned(raw["means"] + shift, self.factors(raw), opacity_factor)

    def slice_geometry(self, raw: Raw, query: CameraTime) -> Geometry:
        """Slice as other models do; where the kernel is that of 3DGS, torch moves and fades what it returns."""
        geometry = super().slice_geometry(raw, query)
        if self.kernel is not slice_static or not self.uses_kernel(raw):
            return geometry
        if self.conditioned is None:
            shift, factor = self.change(raw, query)
        else:  # static Gaussians neither move nor fade
            shift, factor = self.change({name: x[: self.conditioned] for name, x in raw.items()}, query)
            static = len(raw["means"]) - len(shift)
            shift, factor = F.pad(shift, (0, 0, 0, static)), F.pad(factor, (0, static), value=1.0)
        return geometry._replace(means=geometry.means + shift, opacities=geometry.opacities * factor)

    @torch.no_grad()
    def frozen(self, raw: Raw, queries: Sequence[CameraTime], weights: Tensor) -> dict[str, Raw]:
        """Replace means and opacities by their weighted averages over views; see `GatedModel.frozen`."""
        double = {name: value.double() for name, value in raw.items()}
        shift, opacity = torch.zeros_like(double["means"]), torch.zeros_like(double["opacities"])
        for query, weight in zip(queries, weights.double(), strict=True):
            moved, factor = self.change(double, CameraTime(query.center.double(), query.time))
            shift += weight[:, None] * moved
            opacity += weight * factor * torch.sigmoid(double["opacities"])
        means_over_views = {
            "means": double["means"] + shift,
            "opacities": torch.logit(opacity.clamp(OPACITY_MARGIN, 1 - OPACITY_MARGIN)),
        }
        return {"static": {name: value.to(raw[name].dtype) for name, value in means_over_views.items()}}

    def used_entries(self, effect_sets: EffectSets) -> dict[str, Tensor]:
        masks = super().used_entries(effect_sets)
        if effect_sets.orders is not None:
            masks |= dict.fromkeys(self.moving, effect_sets.is_conditioned[:, None])
        return masks


COUPLINGS = ("text", "interpolated", "none")
TIME_PRECISION = math.sqrt(10)  # initial L_tt
SHARES = -1.2  # initial logits of Lam
LARGEST_SHARE = 0.999  # of Lam after `shrink_rows`: the logit of 1 is infinite
COUPLING_SPREAD = 0.01  # initial standard deviation of the entries of Theta


@register("dgs")
class DirectModel(MovingGaussians3D, gates=True):
    """dGS: 3D Gaussians that move and fade with the direction d from the camera and the time t.

    Let q = (d, t), delta = q - mu_q with the mean mu_q, and V_qq = L L^T the precision over direction and time. Then

        mean    = mu_p + V_pq diag(Lam) V_qq delta        V_pq = s Theta / |Theta|, s: mean of the three scales
        opacity = sigmoid(o) exp(-lambda_o |L^T delta|^2)   lambda_o = 0.35
        cov     = R S S^T R^T, for all times and directions

    The learned parameters of motion are Theta [3, 4] and Lam. L is lower triangular over direction and has one entry
    for time. Lam has one number in [0, 1] for the three columns of direction and one for time. No gradient flows
    through d.
    """

    observes = ("time", "direction")
    centers = ("means", "times", "directions")
    geometry = ("scales", "quats", "precision", "coupling", "shares")
    moving = ("times", "directions", "precision", "coupling", "shares")
    kernel = slice_direct
    takes_views = True

    def __init__(
        self,
        *,
        # How the mean moves. `text`: by the formula of the class. `interpolated`: by V_pq ((1 - Lam) delta + Lam V_qq
        # delta), as the comments of the authors' code say. `none`: not at all (the authors' dGS-O).
        coupling: str = "text",
        # The initial diagonal of L over direction. The authors use 0.02 for D-NeRF, 2.5 for the cloud of 7DGS-PBR, 0.4
        # for its other scenes, and 1.0 elsewhere.
        view_precision: float = 1.0,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        check_known("coupling", coupling, COUPLINGS)
        check_positive(view_precision, "view_precision")
        self.coupling = coupling
        self.view_precision = view_precision

    def initial_geometry(self, points: Points, distances: Tensor, generator: torch.Generator) -> Raw:
        """Return spheres with random mean directions, and mean times uniform in [-0.1, 1.1], clipped to [0, 1]."""
        N = len(distances)
        times = times_inside(initial_times(points, generator))
        view, time = math.log(self.view_precision), math.log(TIME_PRECISION)
        return super().initial_geometry(points, distances, generator) | {
            "times": logit(times),
            "directions": F.normalize(torch.randn(N, 3, generator=generator), dim=-1),
            "precision": torch.tensor([view, 0.0, view, 0.0, 0.0, view, time]).repeat(N, 1),  # a diagonal L
            "coupling": COUPLING_SPREAD * torch.randn(N, 12, generator=generator),
            "shares": torch.full((N, 2), SHARES),
        }

    def change(self, raw: Raw, query: CameraTime) -> tuple[Tensor, Tensor]:
        """Compute shifts of means [N, 3] and opacity factors [N] from the offsets delta of direction and time."""
        assert query.time is not None
        direction = unit(raw["means"] - query.center).detach()
        delta = torch.cat([direction - unit(raw["directions"]), query.time - torch.sigmoid(raw["times"])], -1)
        L = precision_factor(raw["precision"])
        white = (L.mT @ delta[..., None])[..., 0]  # L^T delta, so that V_qq delta is L white
        opacity_factor = exp(-DIRECT_FADING * white.square().sum(-1))
        if self.coupling == "none":
            return torch.zeros_like(raw["means"]), opacity_factor
        V_pq = coupling_matrix(raw["coupling"], sizes(raw["scales"]))
        shares = torch.sigmoid(raw["shares"])[:, [0, 0, 0, 1]]  # [N, 4] the diagonal of Lam
        shift = shares * (L @ white[..., None])[..., 0]
        if self.coupling == "interpolated":
            shift = shift + (1 - shares) * delta
        return (V_pq @ shift[..., None])[..., 0], opacity_factor

    def uses_kernel(self, raw: Raw) -> bool:
        return self.coupling == "text" and super().uses_kernel(raw)

    @torch.no_grad()
    def shrink_rows(self, rows: Tensor, factors: Tensor) -> None:
        """Multiply the scales of Gaussians by factors, and keep the motion of their means.

        The motion is proportional to the scales times Lam, so Lam is divided by the factors, up to LARGEST_SHARE.
        """
        super().shrink_rows(rows, factors)
        shares = torch.sigmoid(self.splats["shares"].data[rows])
        larger = (shares / factors[:, None].to(shares.dtype)).clamp(max=LARGEST_SHARE)
        self.splats["shares"].data[rows] = logit(larger)

    def lifetimes(self) -> tuple[Tensor, Tensor]:
        L_tt = sizes(self.splats["precision"].detach()[:, 6])
        # exp(-lambda_o (L_tt (t - mu_t))^2) = exp(-1/2 ((t - mu_t) / s)^2)
        return torch.sigmoid(self.splats["times"].detach()[:, 0]), 1 / (math.sqrt(2 * DIRECT_FADING) * L_tt)

    def hold_lifetimes(self, least: float) -> None:
        """Lower the entry L_tt of each precision such that the lifetime is at least `least`."""
        self.splats["precision"].data[:, 6].clamp_(max=-math.log(math.sqrt(2 * DIRECT_FADING) * least))


def coupling_matrix(coupling: Tensor, scales: Tensor) -> Tensor:
    """Compute V_pq = s Theta / |Theta| from Theta [N, 3 C] and scales [N, 3] with the mean s, [N, 3, C]."""
    size = scales.mean(-1)[:, None, None]
    return size * F.normalize(coupling, dim=-1).unflatten(-1, (3, -1))


def precision_factor(raw: Tensor) -> Tensor:
    """Compute the factor L [N, C, C] of the precision V_qq = L L^T over direction and, if C = 4, time.

    The parameters, [N, 6] or [N, 7], are the lower triangle over direction, row by row, and then the entry of time.
    """
    zero = torch.zeros_like(raw[:, 0])
    xx, yx, yy, zx, zy, zz, *time = raw.unbind(-1)
    xx, yy, zz = (sizes(entry) for entry in (xx, yy, zz))
    L = torch.stack([xx, zero, zero, yx, yy, zero, zx, zy, zz], -1).unflatten(-1, (3, 3))
    if not time:
        return L
    L = F.pad(L, (0, 1, 0, 1))  # with a row and a column of zeros
    return L + F.pad(sizes(time[0])[:, None, None], (3, 0, 3, 0))


@register("dbs")
class DirectBetaModel(BetaModel, MovingGaussians3D, gates=True):
    """dBS: Gaussians with Beta profiles that move and fade with the direction d from the camera and the time t.

    Let q = (d, t), delta = q - mu_q, and V_qq = L L^T the precision over direction and time. Then

        z       = L^T delta                    opacity = sigmoid(o) prod_i (1 - tanh(z_i^2))^b_i
        mean    = mu_p + V_pq diag(min(b_q / 4, 1)) V_qq delta         V_pq = s Theta / |Theta|, s: mean of three sizes
        cov     = (I + A) S S^T (I + A)^T, for all times and directions

    No gradient flows through d. L is lower triangular over direction and has one entry for time.
    """

    observes: ClassVar[tuple[str, ...]] = ("time", "direction")
    centers: ClassVar[tuple[str, ...]] = ("means", "times", "directions")
    geometry: ClassVar[tuple[str, ...]] = ("scales", "skew", "precision", "coupling", "betas")
    moving: ClassVar[tuple[str, ...]] = ("times", "directions", "precision", "coupling")
    kernel = slice_direct_beta
    takes_views = True

    # The authors' initial diagonals of L over direction are those of dGS, but 1.0 for D-NeRF.
    def __init__(self, *, view_precision: float = 1.0, **options: Any) -> None:
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

    def condition(self, raw: Raw, query: CameraTime) -> Conditioned:
        return super().condition(raw, query)._replace(beta_exponents=profiles(raw))

    def static(self, raw: Raw) -> Conditioned:
        return super().static(raw)._replace(beta_exponents=profiles(raw))

    def change(self, raw: Raw, query: CameraTime) -> tuple[Tensor, Tensor]:
        """Compute shifts of means [N, 3] and opacity factors [N] from the offsets delta of direction and time."""
        delta = unit(raw["means"] - query.center).detach() - raw["directions"]
        if "time" in self.observes:
            assert query.time is not None
            delta = torch.cat([delta, query.time - raw["times"]], -1)
        L = precision_factor(raw["precision"])
        white = (L.mT @ delta[..., None])[..., 0]  # z
        V_pq = coupling_matrix(raw["coupling"], positive(raw["scales"]))
        weighted = shift_weights(raw["betas"]) * (L @ white[..., None])[..., 0]  # diag(min(b_q / 4, 1)) V_qq delta
        return (V_pq @ weighted[..., None])[..., 0], opacity_factor(white, raw["betas"])

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
