"""Model a static scene by the 3D Gaussians of 3DGS (Kerbl et al. 2023)."""

import math
from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor

from gsbench.kernels.operation import Operation
from gsbench.kernels.slices import slice_static
from gsbench.models.base import SHRINK, Raw
from gsbench.models.camera_time import CameraTime
from gsbench.models.factors import rotation, sizes
from gsbench.models.gated import GatedModel
from gsbench.models.gaussian_batch import Conditioned
from gsbench.models.portable_math import log
from gsbench.models.registry import register
from gsbench.scenes.gaussian_ply import TrainedGaussians
from gsbench.scenes.scene import Points


@register("3dgs")
class Gaussians3DModel(GatedModel, gates=True):
    """3DGS: the covariance of a Gaussian is R S S^T R^T, with rotation R and scales S (3DGS, eq. 6)."""

    geometry: ClassVar[tuple[str, ...]] = ("scales", "quats")
    kernel: Operation | None = slice_static
    takes_views = True

    def initial_geometry(self, points: Points, distances: Tensor, generator: torch.Generator) -> Raw:
        """Return spheres whose radii are the distances [N] of the points to their neighbours."""
        quats = torch.zeros(len(distances), 4)
        quats[:, 0] = 1
        return {"scales": log(distances)[:, None].repeat(1, 3), "quats": quats}

    def condition(self, raw: Raw, query: CameraTime) -> Conditioned:
        return self.static(raw)

    def shaped_as(self, trained: TrainedGaussians, raw: Raw) -> Raw:
        return {"scales": trained.log_scales, "quats": trained.quats}

    def static(self, raw: Raw) -> Conditioned:
        return Conditioned(raw["means"], self.factors(raw), torch.ones_like(raw["opacities"]))

    def frozen(self, raw: Raw, queries: Sequence[CameraTime], weights: Tensor) -> dict[str, Raw]:
        return {}

    def spatial_scales(self) -> Tensor:
        return sizes(self.splats["scales"])

    def hold_sizes(self, least: Tensor) -> None:
        self.splats["scales"].data.clamp_(min=log(least)[:, None])

    @torch.no_grad()
    def shrink_rows(self, rows: Tensor, factors: Tensor) -> None:
        self.splats["scales"].data[rows] += log(factors)[:, None].to(self.splats["scales"].dtype)

    def spread(self, rows: Tensor) -> Tensor:
        return self.factors(self.raw_of(rows))

    def split(self, raw: Raw, generator: torch.Generator) -> Raw:
        """Sample the means of children from the parent Gaussian, with scales 1.6 times smaller (3DGS, section 5.2)."""
        z = torch.randn(raw["means"].shape, generator=generator).to(raw["means"])
        means = raw["means"] + (self.factors(raw) @ z[..., None])[..., 0]
        return {"means": means, "scales": raw["scales"] - math.log(SHRINK)}

    @staticmethod
    def factors(raw: Raw) -> Tensor:
        """Compute the factors R S of the covariances, rotation times scale, [N, 3, 3]."""
        return rotation(raw["quats"]) * sizes(raw["scales"])[:, None, :]
