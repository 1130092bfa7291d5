"""Densify only Gaussians on pixels with large errors in several views, and prune by chance, as FastGS does.

Ren et al., "FastGS: Training 3D Gaussian Splatting in 100 Seconds", arXiv 2511.04283.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from gsbench.models import GaussianModel
from gsbench.process.workers import side_by_side
from gsbench.scenes import View
from gsbench.train.density.blend_weights import WeighedImage
from gsbench.train.density.gradient import GradientDensification
from gsbench.train.density.rule import Scores
from gsbench.train.losses import photometric
from gsbench.train.renderer import Renderer

VIEWS = 10  # training views from which Gaussians are scored, or all if there are fewer
FLAGGED_FROM = 0.1  # a pixel is flagged if its error is above this share of the range of errors in its image
# Pixels of blend weight in a view; FastGS counts pixels and takes 5. Chosen on val for images of 80 x 80: with 0.02,
# 0.1 and 0.5, 7DGS on suzanne has the same PSNR within 0.12 dB, and 4983, 4191 and 2149 Gaussians.
LEAST_IMPORTANCE = 0.5
PRUNED_SHARE = 0.5  # number of Gaussians that are drawn for pruning, as a share of the candidates
MOST_OPACITY = 0.8  # to which opacities are lowered after a round


class MultiviewDensification(GradientDensification):
    """The density control of 3DGS, restricted by scores from several training views (FastGS).

    It differs from `GradientDensification` in three ways:

    - A Gaussian is cloned or split only if its importance (`ErrorScore`) is also above LEAST_IMPORTANCE.
    - Gaussians that are too transparent or too large are only candidates for pruning. Half as many Gaussians as there
      are candidates are drawn from all Gaussians without replacement, with weights 1 / (1e-6 + 1 - badness), and the
      candidates among them are pruned. A new Gaussian has the badness of its parent.
    - After each round, opacities above MOST_OPACITY are lowered to it.
    """

    @torch.no_grad()
    def densify(self, generator: torch.Generator, has_reset: bool, most: int) -> int:
        """Clone and split Gaussians of large gradient and importance, then prune and lower opacities.

        A faint or large Gaussian is pruned only if a random draw picks it, which is likelier the larger its badness.
        """
        assert self.score is not None, "expected the score of views, which the trainer gives"
        importance, badness = self.score(generator)
        parents, refused = self._add(generator, most, importance > LEAST_IMPORTANCE)
        candidates = self._faint_or_large(has_reset)
        weights = 1 / (1e-6 + 1 - badness[parents].double())
        is_drawn = torch.zeros_like(candidates)
        is_drawn[drawn_once(weights, int(PRUNED_SHARE * int(candidates.sum())), generator)] = True
        self.rows.select((~(self._unseen() | candidates & is_drawn)).nonzero()[:, 0])
        self.model.reset_opacities(MOST_OPACITY)
        return refused


def drawn_once(weights: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Draw the indices of `count` Gaussians without replacement, with probabilities proportional to `weights` [N].

    The method is that of Efraimidis and Spirakis: the `count` smallest of N exponential random numbers with the rates
    `weights`. They are computed in float64 on the CPU, so that the same seed draws the same rows everywhere.
    """
    uniform = torch.rand(len(weights), generator=generator, dtype=torch.float64)
    return (-uniform.log() / weights.double().cpu()).argsort(stable=True)[:count].to(weights.device)


class ErrorScore:
    """Score all Gaussians of a model from a few training views.

    In each view v the pixels with large errors are flagged (`flagged`), and c_v(i) is the sum of the blend weights of
    Gaussian i over them. The importance of Gaussian i is the mean of c_v(i) over the views, and its badness is the sum
    of loss_v c_v(i), with the photometric loss of the view, scaled to [0, 1].
    """

    def __init__(self, model: GaussianModel, views: Sequence[View], renderer: Renderer, ssim_weight: float) -> None:
        """Store the training views at full resolution, and the weight w of 1 - SSIM in the loss."""
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
        for weights, loss in side_by_side(self._of_view, [self.views[i] for i in chosen], workers):
            importance += weights
            badness += loss * weights
        return Scores(importance / len(chosen), to_unit_range(badness))

    def _of_view(self, view: View) -> tuple[Tensor, Tensor]:
        """Return the summed blend weight of each Gaussian on the flagged pixels of a view, [N], and the view's loss."""
        rendered = WeighedImage(self.model, view, self.renderer.background, self.renderer.antialias)
        image, target = rendered.image, view.image
        weights = rendered.weights(flagged(image, target).to(image.dtype))
        return weights, photometric(image, target, self.ssim_weight, self.model.backend)


def flagged(image: Tensor, target: Tensor) -> Tensor:
    """Return which pixels of an image [H, W, 3] have large errors, [H, W] bool."""
    return to_unit_range((image - target).abs().mean(-1)) > FLAGGED_FROM


def to_unit_range(values: Tensor) -> Tensor:
    """Scale values linearly such that the smallest is 0 and the largest 1; equal values become 0."""
    if not values.numel():  # all Gaussians were pruned
        return values
    least, most = values.aminmax()
    return (values - least) / (most - least).clamp(min=torch.finfo(values.dtype).tiny)
