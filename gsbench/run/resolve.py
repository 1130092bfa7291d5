"""Resolve the config of a training: model=auto becomes a model that depends on time, or one that does not."""

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

AUTO = "auto"
CANDIDATES = ("moving", "static")  # in conf/model/auto.yaml


def is_auto(config: Config) -> bool:
    """Tell whether the model is still to be chosen."""
    return config.model.name == AUTO


def with_candidate(config: Config, name: str) -> Config:
    """Return the config with one of the candidates of model=auto as its model.

    AGR moves Gaussians with time, so the static candidate has none.

    Raises:
        InputError: the config lacks the candidate, or the candidate is no model config.
    """
    chosen = config.model.candidates.get(name)
    try:
        typed = OmegaConf.merge(OmegaConf.structured(ModelConfig), chosen or {})
        model: ModelConfig = OmegaConf.to_object(typed)  # type: ignore[assignment]
    except (OmegaConfBaseException, ValueError, TypeError) as error:
        raise InputError(f"model.candidates.{name}: {str(error).splitlines()[0]}") from None
    return replace(config, model=replace(model, gate=config.model.gate), agr=config.agr and name == "moving")


@dataclass(frozen=True)
class Resolved:
    """The config of a training, after model=auto was replaced by the chosen model, and how it was chosen."""

    config: Config
    screen: TimeScreen | None = None  # what chose the model of model=auto
    effort: Effort = field(default_factory=Effort)  # of the screen


def before_scene(config: Config) -> Config:
    """Return a config to check before the scene is loaded: for model=auto the candidate that depends on time."""
    return with_candidate(config, "moving") if is_auto(config) else config


def resolve(this: Run, scene: Scene) -> Resolved:
    """Choose the model of model=auto by the training views of a scene, and print the reason; other configs stay.

    If the test whether the scene changes is undecided, the model depends on time: 7DGS on a static scene costs seconds,
    but 6DGS on a moving scene loses the motion.

    Raises:
        InputError: as `with_candidate`.
    """
    if not is_auto(this.config):
        return Resolved(this.config)
    import_compiler()
    effort = Effort()
    with effort:
        screen = choose.screen(scene, this.config.seed, this.config.raster.backend)
        config = with_candidate(this.config, "static" if screen.decision == "off" else "moving")
    print(f"{this.name}: time is {screen.decision}: {screen.reason}; {config.model.name}"
          f"{' with AGR' if config.agr else ''}", file=sys.stderr)  # fmt: skip
    return Resolved(config, screen, effort)


def plain(this: Run, config: Config) -> dict[str, Any]:
    """Return the training's config in plain values; for model=auto it holds the chosen model."""
    if not is_auto(this.config):
        return this.plain
    model = OmegaConf.to_container(OmegaConf.structured(config.model), resolve=True)
    return this.plain | {"model": model, "agr": config.agr}
