"""Score Gaussians by their blend weights on the pixels of training views that have large errors, as FastGS does."""

from collections.abc import Sequence

import torch
from torch import Tensor

from gsbench.models import GaussianModel
from gsbench.process.workers import side_by_side
from gsbench.scenes import View
from gsbench.train.densify.base import Scores
from gsbench.train.losses import photometric
from gsbench.train.renderer import Renderer
from gsbench.train.thinning import WeighedImage

VIEWS = 10  # training views from which Gaussians are scored, or all if there are fewer
FLAGGED_FROM = 0.1  # a pixel is flagged if its error is above this share of the range of errors in its image


class ErrorScore:
    """Score all Gaussians of a model from a few training views.

    In each view v the pixels with large errors are flagged (`flagged`), and c_v(i) is the sum of the blend weights of
    Gaussian i over them. The importance of Gaussian i is the mean of c_v(i) over the views, and its badness is the sum
    of loss_v c_v(i), with the photometric loss of the view, scaled to [0, 1].
    """

    def __init__(self, model: GaussianModel, views: Sequence[View], renderer: Renderer, ssim_weight: float) -> None:
        """Store the model and the views.

        Args:
            model: the model whose Gaussians are scored.
            views: the training views at full resolution.
            renderer: renders views with the settings of the training.
            ssim_weight: the weight w of 1 - SSIM in the loss.
        """
        self.model = model
        self.views = views
        self.renderer = renderer
        self.ssim_weight = ssim_weight

    @torch.no_grad()
    def __call__(self, generator: torch.Generator) -> Scores:
        """Draw VIEWS different views and score the Gaussians from them; threads render several views in parallel."""
        chosen = torch.randperm(len(self.views), generator=generator)[:VIEWS].tolist()
        workers = self.model.backend.workers(self.model.splats["means"])
        importance = torch.zeros_like(self.model.splats["opacities"].detach())
        badness = torch.zeros_like(importance)
        for weights, loss in side_by_side(self._see, [self.views[i] for i in chosen], workers):
            importance += weights
            badness += loss * weights
        return Scores(importance / len(chosen), to_unit_range(badness))

    def _see(self, view: View) -> tuple[Tensor, Tensor]:
        """Return the summed blend weight of each Gaussian on the flagged pixels of a view, [N], and the view's loss."""
        rendered = WeighedImage(self.model, view, self.renderer.background, self.renderer.antialias)
        image, target = rendered.image, view.image
        weights = rendered.weights(flagged(image, target).to(image.dtype))
        return weights, photometric(image[None], target[None], self.ssim_weight, self.model.backend)


def flagged(image: Tensor, target: Tensor) -> Tensor:
    """Return which pixels of an image [H, W, 3] have large errors, [H, W] bool."""
    return to_unit_range((image - target).abs().mean(-1)) > FLAGGED_FROM


def to_unit_range(values: Tensor) -> Tensor:
    """Scale values linearly such that the smallest is 0 and the largest 1; equal values become 0."""
    if not values.numel():  # all Gaussians were pruned
        return values
    least, most = values.aminmax()
    return (values - least) / (most - least).clamp(min=torch.finfo(values.dtype).tiny)
