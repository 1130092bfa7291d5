"""Find the Gaussians that contribute most to the training images, so that the others can be removed.

The contribution of a Gaussian is the sum of its blend weights over all pixels of all views. A blend weight is alpha
times the transmittance in front of the Gaussian (3DGS, eq. 3).
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from gsbench.models import GaussianModel, Query
from gsbench.models.render import rasterize_slice
from gsbench.scenes import View


def blend_weights(model: GaussianModel, views: Sequence[View], antialias: bool) -> Tensor:
    """Return for each Gaussian the sum of its blend weights over all pixels of the views, [N].

    The sum is computed as a gradient: a pixel is linear in the colours, so the derivative of the sum of all pixels with
    respect to the colour of a Gaussian is the sum of its blend weights.
    """
    total = torch.zeros_like(model.splats["opacities"].detach())
    for view in views:
        with torch.no_grad():
            seen = model.slice(Query.of(view.camera, view.time))
        ones = torch.ones_like(seen.colors).requires_grad_()
        black = torch.zeros(3, device=ones.device)
        image = rasterize_slice(seen._replace(colors=ones), view.camera, black, model.backend, antialias).image
        (weights,) = torch.autograd.grad(image.sum(), ones)
        total += weights[:, 0]
    return total


def heaviest(weights: Tensor, share: float) -> Tensor:
    """Return the sorted indices of the Gaussians with the largest weights, a fraction `share` of all Gaussians."""
    keep = max(1, round(share * len(weights)))
    return weights.argsort(descending=True, stable=True)[:keep].sort().values
