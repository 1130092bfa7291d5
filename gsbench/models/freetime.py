"""Model a moving scene by FreeTimeGS: 3D Gaussians with a velocity, each visible around its mean time (2025).

Wang et al., "FreeTimeGS: Free Gaussian Primitives at Anytime and Anywhere", arXiv 2506.05348.
"""

import math
from typing import Any

import torch
from torch import Tensor

from gsbench.kernels.moving import slice_free_time
from gsbench.kernels.tensors import check_positive
from gsbench.models.base import Raw
from gsbench.models.elementary import exp
from gsbench.models.factors import sizes
from gsbench.models.moving3d import MovingGaussians3D
from gsbench.models.query import Query
from gsbench.models.registry import register
from gsbench.models.sliced import Geometry
from gsbench.scenes.scene import Points


@register("freetime")
class FreeTimeModel(MovingGaussians3D, gates=True):
    """FreeTimeGS: each Gaussian has a mean time mu_t, a standard deviation in time s and a velocity v,

        mean = mu_p + v (t - mu_t)      opacity = sigmoid(o) exp(-1/2 ((t - mu_t) / s)^2)      cov = R S S^T R^T

    A velocity is the movement during the whole time range [0, 1], in world units.
    """  # fmt: skip

    observes = ("time",)
    centers = ("means", "times")
    geometry = ("scales", "quats", "durations", "velocities")
    lengths = ("means", "velocities")
    moving = ("times", "durations", "velocities")

    def __init__(self, *, duration: float = math.sqrt(1 / 5), **options: Any) -> None:
        """Make a model without Gaussians.

        Args:
            duration: the initial standard deviation in time; by default that of 4DGS, because points have no times.
            options: the options of `GatedModel`.

        Raises:
            InputError: an option is out of its range.
        """
        super().__init__(**options)
        check_positive(duration, "duration")
        self.duration = duration

    def initial_geometry(self, points: Points, distances: Tensor, generator: torch.Generator) -> Raw:
        """Return spheres at rest with mean times uniform in [-0.1, 1.1]."""
        N = len(distances)
        return super().initial_geometry(points, distances, generator) | {
            "times": torch.rand(N, 1, generator=generator) * 1.2 - 0.1,
            "durations": torch.full((N, 1), math.log(self.duration)),
            "velocities": torch.zeros(N, 3),
        }

    def change(self, raw: Raw, query: Query) -> tuple[Tensor, Tensor]:
        """Return the shifts v (t - mu_t) of means [N, 3] and opacity factors exp(-1/2 ((t - mu_t) / s)^2) [N]."""
        assert query.time is not None
        delta = query.time - raw["times"]
        opacity_factor = exp(-0.5 * (delta / sizes(raw["durations"])).square())[:, 0]
        return raw["velocities"] * delta, opacity_factor

    def slice_geometry(self, raw: Raw, query: Query) -> Geometry:
        """Compute the moved 3D Gaussians by the backend's kernel if it has one, else in torch."""
        if not self.backend.serves(raw["means"]):
            return super().slice_geometry(raw, query)
        assert query.time is not None
        geometry = slice_free_time(
            raw["means"],
            raw["times"],
            raw["scales"],
            raw["quats"],
            raw["durations"],
            raw["velocities"],
            raw["opacities"],
            query.time,
            conditioned=self.conditioned,
        )
        return Geometry(*geometry)

    def lifetimes(self) -> tuple[Tensor, Tensor]:
        """Return the mean times mu_t [N] and the standard deviations s [N] in time."""
        return self.splats["times"].detach()[:, 0], sizes(self.splats["durations"].detach()[:, 0])

    def hold_lifetimes(self, least: float) -> None:
        """Raise the standard deviation in time of each Gaussian to at least `least`."""
        self.splats["durations"].data.clamp_(min=math.log(least))
