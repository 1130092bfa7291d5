"""Start a model from trained 3D Gaussians, with their means, shapes, opacities and colours."""

import torch

from gsbench.models.base import GaussianModel
from gsbench.scenes.points import SH_C0
from gsbench.scenes.scene import Points
from gsbench.scenes.trained import TrainedGaussians


@torch.no_grad()
def start_from(model: GaussianModel, trained: TrainedGaussians, extent: float, generator: torch.Generator) -> None:
    """Initialise a model with trained 3D Gaussians.

    Other parameters, such as times and directions, start as they do from points. Harmonics above the model's degree
    are left out.

    Args:
        model: without Gaussians yet.
        trained: more than three.
        extent: of the scene, world units.
        generator: the source of all random numbers.

    Raises:
        InputError: there are too few Gaussians.
    """
    model.initialise(Points(trained.means, (0.5 + SH_C0 * trained.dc).clamp(0, 1)), extent, generator)
    raw = {name: parameter.data for name, parameter in model.splats.items()}
    raw["opacities"].copy_(trained.logits)
    raw["sh0"].view(-1, 3).copy_(trained.dc)
    known = min(trained.rest.shape[1], (model.sh_degree + 1) ** 2 - 1)
    raw["shN"][:, :known] = trained.rest[:, :known]  # of 4DGS those of the wave that does not change with time
    for name, value in model.shaped_as(trained, raw).items():
        raw[name].copy_(value)
