"""Define the base of models whose 3D Gaussians keep one shape, while means and opacities change.

Means and opacities change with time, in dGS and dBS also with the view direction; FreeTimeGS is another such model.
4DGS and 7DGS get their slices from a covariance over more dimensions instead.
"""

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor

from gsbench.models.base import Raw
from gsbench.models.effect_sets import EffectSets
from gsbench.models.gated import OPACITY_MARGIN, GatedModel
from gsbench.models.gaussians3d import Gaussians3DModel
from gsbench.models.query import Query
from gsbench.models.sliced import Conditioned, Geometry


class MovingGaussians3D(Gaussians3DModel):
    """3D Gaussians of 3DGS (rotation and scales) whose means and opacities depend on time or direction.

    Density control is that of 3DGS: a split makes two children that are 1.6 times smaller and move like their parent.
    """

    moving: ClassVar[tuple[str, ...]]  # names of the raw parameters that a static Gaussian does not use

    @abstractmethod
    def change(self, raw: Raw, query: Query) -> tuple[Tensor, Tensor]:
        """Return how far the means move [N, 3] and the factors of the opacities [N], for a camera centre and a time."""

    @abstractmethod
    def lifetimes(self) -> tuple[Tensor, Tensor] | None:
        """Return mean [N] and standard deviation [N] of each opacity as a function of time; None without time."""

    def condition(self, raw: Raw, query: Query) -> Conditioned:
        """Return the moved means, the covariance factors R S and the opacity factors for a camera centre and a time."""
        shift, opacity_factor = self.change(raw, query)
        return Conditioned(raw["means"] + shift, self.factors(raw), opacity_factor)

    def slice_geometry(self, raw: Raw, query: Query) -> Geometry:
        """Compute the 3D Gaussians for a camera and a time in torch; a model with a kernel overrides this."""
        return GatedModel.slice_geometry(self, raw, query)

    @torch.no_grad()
    def frozen(self, raw: Raw, queries: Sequence[Query], weights: Tensor) -> dict[str, Raw]:
        """Replace means and opacities by their weighted averages over views; see `GatedModel.frozen`."""
        exact = {name: value.double() for name, value in raw.items()}
        shift, opacity = torch.zeros_like(exact["means"]), torch.zeros_like(exact["opacities"])
        for query, weight in zip(queries, weights.double(), strict=True):
            moved, factor = self.change(exact, Query(query.center.double(), query.time))
            shift += weight[:, None] * moved
            opacity += weight * factor * torch.sigmoid(exact["opacities"])
        new = {"means": exact["means"] + shift,
               "opacities": torch.logit(opacity.clamp(OPACITY_MARGIN, 1 - OPACITY_MARGIN))}  # fmt: skip
        return {"static": {name: value.to(raw[name].dtype) for name, value in new.items()}}

    def kept(self, effect_sets: EffectSets) -> dict[str, Tensor]:
        """Return masks of the parameter entries that are used: a static Gaussian uses no parameter in `moving`."""
        masks = super().kept(effect_sets)
        if effect_sets.frozen is not None:
            rows = torch.arange(len(effect_sets.frozen), device=effect_sets.frozen.device)[:, None]
            masks |= dict.fromkeys(self.moving, rows < effect_sets.conditioned)
        return masks

    def log_duration(self, index: int) -> float | None:
        """Return the logarithm of the standard deviation in time of the Gaussian `index`; None without time."""
        lifetimes = self.lifetimes()
        return None if lifetimes is None else math.log(float(lifetimes[1][index]))
