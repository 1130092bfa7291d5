"""Choose the rule of densification (how a training adds and removes Gaussians) by `train.densify.kind`."""

from gsbench.config import DensifyConfig
from gsbench.errors import InputError, did_you_mean
from gsbench.train.densify.base import Densification, Score
from gsbench.train.densify.gradient import GradientDensification
from gsbench.train.densify.mcmc import MCMCDensification
from gsbench.train.densify.multiview import MultiviewDensification
from gsbench.train.rows import Rows

KINDS: dict[str, type[Densification]] = {
    rule.kind: rule for rule in (GradientDensification, MCMCDensification, MultiviewDensification)
}


def check_kind(kind: str) -> None:
    """Raise InputError if `kind` is not the name of a densification rule."""
    if kind not in KINDS:
        raise InputError(f"train.densify.kind '{kind}' is not known. {did_you_mean(kind, KINDS)}")


def densification(rows: Rows, config: DensifyConfig, min_opacity: float, views: int, score: Score) -> Densification:
    """Make the densification rule that `config.kind` names; see `Densification` for the arguments."""
    check_kind(config.kind)
    return KINDS[config.kind](rows, config, min_opacity, views, score)
