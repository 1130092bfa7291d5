"""Choose the model of model=auto: by a test whether the scene changes with time, and by PSNR on val on request.

The test decides between a candidate with time ("moving") and one without ("static"). With effects.compare=true, and
if the scene may move, all candidates are trained to 70 % of their steps, and the best on val is trained to the end.
"""

import sys
from dataclasses import dataclass, field, replace
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gsbench.config import Config, ModelConfig
from gsbench.errors import InputError
from gsbench.gates import messages
from gsbench.gates.screen import import_compiler, screen_time
from gsbench.measure.record import ModelComparison, TimeScreen
from gsbench.measure.speed import Effort
from gsbench.run import progress
from gsbench.run.candidates import Candidates, Result, best
from gsbench.run.checks import check_scene, check_values
from gsbench.run.identity import Run, label_of
from gsbench.run.setup import build, build_with_placeholders
from gsbench.scenes import Scene
from gsbench.scenes.gaussian_ply import TrainedGaussians
from gsbench.schedule import Schedule
from gsbench.train.hooks.choices import Choices, choices_in
from gsbench.train.loop import Trainer
from gsbench.train.optim import check_rates

AUTO = "auto"
HOW_TO = "effects.md#comparing-models-on-val"


def is_auto(config: Config) -> bool:
    """Return whether the settings have model=auto, so that a test of the scene must still choose the model."""
    return config.model.name == AUTO


def with_candidate(config: Config, name: str) -> Config:
    """Return the settings of model=auto with its candidate "moving" or "static" as the model."""
    return _with_model(config, config.model.candidates.get(name), f"model.candidates.{name}")


def candidates(config: Config) -> dict[str, Config]:
    """Return the settings of each model to compare, by its label; the first is the one that model=auto trains alone.

    Raises:
        InputError: a candidate is no model config, or two of them have one label.
    """
    more = [_with_model(config, model, f"model.compared.{key}") for key, model in config.model.compared.items()]
    by_label: dict[str, Config] = {}
    for each in (with_candidate(config, "moving"), *more, with_candidate(config, "static")):
        candidate = replace(each, model=replace(each.model, agr=each.agr))  # agr=false: 7dgs is 7dgs_noagr
        label = label_of(candidate)
        if by_label.setdefault(label, candidate) != candidate:
            raise InputError(f"model.compared: expected models of different names, two are {label!r:.80}")
    return by_label


def _with_model(config: Config, model: Any, key: str) -> Config:
    """Return settings with another model, from the config key `key`, with AGR only if the model's settings have it.

    Raises:
        InputError: `model` is not a model config.
    """
    try:
        typed = OmegaConf.merge(OmegaConf.structured(ModelConfig), model or {})
        chosen: ModelConfig = OmegaConf.to_object(typed)  # type: ignore[assignment]
    except (OmegaConfBaseException, ValueError, TypeError) as error:
        raise InputError(f"{key}: {str(error).splitlines()[0]}") from None
    return replace(config, model=replace(chosen, gate=config.model.gate), agr=config.agr and chosen.agr)


def check_compare(config: Config) -> None:
    """Raise InputError if the settings ask to compare models on val and cannot have this."""
    if not config.effects.compare:
        return
    if not is_auto(config):
        raise InputError(f"effects.compare=true: expected model=auto, whose candidates it compares, got "
                         f"model={config.model.name}: leave effects.compare out, or use model=auto",
                         docs=HOW_TO)  # fmt: skip
    if config.scene.eval_split == "val":
        raise InputError("effects.compare=true: expected results on test, got scene.eval_split=val: results on the "
                         "views by which the model is chosen would be too high; name a model instead")  # fmt: skip


def check_candidates(config: Config, scene: Scene) -> None:
    """Raise InputError if a scene with times has no val views, or a candidate bad settings or no way to train on it."""
    if not scene.val:
        raise InputError(f"effects.compare=true: expected views of val to compare models on, {scene.name} has none: "
                         f"scene.val_every=8 takes every eighth training view", docs=HOW_TO)  # fmt: skip
    for name, settings in candidates(config).items():
        try:
            check_values(settings)
            check_scene(build(settings), scene, settings)
            check_rates(build_with_placeholders(settings, scene.extent).groups(), settings.model)
        except InputError as error:
            raise InputError(f"effects.compare=true, candidate {name}: {error}") from None


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
        screen = screen_time(scene, this.config.seed, this.config.raster.backend)
        config = with_candidate(this.config, "static" if screen.decision == "off" else "moving")
    resolved = Resolved(config, screen, effort)
    model = f"{config.model.name}{' with AGR' if config.agr else ''}"
    print(f"{this.name}: time is {screen.decision}: {screen.reason}; "
          f"{'models are compared on val' if resolved.compares else model}", file=sys.stderr)  # fmt: skip
    return resolved


def best_of(this: Run, scene: Scene, start: TrainedGaussians | None, resolved: Resolved) -> Trainer:
    """Return the trainer of the candidate with the highest PSNR on val, from which the run continues.

    The candidates are trained one after another, each with the settings and the seed of the run, so that the result is
    bit-equal to a run of the chosen model alone. A checkpoint of each is kept until the choice is saved in the run's
    own checkpoint. The seconds of the time screen and of the other candidates count as training.

    Args:
        this: the run with model=auto.
        scene: the scene, which has val views.
        start: trained Gaussians to start from; None to start from points.
        resolved: the time screen and its CPU time.

    Raises:
        InputError: a checkpoint is damaged.
        DivergedError, NoGaussianError: all candidates failed; the error is that of the first.
        Stopped: a signal asked the process to end; the checkpoint of the present candidate is saved.
    """

    def chosen_in(state: dict[str, Any]) -> str | None:
        comparison = choices_in(state).comparison
        return None if comparison is None else comparison.chosen

    parts = Candidates(this, scene, start, candidates(this.config))
    return parts.chosen(chosen_in, lambda: _compared(parts, resolved))


def _compared(parts: Candidates, resolved: Resolved) -> Trainer:
    """Train all candidates, print which is the best, and return its trainer with the costs of all."""
    results: list[Result] = []
    for name, config in parts.settings.items():
        until = Schedule(config.train, config.model.sh_degree, config.agr).compares_after
        steps = (len(parts.settings) - 1) * until + config.train.iterations
        results.append(parts.train(name, until, results, steps))
    chosen = best(results)
    comparison = ModelComparison(chosen.steps, chosen.candidate.name, [result.candidate for result in results])
    print(f"{parts.this.name}: {messages.of_comparison(comparison)}", file=sys.stderr)
    trainer = parts.trained(chosen, results, resolved.screen, resolved.effort)
    trainer.hook(Choices).chosen.comparison = comparison
    return trainer


def reporter(this: Run, trainer: Trainer) -> progress.Reporter:
    """Report the progress of a run's last training; the steps of other candidates count as done."""
    comparison = trainer.hook(Choices).chosen.comparison
    others = len(comparison.candidates) - 1 if comparison else 0
    done = others * trainer.schedule.compares_after
    return progress.Reporter(this.folder, this.overrides, done + trainer.config.train.iterations, done)
