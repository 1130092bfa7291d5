"""Initialise a model with the means, covariances, opacities and colours of trained 3D Gaussians."""

import torch

from gsbench.models.base import GaussianModel
from gsbench.scenes.gaussian_ply import TrainedGaussians
from gsbench.scenes.points import SH_C0
from gsbench.scenes.scene import Points


@torch.no_grad()
def start_from(model: GaussianModel, trained: TrainedGaussians, extent: float, generator: torch.Generator) -> None:
    """Initialise a model with the means, covariances, opacities and colours of trained 3D Gaussians.

    Other parameters, such as mean times and directions, start as in a training from points. SH coefficients above the
    model's degree are left out.

    Args:
        model: a model without Gaussians.
        trained: at least four 3D Gaussians.
        extent: the radius of the scene, world units.
        generator: the source of all random numbers.

    Raises:
        InputError: there are fewer than four Gaussians.
    """
    model.initialise(Points(trained.means, (0.5 + SH_C0 * trained.dc).clamp(0, 1)), extent, generator)
    raw = {name: parameter.data for name, parameter in model.splats.items()}
    raw["opacities"].copy_(trained.logits)
    raw["sh0"].view(-1, 3).copy_(trained.dc)
    known = min(trained.rest.shape[1], (model.sh_degree + 1) ** 2 - 1)
    raw["shN"][:, :known] = trained.rest[:, :known]  # in 4DGS these are the coefficients that are constant in time
    for name, value in model.shaped_as(trained, raw).items():
        raw[name].copy_(value)
