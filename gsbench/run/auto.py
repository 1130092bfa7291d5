"""Choose the model of model=auto for a scene: a model with time or a model without it."""

from dataclasses import replace
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gsbench.config import Config, ModelConfig
from gsbench.effects import choose
from gsbench.errors import InputError
from gsbench.measure.record import TimeScreen
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


def resolve(config: Config, scene: Scene) -> tuple[Config, TimeScreen]:
    """Choose a candidate by the training views of a scene.

    Where the test of time is undecided, time is simulated: 7DGS on a static scene costs seconds, but 6DGS on a moving
    scene loses the motion.

    Raises:
        InputError: as `with_candidate`.
    """
    found = choose.screen(scene, config.seed, config.raster.backend)
    return with_candidate(config, "static" if found.decision == "off" else "moving"), found


def plain_model(config: Config) -> dict[str, Any]:
    """Return the chosen model in plain values, for a checkpoint."""
    plain: dict[str, Any] = OmegaConf.to_container(OmegaConf.structured(config.model), resolve=True)  # type: ignore[assignment]
    return plain
