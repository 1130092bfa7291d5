"""Choose the rule of densification (how a training adds and removes Gaussians) by `train.densify.kind`."""

from collections.abc import Sequence

from gsbench.config import DensifyConfig
from gsbench.errors import InputError, did_you_mean
from gsbench.scenes import View
from gsbench.train.densify.base import Densification, Score
from gsbench.train.densify.gradient import GradientDensification
from gsbench.train.densify.mcmc import MCMCDensification
from gsbench.train.densify.multiview import MultiviewDensification
from gsbench.train.rows import Rows

# The most Gaussians that a training may have, if `train.densify.max_gaussians` does not say it: one for so many pixels
# of the training views, but at least so many times the initial number. With more, long trainings of small scenes take
# up to five times as long for the same PSNR on val (docs/tuning.md). The images have 2.3 numbers for each of the 84
# parameters of a Gaussian of 7DGS.
PIXELS_PER_GAUSSIAN = 64
LEAST_GROWTH = 4
# The largest model of the 7DGS paper has 1.41 million Gaussians, the largest here 0.55 million. With gradient and
# moments, 2 million Gaussians of 7DGS need 2.7 GB.
MOST_GAUSSIANS = 2_000_000

KINDS: dict[str, type[Densification]] = {
    rule.kind: rule for rule in (GradientDensification, MCMCDensification, MultiviewDensification)
}


def check_kind(kind: str) -> None:
    """Raise InputError if `kind` is not the name of a densification rule."""
    if kind not in KINDS:
        raise InputError(f"train.densify.kind '{kind}' is not known. {did_you_mean(kind, KINDS)}")


def gaussian_limit(config: DensifyConfig, views: Sequence[View], initial: int) -> int:
    """Return the largest number of Gaussians that a training may have at full resolution.

    Args:
        config: its `max_gaussians` is the answer, if it is not None.
        views: the training views.
        initial: the number of Gaussians at the start.
    """
    if config.max_gaussians is not None:
        return config.max_gaussians
    pixels = sum(view.camera.width * view.camera.height for view in views)
    return min(max(pixels // PIXELS_PER_GAUSSIAN, LEAST_GROWTH * initial), MOST_GAUSSIANS)


def densification(rows: Rows, config: DensifyConfig, min_opacity: float, views: int, score: Score) -> Densification:
    """Make the densification rule that `config.kind` names; see `Densification` for the arguments."""
    check_kind(config.kind)
    return KINDS[config.kind](rows, config, min_opacity, views, score)
