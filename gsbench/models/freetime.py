"""Define FreeTimeGS and two successors: 3D Gaussians with a velocity, which fade before and after a mean time.

Wang et al., "FreeTimeGS: Free Gaussian Primitives at Anytime and Anywhere", arXiv 2506.05348; the gate of the code of
FreeTimeGS++; "SharpTimeGS", arXiv 2602.02989v2.
"""

import math
from typing import Any, ClassVar

import torch
from torch import Tensor

from gsbench.kernels.operation import Operation
from gsbench.kernels.slices import slice_free_time, slice_static
from gsbench.kernels.tensors import check_positive
from gsbench.models.base import Raw
from gsbench.models.camera_time import CameraTime, initial_times
from gsbench.models.factors import sizes
from gsbench.models.moving import MovingGaussians3D
from gsbench.models.portable_math import exp, log, sigmoid
from gsbench.models.registry import register
from gsbench.scenes.scene import Points


@register("freetime")
class FreeTimeModel(MovingGaussians3D, gates=True):
    """FreeTimeGS: each Gaussian has a mean time mu_t, a standard deviation in time s and a velocity v,

        mean = mu_p + v (t - mu_t)      opacity = sigmoid(o) exp(-1/2 ((t - mu_t) / s)^2)      cov = R S S^T R^T

    A velocity is the movement during the whole time range [0, 1], in world units.
    """

    observes = ("time",)
    centers = ("means", "times")
    geometry: ClassVar[tuple[str, ...]] = ("scales", "quats", "durations", "velocities")
    lengths = ("means", "velocities")
    moving: ClassVar[tuple[str, ...]] = ("times", "durations", "velocities")
    kernel: Operation | None = slice_free_time
    takes_views = True

    def __init__(
        self,
        *,
        duration: float = math.sqrt(1 / 5),  # initial standard deviation in time: that of 4DGS
        **options: Any,
    ) -> None:
        super().__init__(**options)
        check_positive(duration, "duration")
        self.duration = duration

    def initial_geometry(self, points: Points, distances: Tensor, generator: torch.Generator) -> Raw:
        """Return spheres at rest with the mean times of the points, else uniform in [-0.1, 1.1]."""
        N = len(distances)
        return super().initial_geometry(points, distances, generator) | {
            "times": initial_times(points, generator),
            "durations": torch.full((N, 1), math.log(self.duration)),
            "velocities": torch.zeros(N, 3),
        }

    def change(self, raw: Raw, query: CameraTime) -> tuple[Tensor, Tensor]:
        assert query.time is not None
        delta = query.time - raw["times"]
        opacity_factor = exp(-0.5 * (delta / sizes(raw["durations"])).square())[:, 0]
        return raw["velocities"] * delta, opacity_factor

    def lifetimes(self) -> tuple[Tensor, Tensor]:
        return self.splats["times"].detach()[:, 0], sizes(self.splats["durations"].detach()[:, 0])

    def hold_lifetimes(self, least: float) -> None:
        self.splats["durations"].data.clamp_(min=math.log(least))


FIRST_PERMANENCE = -1.0  # g of FreeTimeGS++: G is 2e-9
PERMANENCE_WEIGHT = 1e-3  # of the mean of 1 - G in the loss


@register("freetime_plus")
class FreeTimePlusModel(FreeTimeModel, gates=True):
    """FreeTimeGS with the gate of FreeTimeGS++: a share G = sigmoid(20 g) of each opacity lasts for all times,

        opacity = sigmoid(o) (G + (1 - G) exp(-1/2 ((t - mu_t) / s)^2))      loss + 1e-3 mean(1 - G)

    Of FreeTimeGS++, the limit s < 1/6 second, the start from optical flow and the correction of colours are not here.
    """

    moving = (*FreeTimeModel.moving, "permanence")
    kernel = slice_static

    def initial_geometry(self, points: Points, distances: Tensor, generator: torch.Generator) -> Raw:
        raw = super().initial_geometry(points, distances, generator)
        return raw | {"permanence": torch.full_like(raw["durations"], FIRST_PERMANENCE)}

    def change(self, raw: Raw, query: CameraTime) -> tuple[Tensor, Tensor]:
        shift, passing = super().change(raw, query)
        G = permanent_share(raw)
        return shift, G + (1 - G) * passing

    def penalty(self) -> Tensor:
        """Return the weighted mean of 1 - G over all Gaussians, []; those that were made static have G = 1."""
        passing = 1 - permanent_share(dict(self.splats.items()))[: self.conditioned]
        return PERMANENCE_WEIGHT * passing.sum() / max(1, len(self))

    def fading_times(self, fading: Tensor, lifetimes: Tensor) -> Tensor:
        G = permanent_share(dict(self.splats.items())).detach()
        share = exp(-fading)
        passing = torch.where(share > G, (share - G) / (1 - G), 0.0)  # of G + (1 - G) passing = share; 0: never so low
        return super().fading_times(-log(passing), lifetimes)


def permanent_share(raw: Raw) -> Tensor:
    """Return the shares G = sigmoid(20 g) of the opacities that last for all times, [N]."""
    return sigmoid(20 * raw["permanence"][:, 0])


PLATEAU = 1e-6  # initial half-width r


@register("sharptime")
class SharpTimeModel(FreeTimeModel, gates=True):
    """SharpTimeGS: opacities are constant until r before and after the mean time, and fade beyond with sigma,

        mean = mu_p + v / f (t - mu_t)      opacity = sigmoid(o) exp(-(max(0, |t - mu_t| - r) / sigma)^2)
        f    = 1 + max(1, (sigma + r)^2)

    The text, arXiv 2602.02989v2, has no unit of time for f. Here it is the whole time range, as everywhere else. The
    text's start, its losses of lifetimes and normals and its density control are not here.
    """

    geometry = ("scales", "quats", "durations", "plateaus", "velocities")
    moving = (*FreeTimeModel.moving, "plateaus")

    def initial_geometry(self, points: Points, distances: Tensor, generator: torch.Generator) -> Raw:
        """Return the start of FreeTimeGS: sigma is sqrt(2) standard deviations, and r is nearly 0."""
        raw = super().initial_geometry(points, distances, generator)
        sigma, r = raw["durations"] + math.log(math.sqrt(2)), torch.full_like(raw["durations"], math.log(PLATEAU))
        return raw | {"durations": sigma, "plateaus": r}

    def change(self, raw: Raw, query: CameraTime) -> tuple[Tensor, Tensor]:
        assert query.time is not None
        delta = query.time - raw["times"]
        sigma, r = sizes(raw["durations"]), sizes(raw["plateaus"])
        f = 1 + (sigma + r).square().clamp(min=1)
        opacity_factor = exp(-((delta.abs() - r).clamp(min=0) / sigma).square())[:, 0]
        return raw["velocities"] * (delta / f), opacity_factor

    def lifetimes(self) -> tuple[Tensor, Tensor]:
        """Return mean times [N], and how far from them opacities fall to exp(-1/2), [N]."""
        sigma, r = (sizes(self.splats[name].detach()[:, 0]) for name in ("durations", "plateaus"))
        return self.splats["times"].detach()[:, 0], r + sigma / math.sqrt(2)

    def fading_times(self, fading: Tensor, lifetimes: Tensor) -> Tensor:
        r = sizes(self.splats["plateaus"].detach()[:, 0])  # lifetimes - r is sigma / sqrt(2), as FreeTimeGS' s
        return torch.where(fading > 0, r + super().fading_times(fading, lifetimes - r), 0.0)

    def hold_lifetimes(self, least: float) -> None:
        """Raise sigma until opacities fall to exp(-1/2) at `least` or later."""
        missing = least - sizes(self.splats["plateaus"].data)
        self.splats["durations"].data.clamp_(min=log((math.sqrt(2) * missing).clamp(min=1e-30)))  # 1e-30: no limit
