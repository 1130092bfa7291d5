"""Define training hooks: options that act at fixed points of a training step, such as early stopping and penalties.

A module of this folder holds an option whole: its checks, its state in a checkpoint and its part of the record. The
trainer calls all hooks at each point, in the order of the names of their modules, and knows none of them by name. Keys
are read without torch (gsbench/config.py), so a module imports torch, and what needs it, in functions or for types.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable, Iterator, Sequence
from operator import attrgetter
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, TypeVar

from gsbench.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor, nn

    from gsbench.config import Config, LearningRate
    from gsbench.measure.curve import Curve
    from gsbench.measure.speed import Effort, StageClock
    from gsbench.models import CameraTime, GaussianModel
    from gsbench.scenes import Scene, View
    from gsbench.schedule import Schedule
    from gsbench.train.renderer import Renderer
    from gsbench.train.rows import Rows

# A weight, and the term [] of a view of the batch by its index.
LossTerm = tuple[float, "Callable[[CameraTime, int], Tensor]"]
# What the loss sees of the render [1, H, W, 3] of a view of the batch by its index.
ImageMap = Callable[["Tensor", int], "Tensor"]
TrainedGroup = tuple["list[nn.Parameter]", "LearningRate"]
H = TypeVar("H", bound="Hook")
ELSEWHERE = ("gsbench.gates.long_lived", "gsbench.gates.hook")  # hooks outside of this folder, which act last


class Training(Protocol):
    """What a hook may use of its training: gsbench.train.loop.Trainer."""

    model: GaussianModel
    scene: Scene
    views: list[View]  # on which results are measured
    config: Config
    schedule: Schedule
    renderer: Renderer
    rows: Rows  # changes Gaussians together with all state that belongs to them
    stages: StageClock
    effort: Effort
    curve: Curve
    step: int  # the present step, counted from 0; between steps the number of finished steps

    @property
    def loss(self) -> float:
        """Return the loss of the last step; on a GPU of one at most 50 steps before."""

    def hook(self, kind: type[H]) -> H:
        """Return another hook, by its class."""

    def report(self, text: str) -> None:
        """Print a line above the progress bar."""

    def psnr(self, views: list[View]) -> float:
        """Return the mean PSNR of the model over views, dB."""

    def state_of_gaussians(self) -> dict[str, Any]:
        """Return the part of the state that is restored with the Gaussians of an earlier iteration: no measurements."""

    def state_dict(self) -> dict[str, Any]:
        """Return the whole state of the training."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a `state_dict`; raise InputError if it is not one of this training."""


class Hook:
    """The base class of training hooks, whose methods do nothing."""

    name: ClassVar[str]  # its key in a checkpoint
    measures: ClassVar[bool] = False  # whether its state stays when Gaussians of an earlier iteration are restored

    def __init_subclass__(cls) -> None:
        """Raise InputError if a hook has no name of its own."""
        if "name" not in vars(cls):
            raise InputError(f"{cls.__module__}.{cls.__qualname__}: expected the hook's `name`, got none")

    def __init__(self, training: Training) -> None:
        """Start at step 0 of a training, whose model has its initial Gaussians."""
        self.training = training

    @classmethod
    def check(cls, config: Config) -> None:
        """Raise InputError if a setting is invalid, before torch is imported: only hooks of this folder are asked."""

    @classmethod
    def check_model(cls, model: GaussianModel, config: Config) -> None:
        """Raise InputError if the settings ask for what the model, which has no Gaussians yet, cannot do."""

    @classmethod
    def check_scene(cls, scene: Scene, config: Config) -> None:
        """Raise InputError if the settings ask for what the scene cannot give."""

    def loss_terms(self, step: int, views: Sequence[View]) -> Sequence[LossTerm]:
        """Return terms that are added to the loss of each view of a step; threads call them at the same time.

        On a GPU, a step with terms or image maps renders its views one by one, which takes more launches.
        """
        return ()

    def groups(self) -> dict[str, TrainedGroup]:
        """Return what the hook trains beside the model: parameters and their learning rate by the name of the group."""
        return {}

    def image_maps(self, step: int, views: Sequence[View]) -> Sequence[ImageMap]:
        """Return what is done to each render of a step before the loss; threads call the maps at the same time."""
        return ()

    def rate_factors(self, step: int) -> dict[str, float]:
        """Return factors of the learning rates of a step, by parameter group."""
        return {}

    def acts(self, step: int) -> bool:
        """Return whether an `after_` method changes anything at a step, except what a second call would not change.

        The training then waits for a GPU first, because it goes back if the step was bad. By default this is true for
        each step if there is such a method.
        """
        methods = ("after_update", "after_density", "after_step")
        return any(getattr(type(self), name) is not getattr(Hook, name) for name in methods)

    def after_update(self, step: int) -> None:
        """Act after the optimizer has updated the parameters; gradients are off here and in all that follows."""

    def after_density(self, step: int) -> None:
        """Act after density control has added and removed Gaussians."""

    def after_step(self, step: int) -> None:
        """Act at the end of a step."""

    def after_measuring(self, finished: int, psnr: float) -> float:
        """Act after PSNR on val was measured, and return it; a hook that changes the model returns the new PSNR.

        Args:
            finished: the number of finished steps.
            psnr: PSNR on val, dB; NaN if the scene has no val.
        """
        return psnr

    def stops(self, finished: int) -> bool:
        """Return whether the training ends after so many steps, the last of which was measured."""
        return False

    def at_end(self) -> None:
        """Act after the last step, before the final checkpoint."""

    def reindex(self, rows: Tensor, fresh: Tensor) -> None:
        """Reorder per-Gaussian state after Gaussians were added, removed or sorted.

        Args:
            rows: for each Gaussian after the change, its index before the change, or that of its parent, [M].
            fresh: which Gaussians are new, [M] bool.
        """

    def state_dict(self) -> dict[str, Any]:
        """Return the state for a checkpoint: containers, numbers, text and tensors."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a `state_dict`; raise InputError if it is not valid, since a checkpoint is untrusted input."""

    def results(self) -> dict[str, Any]:
        """Return what the hook adds to the record of the run: fields of `Record`, others join `Record.parts`."""
        return {}


def check_step(key: str, step: int | None, config: Config) -> None:
    """Raise InputError if a step of the recipe is not before its end; None: the key is not set."""
    if step is not None and step >= config.train.recipe_iterations:
        raise InputError(
            f"{key}: expected a step below train.recipe_iterations={config.train.recipe_iterations}, the length for "
            f"which steps are given, got {step}"
        )


def check_excludes(key: str, config: Config, excluded: dict[str, str]) -> None:
    """Raise InputError if another key is set too; `excluded` maps the keys that `key` excludes to reasons."""
    for other, reason in excluded.items():
        value = attrgetter(other)(config)
        if value is not None and value is not False:
            unset = "false" if value is True else "null"
            raise InputError(
                f"{key}: expected {other}={unset}, {reason}, got {str(value).lower()}: leave one of the two out"
            )


def check_choice_on_val(key: str, what: str, scene: Scene, config: Config) -> None:
    """Raise InputError if a `what`, such as an iteration, cannot be chosen on val as `train.key` asks."""
    if not scene.val:
        raise InputError(
            f"train.{key}: expected views of val to choose the {what}, {scene.name} has none: "
            f"scene.val_every=8 takes every eighth training view"
        )
    if config.scene.eval_split == "val":
        raise InputError(
            f"train.{key}: expected results on test, got scene.eval_split=val: results on the views "
            f"by which the {what} is chosen would be too high; leave train.{key} out"
        )


def hook_types(elsewhere: Sequence[str] = ELSEWHERE) -> list[type[Hook]]:
    """Return the classes of all hooks, in the order in which they act; those of this folder if `elsewhere` is ()."""
    names = sorted(f"{__name__}.{module.name}" for module in pkgutil.iter_modules(__path__))
    return [hook for name in (*names, *elsewhere) for hook in _hooks_in(name)]


def _hooks_in(module: str) -> Iterator[type[Hook]]:
    for value in vars(importlib.import_module(module)).values():
        if isinstance(value, type) and issubclass(value, Hook) and value.__module__ == module:
            yield value
