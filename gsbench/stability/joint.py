"""Compute the covariance factors of a trained 4DGS, 6DGS or 7DGS over position, time and direction."""

import torch
from torch import Tensor

from gsbench.models.factors import Triangle, rotation4d, sizes


def joint_factors(splats: dict[str, Tensor]) -> Tensor | None:
    """Return the factors [N, 3+k, 3+k] from the raw parameters of a model; None if it has no such covariance.

    The first three rows are position, and the k others time and direction. The model must store its factors in the
    default row order.
    """
    if "log_diagonal" in splats:
        k = splats["log_diagonal"].shape[1] - 3
        L = Triangle("dddtppp" if k == 4 else "dddppp").factor(splats["log_diagonal"], splats)
        return torch.cat([L[:, k:], L[:, :k]], 1)
    if "left_quats" in splats:
        R = rotation4d(splats["left_quats"], splats["right_quats"])
        return R * sizes(splats["scales"])[:, None, :]
    return None
