"""Drop the Gaussians of the smallest blend weight, summed over the training views.

The blend weight of a Gaussian in a pixel is its alpha times the transmittance before it, so the sum over all pixels of
all views says how much it adds to the training images (the weight w_i of 3DGS eq. 3, summed).
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from gsbench.models import GaussianModel, Query
from gsbench.models.render import rasterize_slice
from gsbench.scenes import View


def blend_weights(model: GaussianModel, views: Sequence[View], antialias: bool) -> Tensor:
    """Sum each Gaussian's blend weights over the pixels of views, [N].

    An image is linear in the colours: with one channel of colour 1 for each Gaussian, the gradient of the sum of all
    pixels by a Gaussian's colour is the sum of its blend weights.
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
    """Return the rows of the `share` of Gaussians with the largest weights, in their order; the first of equal ones."""
    keep = max(1, round(share * len(weights)))
    return weights.argsort(descending=True, stable=True)[:keep].sort().values
