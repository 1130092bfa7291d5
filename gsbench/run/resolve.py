"""Replace model=auto by a model with time or a model without, after a test whether the scene changes with time."""

import sys
from dataclasses import dataclass, field, replace
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gsbench.config import Config, ModelConfig
from gsbench.effects import choose
from gsbench.effects.choose import import_compiler
from gsbench.errors import InputError
from gsbench.measure.record import TimeScreen
from gsbench.measure.speed import Effort
from gsbench.run.identity import Run
from gsbench.scenes import Scene
from gsbench.train.hooks.choices import lengths_of

AUTO = "auto"
CANDIDATES = ("moving", "static")  # in conf/model/auto.yaml


def is_auto(config: Config) -> bool:
    """Return whether the settings have model=auto, so that a test of the scene must still choose the model."""
    return config.model.name == AUTO


def with_candidate(config: Config, name: str) -> Config:
    """Return settings with one candidate of model=auto ("moving" or "static") as the model.

    Raises:
        InputError: the settings lack the candidate, or the candidate is not a model config.
    """
    return with_model(config, config.model.candidates.get(name), f"model.candidates.{name}")


def with_model(config: Config, chosen: Any, key: str) -> Config:
    """Return the settings of model=auto with another model, which has AGR only if its own settings ask for it.

    Args:
        config: the settings with model=auto.
        chosen: the settings of the model, from `key`.
        key: the config key, for messages.

    Raises:
        InputError: `chosen` is not a model config.
    """
    try:
        typed = OmegaConf.merge(OmegaConf.structured(ModelConfig), chosen or {})
        model: ModelConfig = OmegaConf.to_object(typed)  # type: ignore[assignment]
    except (OmegaConfBaseException, ValueError, TypeError) as error:
        raise InputError(f"{key}: {str(error).splitlines()[0]}") from None
    return replace(config, model=replace(model, gate=config.model.gate), agr=config.agr and model.agr)


@dataclass(frozen=True)
class Resolved:
    """The settings of a training after model=auto was replaced by a model, and the test that chose it."""

    config: Config
    screen: TimeScreen | None = None  # the test that chose the model, for model=auto
    effort: Effort = field(default_factory=Effort)  # CPU time of this test

    @property
    def compares(self) -> bool:
        """Return whether a comparison on val must still choose the model: `effects.compare`, if the scene may move."""
        return self.config.effects.compare and self.screen is not None and self.screen.decision != "off"


def before_scene(config: Config) -> Config:
    """Return settings to check before the scene is loaded: model=auto is replaced by its candidate with time."""
    return with_candidate(config, "moving") if is_auto(config) else config


def resolve(this: Run, scene: Scene) -> Resolved:
    """Replace model=auto by a model with or without time, after a test whether the training views change with time.

    The reason is printed. If the test is undecided, the model has time: training 7DGS on a static scene costs a few
    seconds, but 6DGS on a moving scene loses the motion. Other settings are returned unchanged.

    Raises:
        InputError: the settings lack a candidate of model=auto.
    """
    if not is_auto(this.config):
        return Resolved(this.config)
    import_compiler()
    effort = Effort()
    with effort:
        screen = choose.screen(scene, this.config.seed, this.config.raster.backend)
        config = with_candidate(this.config, "static" if screen.decision == "off" else "moving")
    found = Resolved(config, screen, effort)
    model = f"{config.model.name}{' with AGR' if config.agr else ''}"
    print(f"{this.name}: time is {screen.decision}: {screen.reason}; "
          f"{'models are compared on val' if found.compares else model}", file=sys.stderr)  # fmt: skip
    return found


def plain(this: Run, config: Config) -> dict[str, Any]:
    """Return the settings of a training of a run as plain values.

    Args:
        this: the run, which may have model=auto or `train.lengths`.
        config: the run's settings with the model and the length of this training.

    The checkpoint of a run has those of the training that is kept, so that its schedule is that of its length.
    """
    length = {"iterations": config.train.iterations, "lengths": lengths_of(config)}
    found = this.plain | {"train": this.plain["train"] | length}
    if not is_auto(this.config):
        return found
    model = OmegaConf.to_container(OmegaConf.structured(config.model), resolve=True)
    return found | {"model": model, "agr": config.agr}
