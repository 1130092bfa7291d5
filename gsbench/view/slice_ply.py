"""Convert a model, at a camera centre and a time, to 3D Gaussians in the PLY format of 3DGS, one file or a clip."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor
from tqdm import tqdm

from gsbench.errors import InputError
from gsbench.kernels.headers import ALPHA_MIN
from gsbench.measure.atomic import write_atomically
from gsbench.models.base import GaussianModel
from gsbench.models.camera_time import CameraTime
from gsbench.models.gaussian_batch import reach
from gsbench.models.gaussians4d import Gaussians4DModel
from gsbench.run.load import LoadedRun
from gsbench.scenes.gaussian_ply import TrainedGaussians, ply_of
from gsbench.scenes.placement import gaussians_to_user
from gsbench.scenes.points import SH_C0

LEAST_SCALE = 1e-20  # world units; keeps the logarithm of a zero scale finite
LARGEST_OPACITY = 1 - 2**-24  # the largest float32 below 1, whose logit is finite


class SlicePly(NamedTuple):
    """What a written PLY file holds."""

    path: Path
    gaussians: int  # their number
    from_profiles: bool  # whether they stand for Beta profiles that look like them


def write_ply(run: LoadedRun, query: CameraTime, path: Path, *, keep_harmonics: bool) -> SlicePly:
    """Write the 3D Gaussians of a query in the user's coordinates; see `trained_of`."""
    trained = trained_of(run.model, query, keep_harmonics=keep_harmonics)
    write_atomically(path, ply_of(gaussians_to_user(trained, run.scene.placement)))
    return SlicePly(path, len(trained), trained.from_profiles)


def write_clip(run: LoadedRun, queries: Sequence[CameraTime], folder: Path, *, keep_harmonics: bool) -> list[SlicePly]:
    """Write a PLY file for each query as frame0000.ply, frame0001.ply and so on into an empty or new folder.

    SuperSplat plays such a folder as a clip: one prefix, numbers of one width. If this fails, the files that were
    written are removed. A progress bar is shown on stderr.

    Raises:
        InputError: as of `trained_of`.
    """
    digits = max(4, len(str(len(queries) - 1)))
    paths = [folder / f"frame{i:0{digits}d}.ply" for i in range(len(queries))]
    is_new = not folder.exists()
    folder.mkdir(exist_ok=True)
    try:
        with tqdm(paths, desc=folder.name, unit="file") as bar:
            return [
                write_ply(run, query, path, keep_harmonics=keep_harmonics)
                for query, path in zip(queries, bar, strict=True)
            ]
    except BaseException:
        for path in paths:
            path.unlink(missing_ok=True)
        if is_new:
            folder.rmdir()
        raise


def trained_of(model: GaussianModel, query: CameraTime, *, keep_harmonics: bool = False) -> TrainedGaussians:
    """Compute a model's 3D Gaussians at a viewpoint and a time, and return those with enough opacity to be drawn.

    Beta profiles become the Gaussians that look like them. Colours stay spherical harmonics with `keep_harmonics`;
    otherwise each Gaussian has the constant colour that is seen from the query's viewpoint.

    Raises:
        InputError: the model decodes what is blended, spherical harmonics are requested from a model whose geometry or
            colours depend on the viewpoint in another way, no Gaussian is drawn, or one is not finite.
    """
    if model.decodes:
        raise InputError(
            "expected a model whose Gaussians have colours, this one decodes features after they are "
            "blended, for which a PLY has no field: use --images or --video",
            docs="viewing.md#export",
        )
    if keep_harmonics and not has_harmonics(model):
        raise InputError(
            "expected --camera I or --direction X,Y,Z: the model's Gaussians depend on the view direction",
            docs="viewing.md#export",
        )
    with torch.no_grad():
        gaussians = model.slice(query)
        means, factors, opacities, colors = (part.detach().cpu() for part in gaussians[:4])
        if gaussians.beta_exponents is not None:
            factors = factors / reach(gaussians.beta_exponents).cpu()[:, None, None]
        drawn = opacities >= ALPHA_MIN  # an alpha is at most the opacity, and the rasterizer skips lower ones
        if not drawn.any():
            when = "" if query.time is None else f" at time {float(query.time):g}"
            raise InputError(f"no Gaussian can be seen from this place{when}: choose another")
        sh = harmonics_at(model, query).cpu()[drawn] if keep_harmonics else (colors[drawn, None] - 0.5) / SH_C0
    if not factors[drawn].isfinite().all():
        raise InputError("expected finite Gaussians, some are not: has the training diverged?")
    log_scales, quats = decompose(factors[drawn])
    logits = torch.logit(opacities[drawn].double().clamp(max=LARGEST_OPACITY)).float()
    return TrainedGaussians(
        means[drawn], log_scales, quats, logits, sh[:, 0], sh[:, 1:], from_profiles=gaussians.beta_exponents is not None
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
    are_harmonics = type(model).shade in (GaussianModel.shade, Gaussians4DModel.shade)
    return are_harmonics and "direction" not in model.observes


def harmonics_at(model: GaussianModel, query: CameraTime) -> Tensor:
    """Return the SH coefficients of the colours at a certain time, [N, K, 3], of the degrees in use."""
    used = (model.active.sh_degree + 1) ** 2
    raw = model.refined(query)  # which AGR and fields change
    sh0, shN = raw["sh0"], raw["shN"]
    if not isinstance(model, Gaussians4DModel):
        return torch.cat([sh0, shN], 1)[:, :used]
    waves = torch.cat([sh0.flatten(1, 2), shN], 1).unflatten(1, (model.time_degree + 1, -1))  # [N, M, K, 3]
    assert query.time is not None
    frequencies = torch.arange(model.time_degree + 1).to(waves)
    phase = 2 * math.pi * frequencies * (query.time - raw["times"])
    return (waves * torch.cos(phase)[..., None, None]).sum(1)[:, :used]
