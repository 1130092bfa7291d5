"""Train all candidates of model=auto to 70 % of their steps, and continue with the best on val (effects.compare)."""

import math
import shutil
import sys
from dataclasses import dataclass, replace

from gsbench.config import Config
from gsbench.effects import messages
from gsbench.errors import InputError, one_line
from gsbench.measure.record import Candidate, ModelComparison
from gsbench.measure.speed import Effort
from gsbench.run import fitting, progress
from gsbench.run.checks import check_scene, check_values
from gsbench.run.identity import Run, label_of
from gsbench.run.resolve import Resolved, is_auto, plain, with_candidate, with_model
from gsbench.run.setup import build, build_with_placeholders
from gsbench.scenes import Scene
from gsbench.scenes.trained import TrainedGaussians
from gsbench.train.finite_check import DivergedError
from gsbench.train.loop import Trainer, comparison_of
from gsbench.train.optim import check_rates

FOLDER = "candidates"  # in the run's folder; each candidate has a folder there for its checkpoint


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
    parts = _Candidates(this, scene, start, candidates(this.config))
    state = fitting.saved_state(this, scene)
    found = comparison_of(state) if state else None
    if found is not None:
        if found.chosen not in parts.settings:
            raise InputError(f"checkpoint: expected a candidate of model=auto, got {found.chosen!r:.80}: "
                             f"start over with resume=false")  # fmt: skip
        trainer = parts.trainer(found.chosen)
        fitting.resume(trainer, this, state)
    else:
        trainer = _compared(parts, resolved)
        fitting.save(trainer.state_dict(), this, scene, plain(this, trainer.config))
    shutil.rmtree(this.folder / FOLDER, ignore_errors=True)
    return trainer


@dataclass(frozen=True)
class _Candidates:
    """The candidates of a run, each with a folder of its own."""

    this: Run
    scene: Scene
    start: TrainedGaussians | None
    settings: dict[str, Config]

    def run(self, name: str) -> Run:
        """Return the run of a candidate, whose folder is in that of the run and holds only its checkpoint."""
        this, config = self.this, self.settings[name]
        return replace(this, config=config, plain=plain(this, config), folder=this.folder / FOLDER / name,
                       label=f"{this.label} ({name})")  # fmt: skip

    def trainer(self, name: str) -> Trainer:
        """Return the trainer of a candidate at step 0."""
        config = self.settings[name]
        return fitting.trainer_of(build(config), self.scene, config, self.start)


def _compared(parts: _Candidates, resolved: Resolved) -> Trainer:
    """Train all candidates, print which is the best, and return its trainer with the costs of all."""
    found: list[Candidate] = []
    efforts: list[Effort] = []
    until, errors = 0, []
    for name in parts.settings:
        trainer = parts.trainer(name)
        until = trainer.schedule.compares_after
        try:
            _fit(parts, name, trainer, found)
            error = None
        except (DivergedError, fitting.NoGaussianError) as raised:
            errors.append(error := raised.with_traceback(None))  # the traceback keeps the trainer in memory
        psnr = None if error or trainer.curve.last is None else trainer.curve.last.psnr_val
        seconds = sum(trainer.stages.seconds.values())
        found.append(Candidate(name, psnr, seconds, one_line(error) if error else None))
        efforts.append(trainer.effort)
        del trainer
    if len(errors) == len(found):
        raise errors[0]
    best = max(range(len(found)), key=lambda i: _rank(found[i]))  # the first of equal ones
    comparison = ModelComparison(until, found[best].name, found)
    print(f"{parts.this.name}: {messages.of_comparison(comparison)}", file=sys.stderr)
    trainer = parts.trainer(comparison.chosen)
    run = parts.run(comparison.chosen)
    state = fitting.saved_state(replace(run, config=replace(run.config, resume=True)), parts.scene)
    if state is None:
        raise InputError(f"{run.folder}: expected the checkpoint of the best candidate, it is gone: run again")
    trainer.load_state_dict(state)
    trainer.comparison = comparison
    _add_costs(trainer, resolved, sum(one.seconds for i, one in enumerate(found) if i != best),
               [one for i, one in enumerate(efforts) if i != best])  # fmt: skip
    return trainer


def _rank(found: Candidate) -> tuple[bool, float]:
    """Return the value by which candidates are compared: none that failed is above one that did not."""
    return found.reason is None, -math.inf if found.psnr_val is None else found.psnr_val


def _fit(parts: _Candidates, name: str, trainer: Trainer, before: list[Candidate]) -> None:
    """Train a candidate to the step of the comparison, after the candidates `before`."""
    this, run, until = parts.this, parts.run(name), trainer.schedule.compares_after
    fitting.resume(trainer, run, fitting.saved_state(run, parts.scene))
    steps = (len(parts.settings) - 1) * until + trainer.config.train.iterations
    done, seconds = len(before) * until, sum(one.seconds for one in before)
    fitting.fit(trainer, run, run.plain, until=until, reporter=lambda: progress.Reporter(
        this.folder, this.overrides, steps, done, seconds
    ))  # fmt: skip


def _add_costs(trainer: Trainer, resolved: Resolved, seconds: float, efforts: list[Effort]) -> None:
    """Count the time screen and the training of the other candidates as training before that of the best."""
    screen = resolved.screen.seconds if resolved.screen else 0.0
    trainer.stages.add("screen", screen)
    trainer.stages.add("compare", seconds)
    trainer.curve.delay(screen + seconds)
    for effort in (resolved.effort, *efforts):
        trainer.effort.add(effort)


def reporter(this: Run, trainer: Trainer) -> progress.Reporter:
    """Report the progress of a run's last training; the steps of other candidates count as done."""
    others = len(trainer.comparison.candidates) - 1 if trainer.comparison else 0
    done = others * trainer.schedule.compares_after
    return progress.Reporter(this.folder, this.overrides, done + trainer.config.train.iterations, done)
