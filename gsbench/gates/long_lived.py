"""Make the Gaussians static that live long, as in 3D-4DGS: a rule that predicts no error, to compare with the gates.

Oh et al., "Hybrid 3D-4D Gaussian Splatting for Fast Dynamic Scene Representation", arXiv 2505.13215. There, Gaussians
become static after each round of densification, and keep their means. Here, they become static as by a gate: once,
after densification, at means over views.
"""

import torch

from gsbench.config import Config
from gsbench.errors import InputError
from gsbench.gates.gate import ChosenSimplifications, apply, effect_sets_of
from gsbench.gates.hook import VIEWS_IN_TRAINING
from gsbench.measure.quality import evenly
from gsbench.models import CameraTime, GaussianModel
from gsbench.models.gated import as_gated
from gsbench.models.simplifications import LIVE, REMOVED, STATIC, simplifications_of
from gsbench.train.hooks import Hook, Training


class LongLived(Hook):
    """Make Gaussians static whose lifetime is above `effects.static_above`, for the rest of the training."""

    name = "long_lived"

    def __init__(self, training: Training) -> None:
        """Raise InputError if the Gaussians have no lifetimes."""
        super().__init__(training)
        self.longest = training.config.effects.static_above
        if self.longest is not None and training.model.lifetimes() is None:
            raise InputError(
                f"effects.static_above: expected Gaussians with lifetimes, those of {training.config.model.name} have "
                f"none: use 4dgs or 7dgs"
            )

    @classmethod
    def check_model(cls, model: GaussianModel, config: Config) -> None:
        """Raise InputError if Gaussians of the model cannot become static."""
        if config.effects.static_above is not None:
            as_gated(model)

    def acts(self, step: int) -> bool:
        """Return whether Gaussians become static after a step, see `Hook.acts`."""
        return self.longest is not None and self.training.schedule.gates(step)

    def after_density(self, step: int) -> None:
        """Make the Gaussians static whose lifetime, a standard deviation in clips, is long; once, when gates act."""
        if self.longest is None or not self.acts(step):
            return
        with self.training.stages("gate"):
            model = as_gated(self.training.model)
            times_and_lifetimes = model.lifetimes()
            assert times_and_lifetimes is not None
            is_long = times_and_lifetimes[1] > self.longest  # [N]
            views = evenly(self.training.scene.train, VIEWS_IN_TRAINING)
            queries = [CameraTime.of(view.camera, view.time) for view in views]
            ways = simplifications_of(model, queries, [model.slice(query) for query in queries])
            chosen = {LIVE: ~is_long, STATIC: is_long, REMOVED: torch.zeros_like(is_long)}
            orders = effect_sets_of(model).orders
            assert orders is not None
            choice = ChosenSimplifications(chosen, orders, predicted=0.0)
            self.training.rows.moved(*apply(model, [way for way in ways if way.name == STATIC], choice))
