"""Train all candidates of model=auto to 70 % of their steps, and continue with the best on val (effects.compare)."""

import sys
from dataclasses import replace
from typing import Any

from gsbench.config import Config
from gsbench.effects import messages
from gsbench.errors import InputError
from gsbench.measure.record import ModelComparison
from gsbench.run import progress
from gsbench.run.candidates import Candidates, Result, best
from gsbench.run.checks import check_scene, check_values
from gsbench.run.identity import Run, label_of
from gsbench.run.resolve import Resolved, is_auto, with_candidate, with_model
from gsbench.run.setup import build, build_with_placeholders
from gsbench.scenes import Scene
from gsbench.scenes.gaussian_ply import TrainedGaussians
from gsbench.schedule import Schedule
from gsbench.train.hooks.choices import Choices, choices_in
from gsbench.train.loop import Trainer
from gsbench.train.optim import check_rates


def check_compare(config: Config) -> None:
    """Raise InputError if the settings ask to compare models on val and cannot have this."""
    if not config.effects.compare:
        return
    if not is_auto(config):
        raise InputError(f"effects.compare=true: expected model=auto, whose candidates it compares, got "
                         f"model={config.model.name}: leave effects.compare out, or use model=auto",
                         docs="effects.md#comparing-models-on-val")  # fmt: skip
    if config.scene.eval_split == "val":
        raise InputError("effects.compare=true: expected results on test, got scene.eval_split=val: results on the "
                         "views by which the model is chosen would be too high; name a model instead")  # fmt: skip


def check_candidates(config: Config, scene: Scene) -> None:
    """Raise InputError if a scene with times has no val views, or a candidate bad settings or no way to train on it."""
    if not scene.val:
        raise InputError(f"effects.compare=true: expected views of val to compare models on, {scene.name} has none: "
                         f"scene.val_every=8 takes every eighth training view",
                         docs="effects.md#comparing-models-on-val")  # fmt: skip
    for name, settings in candidates(config).items():
        try:
            check_values(settings)
            check_scene(build(settings), scene, settings)
            check_rates(build_with_placeholders(settings, scene.extent).groups(), settings.model)
        except InputError as error:
            raise InputError(f"effects.compare=true, candidate {name}: {error}") from None


def candidates(config: Config) -> dict[str, Config]:
    """Return the settings of each model to compare, by its label; the first is the one that model=auto trains alone.

    Raises:
        InputError: a candidate is no model config, or two of them have one label.
    """
    given = [with_model(config, one, f"model.compared.{key}") for key, one in config.model.compared.items()]
    found: dict[str, Config] = {}
    for one in (with_candidate(config, "moving"), *given, with_candidate(config, "static")):
        one = replace(one, model=replace(one.model, agr=one.agr))  # agr=false makes 7dgs and 7dgs_noagr equal
        name = label_of(one)
        if found.setdefault(name, one) != one:
            raise InputError(f"model.compared: expected models of different names, two are {name!r:.80}")
    return found


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
    parts = Candidates(this, scene, start, candidates(this.config))
    return parts.chosen(_known, lambda: _compared(parts, resolved))


def _known(state: dict[str, Any]) -> str | None:
    comparison = choices_in(state).comparison
    return None if comparison is None else comparison.chosen


def _compared(parts: Candidates, resolved: Resolved) -> Trainer:
    """Train all candidates, print which is the best, and return its trainer with the costs of all."""
    results: list[Result] = []
    for name, config in parts.settings.items():
        until = Schedule(config.train, config.model.sh_degree, config.agr).compares_after
        steps = (len(parts.settings) - 1) * until + config.train.iterations
        results.append(parts.train(name, until, results, steps))
    chosen = best(results)
    comparison = ModelComparison(chosen.steps, chosen.found.name, [one.found for one in results])
    print(f"{parts.this.name}: {messages.of_comparison(comparison)}", file=sys.stderr)
    trainer = parts.trained(chosen, results, resolved)
    trainer.hook(Choices).chosen.comparison = comparison
    return trainer


def reporter(this: Run, trainer: Trainer) -> progress.Reporter:
    """Report the progress of a run's last training; the steps of other candidates count as done."""
    comparison = trainer.hook(Choices).chosen.comparison
    others = len(comparison.candidates) - 1 if comparison else 0
    done = others * trainer.schedule.compares_after
    return progress.Reporter(this.folder, this.overrides, done + trainer.config.train.iterations, done)
