"""Render views of a model with the background and antialiasing of its run, and measure PSNR."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gsbench.measure.quality import capped_psnr
from gsbench.models import GaussianModel
from gsbench.models.render import render
from gsbench.process.workers import side_by_side
from gsbench.scenes import View


@dataclass(frozen=True)
class Renderer:
    """Hold the rendering settings of a run: the background colour and antialiasing."""

    background: Tensor  # [3]
    antialias: bool  # see `gsbench.raster.rasterize`

    @torch.no_grad()
    def image(self, model: GaussianModel, view: View) -> Tensor:
        """Render the image [H, W, 3] of a model for the camera and the time of a view."""
        return render(model, view.camera, view.time, self.background, self.antialias)

    def psnr(self, model: GaussianModel, views: Sequence[View]) -> float:
        """Return the mean of `psnr_of_views`, dB."""
        return sum(self.psnr_of_views(model, views)) / len(views)

    @torch.no_grad()
    def psnr_of_views(self, model: GaussianModel, views: Sequence[View]) -> list[float]:
        """Return the PSNR of a model in each view in dB, capped (gsbench.measure.exact_views).

        On a CPU several views are rendered in parallel.
        """

        def of_view(view: View) -> float:
            return capped_psnr(self.image(model, view), view.image)

        return list(side_by_side(of_view, views, model.backend.workers(model.splats["means"])))
