"""Measure the PSNR of a model on views, which are rendered side by side."""

from collections.abc import Sequence

import torch
from torch import Tensor

from gsbench.lanes import side_by_side
from gsbench.measure.quality import psnr
from gsbench.models import GaussianModel
from gsbench.models.render import render
from gsbench.scenes import View


@torch.no_grad()
def mean_psnr(
    model: GaussianModel,
    views: Sequence[View],
    background: Tensor,  # [3]
    antialias: bool,
) -> float:
    """Return the mean PSNR of a model over views, dB."""

    def of_view(view: View) -> float:
        return psnr(render(model, view.camera, view.time, background, antialias), view.image)

    return sum(side_by_side(of_view, views, model.backend.lanes(model.splats["means"]))) / len(views)
