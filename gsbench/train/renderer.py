"""Render views of a model by the config of its run, and measure their PSNR."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gsbench.measure.quality import psnr
from gsbench.models import GaussianModel
from gsbench.models.render import render
from gsbench.process.workers import side_by_side
from gsbench.scenes import View


@dataclass(frozen=True)
class Renderer:
    """The settings of rendering that all images of a run share."""

    background: Tensor  # [3]
    antialias: bool  # see `gsbench.raster.rasterize`

    @torch.no_grad()
    def image(self, model: GaussianModel, view: View) -> Tensor:
        """Render the image [H, W, 3] of a view."""
        return render(model, view.camera, view.time, self.background, self.antialias)

    @torch.no_grad()
    def psnr(self, model: GaussianModel, views: Sequence[View]) -> float:
        """Measure the mean PSNR of a model over views in dB; several views are rendered at the same time."""

        def of_view(view: View) -> float:
            return psnr(self.image(model, view), view.image)

        return sum(side_by_side(of_view, views, model.backend.workers(model.splats["means"]))) / len(views)
