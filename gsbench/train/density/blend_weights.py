"""Compute by how much each Gaussian contributes to images: the sum of its blend weights.

A blend weight is alpha times the transmittance in front of the Gaussian (3DGS, eq. 3).
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from gsbench.kernels.tape import Tape
from gsbench.models import CameraTime, GaussianModel
from gsbench.models.render import rasterize_slice
from gsbench.scenes import View


def blend_weights(model: GaussianModel, views: Sequence[View], antialias: bool) -> Tensor:
    """Return for each Gaussian the sum of its blend weights over all pixels of the views, [N]."""
    total = torch.zeros_like(model.splats["opacities"].detach())
    black = total.new_zeros(3)
    for view in views:
        rendered = WeighedImage(model, view, black, antialias)
        total += rendered.weights(torch.ones_like(rendered.image[..., 0]))
    return total


class WeighedImage:
    """The image of a view, from which the blend weights of all Gaussians are computed.

    The weights are computed as a gradient: a pixel is linear in the colours, so the derivative of a sum of pixels with
    respect to the colour of a Gaussian is the sum of its blend weights on them.
    """

    def __init__(self, model: GaussianModel, view: View, background: Tensor, antialias: bool) -> None:
        """Render the view; `background` is its colour, [3]."""
        with torch.no_grad():
            gaussians = model.slice(CameraTime.of(view.camera, view.time))
        self._colors = gaussians.colors.detach().requires_grad_()  # [N, D]
        gaussians = gaussians._replace(colors=self._colors)
        with torch.enable_grad(), Tape() as self._tape:
            self._output = rasterize_slice(gaussians, view.camera, background, model.backend, antialias).image
        self.image = model.decode(self._output, view.camera)[0].detach()  # [H, W, 3]

    def weights(self, pixels: Tensor) -> Tensor:
        """Return for each Gaussian the sum of its blend weights times the factors `pixels` [H, W], [N]."""
        sums: dict[int, Tensor] = {}
        factors = pixels[None, ..., None].expand_as(self._output).contiguous()
        self._tape.backward(self._output, factors, [self._colors], sums)
        return sums.get(id(self._colors), torch.zeros_like(self._colors))[:, 0]  # each channel has the same weights


def heaviest(weights: Tensor, share: float) -> Tensor:
    """Return the sorted indices of the Gaussians with the largest weights, a fraction `share` of all Gaussians."""
    keep = max(1, round(share * len(weights)))
    return weights.argsort(descending=True, stable=True)[:keep].sort().values
