"""Start a model from trained 3D Gaussians: their means, shapes, opacities and colours become its own."""

import math

import torch
from torch import Tensor

from gsbench.models.base import GaussianModel, Raw
from gsbench.models.factors import rotation, sizes
from gsbench.models.gaussians3d import Gaussians3DModel
from gsbench.models.gaussians4d import Gaussians4DModel
from gsbench.models.triangular import TriangularModel
from gsbench.scenes.points import SH_C0
from gsbench.scenes.scene import Points
from gsbench.scenes.trained import TrainedGaussians

FLATTEST = 1e-9  # thinnest side of a Gaussian in units of its widest, in a triangular factor


@torch.no_grad()
def start_from(model: GaussianModel, trained: TrainedGaussians, extent: float, generator: torch.Generator) -> None:
    """Initialise a model at trained 3D Gaussians.

    What they do not know, such as times and directions, starts as it does at points. Harmonics of a higher degree than
    the model's are left out.

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
    for name, value in shaped(model, trained, raw).items():
        raw[name].copy_(value)


def shaped(model: GaussianModel, trained: TrainedGaussians, raw: Raw) -> Raw:
    """Return the raw parameters of a model that have the shape of `trained` in space, given its own initial ones.

    A model that is not known here starts with spheres of the same volume.
    """
    if isinstance(model, Gaussians3DModel):
        return {"scales": trained.log_scales, "quats": trained.quats}
    if isinstance(model, Gaussians4DModel):
        left, right = quaternions_in_space(trained.quats)
        scales = torch.cat([trained.log_scales, raw["scales"][:, 3:]], 1)
        return {"scales": scales, "left_quats": left, "right_quats": right}
    if isinstance(model, TriangularModel):
        return triangular(model, trained, raw)
    points, radii = Points(trained.means, trained.means), trained.log_scales.mean(1).exp()
    spheres = model.initial_geometry(points, radii, torch.Generator().manual_seed(0))
    return {name: spheres[name] for name in model.geometry}


def triangular(model: TriangularModel, trained: TrainedGaussians, raw: Raw) -> Raw:
    """Return the triangular factor of `raw` with the block of position replaced by the shape of `trained`."""
    space = torch.tensor(model.rows["p"])
    double = {name: value.double() for name, value in raw.items()}
    factor = model.triangle.factor(double["log_diagonal"], double)  # diagonal: the model starts without coupling
    # The thinnest side of a flat Gaussian becomes a difference of numbers as large as its widest side.
    log_scales = trained.log_scales.double()
    log_scales = log_scales.clamp(min=log_scales.amax(1, keepdim=True) + math.log(FLATTEST))
    factor[:, space[:, None], space] = rotation(trained.quats.double()) * sizes(log_scales)[:, None, :]
    return model.triangle.parameters(factor)


def quaternions_in_space(quats: Tensor) -> tuple[Tensor, Tensor]:
    """Return the two quaternions of `rotation4d` that turn (x, y, z) by a quaternion wxyz and leave t as it is.

    `rotation4d(l, r)` maps v = x + y i + z j + t k to l v r*. It leaves k as it is where r = k* l k, and then turns
    v k* = t - z i + y j - x k by l: the axis (x, y, z) is (z, -y, x) there.
    """
    w, x, y, z = quats.unbind(-1)
    return torch.stack([w, z, -y, x], -1), torch.stack([w, -z, y, x], -1)
