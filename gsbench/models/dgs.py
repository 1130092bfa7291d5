"""Model moving, view-dependent scenes by dGS: 3D Gaussians that move and fade with time and view direction (2026).

The equations are those of "direct conditioning", a text under review for NeurIPS 2026, with the constants of the
authors' code.
"""

import math
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from gsbench.errors import InputError, did_you_mean
from gsbench.kernels.headers import DIRECT_FADING
from gsbench.kernels.moving import slice_direct
from gsbench.kernels.tensors import check_positive
from gsbench.models.base import Raw
from gsbench.models.elementary import exp
from gsbench.models.factors import sizes
from gsbench.models.moving3d import MovingGaussians3D
from gsbench.models.query import Query, times_inside, unit
from gsbench.models.registry import register
from gsbench.models.sliced import Geometry
from gsbench.scenes.scene import Points

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
    """  # fmt: skip

    observes = ("time", "direction")
    centers = ("means", "times", "directions")
    geometry = ("scales", "quats", "precision", "coupling", "shares")
    moving = ("times", "directions", "precision", "coupling", "shares")

    def __init__(self, *, coupling: str = "text", view_precision: float = 1.0, **options: Any) -> None:
        """Make a model without Gaussians.

        Args:
            coupling: how the mean moves. `text`: by the formula of the class. `interpolated`: by V_pq ((1 - Lam) delta
                + Lam V_qq delta), as the comments of the authors' code say. `none`: not at all (the authors' dGS-O).
            view_precision: the initial diagonal of L over direction. The authors use 0.02 for D-NeRF, 2.5 for the cloud
                of 7DGS-PBR, 0.4 for its other scenes, and 1.0 elsewhere.
            options: the options of `GatedModel`.

        Raises:
            InputError: an option is out of its range.
        """
        super().__init__(**options)
        if coupling not in COUPLINGS:
            raise InputError(f"coupling '{coupling}' is not known. {did_you_mean(coupling, COUPLINGS)}")
        check_positive(view_precision, "view_precision")
        self.coupling = coupling
        self.view_precision = view_precision

    def initial_geometry(self, points: Points, distances: Tensor, generator: torch.Generator) -> Raw:
        """Return spheres with random mean directions, and mean times uniform in [-0.1, 1.1], clipped to [0, 1]."""
        N = len(distances)
        times = times_inside(torch.rand(N, 1, generator=generator) * 1.2 - 0.1)
        view, time = math.log(self.view_precision), math.log(TIME_PRECISION)
        return super().initial_geometry(points, distances, generator) | {
            "times": times.logit(),
            "directions": F.normalize(torch.randn(N, 3, generator=generator), dim=-1),
            "precision": torch.tensor([view, 0.0, view, 0.0, 0.0, view, time]).repeat(N, 1),
            "coupling": COUPLING_SPREAD * torch.randn(N, 12, generator=generator),
            "shares": torch.full((N, 2), SHARES),
        }

    def change(self, raw: Raw, query: Query) -> tuple[Tensor, Tensor]:
        """Return how far the means move [N, 3] and the factors of the opacities [N], by the formulas of the class."""
        assert query.time is not None
        direction = unit(raw["means"] - query.center).detach()
        delta = torch.cat([direction - unit(raw["directions"]), query.time - torch.sigmoid(raw["times"])], -1)
        L = precision_factor(raw["precision"])
        white = (L.mT @ delta[..., None])[..., 0]
        opacity_factor = exp(-DIRECT_FADING * white.square().sum(-1))
        if self.coupling == "none":
            return torch.zeros_like(raw["means"]), opacity_factor
        V_pq = coupling_matrix(raw["coupling"], sizes(raw["scales"]))
        shares = torch.sigmoid(raw["shares"])[:, [0, 0, 0, 1]]
        shift = shares * (L @ white[..., None])[..., 0]
        if self.coupling == "interpolated":
            shift = shift + (1 - shares) * delta
        return (V_pq @ shift[..., None])[..., 0], opacity_factor

    def slice_geometry(self, raw: Raw, query: Query) -> Geometry:
        """Compute the moved 3D Gaussians by a kernel, or in torch if the backend has none for this `coupling`."""
        if self.coupling != "text" or not self.backend.serves(raw["means"]):
            return super().slice_geometry(raw, query)
        assert query.time is not None
        geometry = slice_direct(
            raw["means"],
            raw["directions"],
            raw["times"],
            raw["scales"],
            raw["quats"],
            raw["precision"],
            raw["coupling"],
            raw["shares"],
            raw["opacities"],
            query.center,
            query.time,
            conditioned=self.conditioned,
        )
        return Geometry(*geometry)

    @torch.no_grad()
    def shrink_rows(self, rows: Tensor, factors: Tensor) -> None:
        """Multiply the scales of Gaussians by factors, and keep the motion of their means.

        The motion is proportional to the scales times Lam, so Lam is divided by the factors, up to LARGEST_SHARE.
        """
        super().shrink_rows(rows, factors)
        shares = torch.sigmoid(self.splats["shares"].data[rows])
        larger = (shares / factors[:, None].to(shares.dtype)).clamp(max=LARGEST_SHARE)
        self.splats["shares"].data[rows] = larger.logit()

    def lifetimes(self) -> tuple[Tensor, Tensor]:
        """Return the mean time [N] of each Gaussian, and the standard deviation [N] of its opacity over time."""
        L_tt = sizes(self.splats["precision"].detach()[:, 6])
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
    xx, yy, zz = (sizes(log) for log in (xx, yy, zz))
    L = torch.stack([xx, zero, zero, yx, yy, zero, zx, zy, zz], -1).unflatten(-1, (3, 3))
    if not time:
        return L
    L = F.pad(L, (0, 1, 0, 1))
    return L + F.pad(sizes(time[0])[:, None, None], (3, 0, 3, 0))
