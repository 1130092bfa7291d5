"""The scene that speed is measured on, and the models that are sliced: a recipe, the same numbers everywhere."""

import math
from typing import Any

import torch
from torch import Tensor

from gsbench.kernels.headers import ALPHA_MIN
from gsbench.models import CameraTime, GaussianModel, build
from gsbench.models.cholesky import CholeskyModel
from gsbench.models.factors import KINDS
from gsbench.scenes.scene import Points
from gsbench.schedule import ActiveComponents
from gsbench.train.rows import Rows

SIGMA = 0.0083  # median standard deviation along an axis: a mean 3-sigma radius of 5 pixels at 400 x 400
SPREAD = 0.4  # of its logarithm
DISTANCE = 4.0
VISIBLE = 0.36  # of the Gaussians in a view of 4DGS at a quarter of trex' iterations (gsbench/train/rows.py)
TIME = 0.4  # of every view
SHORTER = 1.5  # of the logarithm of a life of dGS
FOCAL = 1.39  # times the width: D-NeRF's field of view, 0.69


def gaussians(N: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Means uniform in [-1, 1]^3, any rotation, log-normal scales, opacities uniform in [0.01, 0.99], any colours."""
    g = torch.Generator().manual_seed(seed)
    means = torch.rand(N, 3, generator=g) * 2 - 1
    scales = torch.exp(torch.randn(N, 3, generator=g) * SPREAD) * SIGMA
    rotations = torch.linalg.qr(torch.randn(N, 3, 3, generator=g))[0]
    opacities = torch.rand(N, generator=g) * 0.98 + 0.01
    return means, rotations * scales[:, None, :], opacities, torch.rand(N, 3, generator=g)


def camera(width: int, height: int | None = None) -> tuple[Tensor, Tensor]:
    """viewmats [1, 4, 4] and Ks [1, 3, 3] that look at the cube from DISTANCE; the image is square by default."""
    viewmat = torch.eye(4)
    viewmat[2, 3] = DISTANCE
    K = torch.tensor([[FOCAL * width, 0, width / 2], [0, FOCAL * width, (height or width) / 2], [0, 0, 1]])
    return viewmat[None], K[None]


def model(
    name: str, N: int, *, agr: bool = False, seed: int = 0, sigma: float = SIGMA, **options: Any
) -> GaussianModel:
    """A model of N Gaussians, whose slices are as large as the Gaussians of `gaussians` whatever N.

    The standard deviations of a slice along its axes are log-normal, of median `sigma` and spread SPREAD. Correlations
    and colours are not zero.
    """
    g = torch.Generator().manual_seed(seed)
    lambdas = {"6dgs": {"lambda_d": 0.05}, "7dgs": {"lambda_d": 0.05, "lambda_t": 0.05}}
    fitted = build(name, agr=agr, sh_degree=3, **lambdas.get(name, {}) | options)
    fitted.initialise(Points(torch.rand(N, 3, generator=g) * 2 - 1, torch.rand(N, 3, generator=g)), 1.0, g)
    with torch.no_grad():
        for key, parameter in fitted.splats.items():
            if key in (*KINDS, "shN"):
                parameter.add_(0.02 * torch.randn(parameter.shape, generator=g))
            if key == "opacities":
                parameter.copy_(torch.randn(N, generator=g))
        logs = fitted.splats[fitted.geometry[0]]  # [N, 3 or more], of which those in space are set
        space = fitted.rows["p"] if isinstance(fitted, CholeskyModel) else [0, 1, 2]
        logs[:, space] = math.log(sigma) + SPREAD * torch.randn(N, 3, generator=g)
    fitted.set_active(ActiveComponents(3, refine=agr, tunes_lambda=False))
    return fitted


class NoMoments:
    """Stands for the moments of an optimizer that has not begun."""

    def reindex(self, rows: Tensor, fresh: Tensor) -> None:
        """Have nothing to move."""

    def forget(self, parameter: Tensor) -> None:
        """Have nothing to zero."""


def trained(name: str, N: int, **options: Any) -> GaussianModel:
    """A `model` that observes time, of which VISIBLE is visible at TIME; its rows are sorted by time as in training.

    Mean times are spread around TIME until so few Gaussians reach it; some then lie outside of the clip.
    """
    fitted = model(name, N, **options)
    query = CameraTime.at(torch.tensor([0.0, 0.0, -DISTANCE]), TIME)
    with torch.no_grad():
        if name == "dgs":  # whose mean times are inside (0, 1): its Gaussians live shortly instead
            fitted.splats["precision"][:, 6] += SHORTER
        offsets = fitted.splats["times"] - TIME
        log_spread = 0.0
        for halvings in range(12):  # the share that is visible falls with the spread
            fitted.splats["times"].copy_(TIME + offsets * math.exp(log_spread))
            visible = (fitted.slice(query).opacities >= ALPHA_MIN).float().mean()
            log_spread += (1 if visible > VISIBLE else -1) * 4.0 / 2**halvings
    Rows(fitted, NoMoments()).sort_by_time()
    return fitted
