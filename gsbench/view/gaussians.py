"""Convert the 3D Gaussians of a model at a camera and a time to the form in which 3DGS stores trained Gaussians."""

import math

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.headers import ALPHA_MIN
from gsbench.models.base import GaussianModel, tensors_of
from gsbench.models.gaussians4d import Gaussians4DModel
from gsbench.models.query import Query
from gsbench.scenes.points import SH_C0
from gsbench.scenes.trained import TrainedGaussians

LEAST_SCALE = 1e-20  # world units; a slice that is flat to the last bit still has a logarithm
LARGEST_OPACITY = 1 - 2**-24  # the largest float32 below 1, whose logit is finite


def trained_of(model: GaussianModel, query: Query, *, keep_harmonics: bool = False) -> TrainedGaussians:
    """Slice a model and return the Gaussians that are drawn: those that are not culled by their opacity.

    Args:
        model: the initialised model.
        query: the viewpoint and the time at which to slice.
        keep_harmonics: whether colours stay harmonics of the direction; else each colour is the one seen from the
            query's viewpoint, as a harmonic of degree 0.

    Raises:
        InputError: harmonics are requested but the model's geometry or colours depend on the viewpoint; the slice has
            shapes; or no Gaussian is left, or one is not finite.
    """
    if keep_harmonics and not has_harmonics(model):
        raise InputError(f"expected --camera I or --direction X,Y,Z: a slice of {type(model).__name__} depends on it")
    with torch.no_grad():
        seen = model.slice(query)
        if seen.shapes is not None:
            raise InputError(f"PLY: expected a slice without shapes, got one of {type(model).__name__} that has them: "
                             f"3DGS' PLY has no field for them; export images or a video")  # fmt: skip
        means, factors, opacities, colors = (part.detach().cpu() for part in tensors_of(seen))
        drawn = opacities >= ALPHA_MIN  # the rasterizer skips an alpha below it, and no alpha is above the opacity
        if not drawn.any():
            raise InputError("no Gaussian can be seen at this time and from this place: choose others")
        sh = harmonics_at(model, query).cpu()[drawn] if keep_harmonics else (colors[drawn, None] - 0.5) / SH_C0
    if not factors[drawn].isfinite().all():
        raise InputError("expected finite Gaussians, some are not: has the training diverged?")
    log_scales, quats = decompose(factors[drawn])
    logits = torch.logit(opacities[drawn].double().clamp(max=LARGEST_OPACITY)).float()
    return TrainedGaussians(means[drawn], log_scales, quats, logits, sh[:, 0], sh[:, 1:])


def decompose(factors: Tensor) -> tuple[Tensor, Tensor]:
    """Decompose covariances F F^T = R S^2 R^T: ln S [N, 3] and the quaternions wxyz [N, 4] of the rotations R.

    The left singular vectors of F are the axes. If they are left-handed, one of them is negated.
    """
    axes, sizes, _ = torch.linalg.svd(factors.double())
    axes[:, :, 2] *= torch.where(torch.linalg.det(axes) < 0, -1.0, 1.0)[:, None]
    xyzw = torch.from_numpy(Rotation.from_matrix(axes.numpy()).as_quat())
    return sizes.clamp(min=LEAST_SCALE).log().float(), xyzw.roll(1, dims=1).float()


def has_harmonics(model: GaussianModel) -> bool:
    """Tell whether a slice of the model is the same from everywhere, and its colours are known harmonics."""
    own = type(model).shade in (GaussianModel.shade, Gaussians4DModel.shade)
    return own and "direction" not in model.observes


def harmonics_at(model: GaussianModel, query: Query) -> Tensor:
    """Return the harmonics of the colours at a query's time, [N, K, 3]; those not yet in use are left out."""
    used = (model.active.sh_degree + 1) ** 2
    sh0, shN = model.splats["sh0"], model.splats["shN"]
    if not isinstance(model, Gaussians4DModel):
        return torch.cat([sh0, shN], 1)[:, :used]
    waves = torch.cat([sh0.flatten(1, 2), shN], 1).unflatten(1, (model.time_degree + 1, -1))  # [N, M, K, 3]
    assert query.time is not None
    frequencies = torch.arange(model.time_degree + 1).to(waves)
    phase = 2 * math.pi * frequencies * (query.time - model.refined(query)["times"])  # AGR moves mean times too
    return (waves * torch.cos(phase)[..., None, None]).sum(1)[:, :used]
