"""Compute at which times each Gaussian can be visible."""

import math

import torch
from torch import Tensor

from gsbench.kernels.headers import ALPHA_MIN
from gsbench.models.base import GaussianModel
from gsbench.models.elementary import log, sqrt


@torch.no_grad()
def visible_intervals(model: GaussianModel) -> Tensor | None:
    """Return the first and the last time at which each Gaussian can be visible, [N, 2]; None without time.

    A Gaussian with opacity o, mean time mu_t and lifetime s is visible at time t if o exp(-((t - mu_t) / s)^2 / 2)
    is at least 1/255. Times are in [0, 1]; (inf, inf) marks a Gaussian that is never visible. The intervals only
    serve to sort the Gaussians: they ignore AGR, the neural refinement.
    """
    lifetimes = model.lifetimes()
    if lifetimes is None:
        return None
    times, deviations = lifetimes
    opacities = torch.sigmoid(model.splats["opacities"])
    reach = sqrt(2 * log(opacities / ALPHA_MIN).clamp(min=0)) * deviations
    interval = torch.stack([times - reach, times + reach], 1)
    never = (reach == 0) | (interval[:, 1] < 0) | (interval[:, 0] > 1)
    return torch.where(never[:, None], math.inf, interval.clamp(0, 1))
