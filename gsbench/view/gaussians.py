"""Convert a model, at a camera centre and a time, to 3D Gaussians in the format of trained 3DGS models."""

import math

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.headers import ALPHA_MIN
from gsbench.models.base import GaussianModel
from gsbench.models.gaussians4d import Gaussians4DModel
from gsbench.models.query import Query
from gsbench.models.sliced import Gaussians3D, reach
from gsbench.scenes.points import SH_C0
from gsbench.scenes.trained import TrainedGaussians

LEAST_SCALE = 1e-20  # world units; keeps the logarithm of a zero scale finite
LARGEST_OPACITY = 1 - 2**-24  # the largest float32 below 1, whose logit is finite


def trained_of(model: GaussianModel, query: Query, *, keep_harmonics: bool = False) -> TrainedGaussians:
    """Compute a model's 3D Gaussians at a viewpoint and a time, and return those with enough opacity to be drawn.

    Beta profiles become the Gaussians that look like them.

    Args:
        model: the initialised model.
        query: the viewpoint and the time at which to compute the Gaussians (a slice of the model).
        keep_harmonics: whether colours stay spherical harmonics of the view direction. Otherwise each Gaussian has the
            constant colour that is seen from the query's viewpoint.

    Raises:
        InputError: spherical harmonics are requested from a model whose geometry or colours depend on the viewpoint in
            another way, no Gaussian is drawn, or one is not finite.
    """
    check_harmonics(model, keep_harmonics)
    with torch.no_grad():
        seen = model.slice(query)
        means, factors, opacities, colors = (part.detach().cpu() for part in seen[:4])
        if seen.shapes is not None:
            factors = factors / reach(seen.shapes).cpu()[:, None, None]
        kept = drawn(seen).cpu()
        if not kept.any():
            raise InputError("no Gaussian can be seen at this time and from this place: choose others")
        sh = harmonics_at(model, query).cpu()[kept] if keep_harmonics else (colors[kept, None] - 0.5) / SH_C0
    if not factors[kept].isfinite().all():
        raise InputError("expected finite Gaussians, some are not: has the training diverged?")
    log_scales, quats = decompose(factors[kept])
    logits = torch.logit(opacities[kept].double().clamp(max=LARGEST_OPACITY)).float()
    return TrainedGaussians(
        means[kept], log_scales, quats, logits, sh[:, 0], sh[:, 1:], from_profiles=seen.shapes is not None
    )


def drawn(seen: Gaussians3D) -> Tensor:
    """Tell which Gaussians of a slice are drawn, bool [N]: the rasterizer skips an alpha below `ALPHA_MIN`.

    The alpha of a Gaussian is at most its opacity.
    """
    return seen.opacities >= ALPHA_MIN


def check_harmonics(model: GaussianModel, keep_harmonics: bool) -> None:
    """Raise InputError if colours shall stay spherical harmonics, but slices of the model depend on the viewpoint."""
    if keep_harmonics and not has_harmonics(model):
        raise InputError(
            f"expected --camera I or --direction X,Y,Z: a slice of {type(model).__name__} depends on it",
            docs="viewing.md#export",
        )


def decompose(factors: Tensor) -> tuple[Tensor, Tensor]:
    """Decompose covariances F F^T = R S^2 R^T into ln S [N, 3] and the quaternions wxyz [N, 4] of the rotations R.

    The columns of R are the left singular vectors of F. If they are left-handed, one of them is negated.
    """
    axes, sizes, _ = torch.linalg.svd(factors.double())
    axes[:, :, 2] *= torch.where(torch.linalg.det(axes) < 0, -1.0, 1.0)[:, None]
    xyzw = torch.from_numpy(Rotation.from_matrix(axes.numpy()).as_quat())
    return sizes.clamp(min=LEAST_SCALE).log().float(), xyzw.roll(1, dims=1).float()


def has_harmonics(model: GaussianModel) -> bool:
    """Tell whether a model's geometry does not depend on view direction and its colours are spherical harmonics."""
    own = type(model).shade in (GaussianModel.shade, Gaussians4DModel.shade)
    return own and "direction" not in model.observes


def harmonics_at(model: GaussianModel, query: Query) -> Tensor:
    """Return the spherical harmonics coefficients of the colours at a certain time, [N, K, 3].

    Only the degrees that are in use are returned.
    """
    used = (model.active.sh_degree + 1) ** 2
    sh0, shN = model.splats["sh0"], model.splats["shN"]
    if not isinstance(model, Gaussians4DModel):
        return torch.cat([sh0, shN], 1)[:, :used]
    waves = torch.cat([sh0.flatten(1, 2), shN], 1).unflatten(1, (model.time_degree + 1, -1))  # [N, M, K, 3]
    assert query.time is not None
    frequencies = torch.arange(model.time_degree + 1).to(waves)
    phase = 2 * math.pi * frequencies * (query.time - model.refined(query)["times"])  # AGR moves mean times too
    return (waves * torch.cos(phase)[..., None, None]).sum(1)[:, :used]
