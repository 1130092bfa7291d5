"""Control the number of Gaussians in a training by the rule `train.densify.kind`, up to a limit."""

import sys
from collections.abc import Sequence

import torch
from torch import Tensor
from tqdm import tqdm

from gsbench.config import Config
from gsbench.scenes import Scene, View
from gsbench.schedule import Schedule
from gsbench.train.batches import generator
from gsbench.train.density.blend_weights import blend_weights, heaviest
from gsbench.train.density.gradient import GradientDensification
from gsbench.train.density.mcmc import MCMCDensification
from gsbench.train.density.multiview import ErrorScore, MultiviewDensification
from gsbench.train.density.relocation import RelocationDensification
from gsbench.train.density.rule import DensificationRule
from gsbench.train.optim import Optimizer
from gsbench.train.renderer import Renderer
from gsbench.train.rows import Rows
from gsbench.train.step import PartResult

# The most Gaussians that a training may have, if `train.densify.max_gaussians` does not say it: one for so many pixels
# of the training views, but at least so many times the initial number. With more, long trainings of small scenes take
# up to five times as long for the same PSNR on val (docs/tuning.md). The images have 2.3 numbers for each of the 84
# parameters of a Gaussian of 7DGS.
PIXELS_PER_GAUSSIAN = 64
LEAST_GROWTH = 4
# The largest model of the 7DGS paper has 1.41 million Gaussians, the largest here 0.55 million. With gradient and
# moments, 2 million Gaussians of 7DGS need 2.7 GB.
MOST_GAUSSIANS = 2_000_000

RULES: dict[str, type[DensificationRule]] = {  # by train.densify.kind
    "gradient": GradientDensification,
    "mcmc": MCMCDensification,
    "multiview": MultiviewDensification,
    "relocation": RelocationDensification,
}


class DensityControl:
    """Call the densification rule of a training when the schedule says so, and thin the Gaussians once after it."""

    def __init__(self, rows: Rows, scene: Scene, config: Config, schedule: Schedule, renderer: Renderer) -> None:
        train = config.train
        score = ErrorScore(rows.model, scene.train, renderer, train.ssim_weight)
        self.rule = RULES[train.densify.kind](rows, train.densify, config.model.min_opacity, len(scene.train), score)
        self.rows = rows
        self.scene = scene
        self.config = config
        self.schedule = schedule
        self.renderer = renderer
        self.limit = gaussian_limit(train.densify.max_gaussians, scene.train, len(rows))
        self._is_full = False  # whether the limit was reached

    def accumulate(self, step: int, views: Sequence[View], results: Sequence[PartResult], skip: Tensor) -> None:
        """Accumulate the gradients of a step, if they count; this can be recorded and repeated in other steps.

        `skip` [] is not 0 if the step is bad.
        """
        if self.accumulates(step):
            for part in results:
                camera = views[part.views[0]].camera  # views of a part have equal sizes
                self.rule.accumulate(part.drawn, part.g_means2d, camera.width, camera.height, len(views), skip)

    def accumulates(self, step: int) -> bool:
        """Return whether the gradients of a step count: while Gaussians are densified."""
        return step < self.schedule.densify_stop

    def before_round(self, views: Sequence[View], results: Sequence[PartResult]) -> None:
        """Prepare the model, before its update, for a round of densification at the end of the step."""
        centers = torch.stack([views[i].camera.center for part in results for i in part.views])
        self.rows.model.before_density(centers, torch.cat([part.drawn for part in results]))

    def acts(self, step: int) -> bool:
        """Return whether `after_update` changes anything at a step."""
        return self.rule.adds_noise or self.schedule.densifies(step) or self.schedule.thins(step)

    def after_update(self, step: int, optimizer: Optimizer) -> None:
        """Add noise, densify, thin and sort the Gaussians as the schedule says."""
        schedule, seed = self.schedule, self.config.seed
        if self.rule.adds_noise:
            rate = optimizer.rates_at(step)["means"]
            self.rule.add_noise(rate, generator(seed, step, 1))  # 1: not the numbers of `densify`
        if schedule.densifies(step):
            most = schedule.most_gaussians(step, self.limit)
            refused = self.rule.densify(generator(seed, step), schedule.has_reset(step), most)
            if refused and schedule.resolution(step) == 1:  # at a lower one, the limit is lower for a while only
                self._report_full(step, refused, most)
        if schedule.thins(step):
            self.thin()
        if schedule.densifies(step) or schedule.thins(step):
            self.rows.sort_by_time()

    def thin(self) -> None:
        """Keep the share `train.densify.thin_to` of the Gaussians: those with the largest sums of blend weights."""
        share = self.config.train.densify.thin_to
        assert share is not None
        self.rows.select(heaviest(blend_weights(self.rows.model, self.scene.train, self.renderer.antialias), share))

    def _report_full(self, step: int, refused: int, most: int) -> None:
        """Print once that the largest number of Gaussians is reached; `refused` Gaussians were not added."""
        if not self._is_full:
            self._is_full = True
            which = "default of " if self.config.train.densify.max_gaussians is None else ""
            tqdm.write(
                f"step {step + 1}: {most} Gaussians are the most ({which}train.densify.max_gaussians): "
                f"{refused} of smaller gradients are not cloned or split",
                file=sys.stderr,
            )


def gaussian_limit(
    limit: int | None,  # train.densify.max_gaussians
    views: Sequence[View],  # of the training
    initial: int,  # number of Gaussians at the start
) -> int:
    """Return the largest number of Gaussians at full resolution: `limit`, or one that follows from the pixels."""
    if limit is not None:
        return limit
    pixels = sum(view.camera.width * view.camera.height for view in views)
    return min(max(pixels // PIXELS_PER_GAUSSIAN, LEAST_GROWTH * initial), MOST_GAUSSIANS)
