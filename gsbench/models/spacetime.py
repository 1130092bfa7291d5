"""Define Spacetime Gaussians, lite and full: 3D Gaussians on cubic paths that turn, and fade around their own times.

Li et al., "Spacetime Gaussian Feature Splatting for Real-Time Dynamic View Synthesis", CVPR 2024, arXiv 2312.16812,
with the constants of the authors' code.
"""

import math
from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gsbench.kernels.slices import slice_free_time
from gsbench.kernels.tensors import check_positive
from gsbench.models.appearance import sh_features
from gsbench.models.base import Raw
from gsbench.models.camera_time import CameraTime, initial_times, unit
from gsbench.models.factors import sizes
from gsbench.models.gaussian_batch import Conditioned
from gsbench.models.moving import MovingGaussians3D
from gsbench.models.networks import Linear
from gsbench.models.portable_math import exp, sigmoid
from gsbench.models.registry import register
from gsbench.scenes.points import SH_C0
from gsbench.scenes.scene import Camera, Points

HIDDEN = 6  # units of the decoder
LOG_ROOT_2 = 0.5 * math.log(2)  # exp(-(x / s)^2) has the standard deviation s / sqrt(2)


@register("stg")
class SpacetimeModel(MovingGaussians3D, gates=True):
    """Spacetime Gaussians, lite: each has a mean time mu_t, a duration s, a cubic path b1, b2, b3 and a turn w,

        mean = mu_p + b1 e + b2 e^2 + b3 e^3      opacity = sigmoid(o) exp(-((t - mu_t) / s)^2)
        cov  = R S S^T R^T with R of the quaternion q + e w, normalised

    e = t - mu_t, by which no gradient flows: a mean time learns from the opacity alone, as in the authors' code.
    Density control gives clones and children mean times uniform in [0, 1].
    """

    observes = ("time",)
    centers = ("means", "times")
    geometry = ("scales", "quats", "durations", "path", "turns")
    lengths = ("means", "path")
    moving = ("times", "durations", "path", "turns")
    kernel = slice_free_time

    def __init__(
        self,
        *,
        duration: float = 1.0,  # initial s; the authors' for clips of 50 frames: 1 for N3V, exp(-2) for Technicolor
        **options: Any,
    ) -> None:
        super().__init__(**options)
        check_positive(duration, "duration")
        self.duration = duration

    def initial_geometry(self, points: Points, distances: Tensor, generator: torch.Generator) -> Raw:
        """Return spheres at rest, at the times of the points or at mean times uniform in [0, 1]."""
        N = len(distances)
        return super().initial_geometry(points, distances, generator) | {
            "times": initial_times(points, generator, margin=0),
            "durations": torch.full((N, 1), math.log(self.duration)),
            "path": torch.zeros(N, 9),  # b1, b2, b3
            "turns": torch.zeros(N, 4),
        }

    def change(self, raw: Raw, query: CameraTime) -> tuple[Tensor, Tensor]:
        delta = offset(raw, query)
        white = delta / sizes(raw["durations"])
        return shift(raw, delta.detach()), exp(-white.square())[:, 0]

    def condition(self, raw: Raw, query: CameraTime) -> Conditioned:
        return super().condition(raw | {"quats": turned(raw, offset(raw, query).detach())}, query)

    def kernel_arguments(self, raw: Raw, query: CameraTime) -> dict[str, Any]:
        """Return Gaussians that were moved and turned in torch, of which FreeTimeGS' kernel makes the slice."""
        e = offset(raw, query).detach()[: self.conditioned]  # the first `conditioned` ones are not static; None: all
        e = F.pad(e, (0, 0, 0, len(raw["means"]) - len(e)))  # static Gaussians neither move nor turn
        at_time = {
            "means": raw["means"] + shift(raw, e),
            "quats": turned(raw, e),
            "durations": raw["durations"] - LOG_ROOT_2,  # to the standard deviations of FreeTimeGS
            "velocities": torch.zeros_like(raw["means"]),
        }
        return super().kernel_arguments(raw | at_time, query)

    @torch.no_grad()
    def frozen(self, raw: Raw, queries: Sequence[CameraTime], weights: Tensor) -> dict[str, Raw]:
        """Replace means, opacities and quaternions by their weighted averages over views."""
        offsets = torch.stack([offset(raw, query) for query in queries])  # [V, N, 1]
        quats = turned(raw, (weights[..., None].to(offsets) * offsets).sum(0))
        return {"static": super().frozen(raw, queries, weights)["static"] | {"quats": quats}}

    def clone(self, raw: Raw, generator: torch.Generator) -> Raw:
        """Return new mean times."""
        return {"times": torch.rand(raw["times"].shape, generator=generator).to(raw["times"])}

    def split(self, raw: Raw, generator: torch.Generator) -> Raw:
        """Return the children of 3DGS, with new mean times."""
        return super().split(raw, generator) | self.clone(raw, generator)

    def lifetimes(self) -> tuple[Tensor, Tensor]:
        return self.splats["times"].detach()[:, 0], sizes(self.splats["durations"].detach()[:, 0] - LOG_ROOT_2)

    def hold_lifetimes(self, least: float) -> None:
        self.splats["durations"].data.clamp_(min=math.log(least) + LOG_ROOT_2)


@register("stg_full")
class SpacetimeFeatureModel(SpacetimeModel):
    """Spacetime Gaussians, full: a Gaussian has nine features, and a small network decodes the pixels they blend to,

        blended = (base, view, e time)        pixel = sigmoid(base + V relu(U (view, e time, ray)))

    A ray is the camera's centre and the unit vector to the pixel. As the image is decoded, the model has no gates.
    """

    decoder: nn.Sequential  # U and V, of an initialised model

    def __init__(
        self,
        *,
        saturate: bool = False,  # by a sigmoid, as the authors for N3V; false: clip, as for Technicolor
        **options: Any,
    ) -> None:
        super().__init__(**options)
        self.saturate = saturate

    def initialise(self, points: Points, extent: float, generator: torch.Generator) -> None:
        super().initialise(points, extent, generator)
        hidden = Linear(3 + 3 + 6, HIDDEN, generator, relu=True, bias=False)
        self.decoder = nn.Sequential(hidden, Linear(HIDDEN, 3, generator, bias=False))

    def initial_colors(self, dc: Tensor) -> Raw:
        """Return the colours of the points as features of base and view, and features of time that are zero."""
        features = {"view_features": 0.5 + SH_C0 * dc, "time_features": torch.zeros_like(dc)}
        return super().initial_colors(dc) | features

    def shade(self, raw: Raw, means: Tensor, opacities: Tensor, query: CameraTime) -> Tensor:
        """Return the features of 3D Gaussians that are blended, [N, 9]; they may be negative."""
        coefficients = torch.cat([raw["sh0"], raw["shN"]], 1)
        base = sh_features(coefficients, unit(means - query.center), self.active.sh_degree)
        e = offset(raw, query).detach()
        return torch.cat([base, raw["view_features"], e * raw["time_features"]], 1)

    def decode(self, blended: Tensor, camera: Camera) -> Tensor:
        base, features = blended.split([3, 6], -1)
        rays = pixel_rays(camera).expand(*features.shape[:-1], 6)
        decoded = self.decoder(torch.cat([features, rays], -1).flatten(0, -2)).view_as(base)
        return sigmoid(base + decoded) if self.saturate else (base + decoded).clamp(0, 1)

    def groups(self) -> dict[str, list[nn.Parameter]]:
        return super().groups() | {"decoder": list(self.decoder.parameters())}


def pixel_rays(camera: Camera) -> Tensor:
    """Return the camera's centre and the unit vector to the centre of each pixel, world space, [H, W, 6]."""
    K = camera.K
    x, y = (torch.arange(size, dtype=K.dtype, device=K.device) + 0.5 for size in (camera.width, camera.height))
    (fx, _, cx), (_, fy, cy), _ = K
    right, down, forward = camera.viewmat[:3, :3]
    sight = ((x - cx) / fx)[:, None] * right + ((y - cy) / fy)[:, None, None] * down + forward  # [H, W, 3]
    return torch.cat([camera.center.expand_as(sight), unit(sight)], -1)


def offset(raw: Raw, query: CameraTime) -> Tensor:
    """Return t - mu_t, [N, 1]."""
    assert query.time is not None
    return query.time - raw["times"]


def shift(raw: Raw, e: Tensor) -> Tensor:
    """Return how far Gaussians have moved, [N, 3], at e = t - mu_t, [N, 1]."""
    b1, b2, b3 = raw["path"].split(3, -1)
    return e * (b1 + e * (b2 + e * b3))


def turned(raw: Raw, e: Tensor) -> Tensor:
    """Return the quaternions [N, 4] at e = t - mu_t, [N, 1]."""
    return raw["quats"] + e * raw["turns"]
