"""Choose the training of a run among several by PSNR on val: a model for model=auto, a length for train.lengths.

For model=auto, a test whether the scene changes with time decides between a candidate with time ("moving") and one
without ("static"). With effects.compare=true, and if the scene may move, all candidates are trained to 70 % of their
steps, and the best on val, of those within the budget, is trained to the end.

For train.lengths a run is trained at several lengths, each from the start. Long trainings of small scenes overfit.
Learning rates fall to the end of a training, so that to stop it early is worth little: a training that was planned to
be short is better (docs/tuning.md).
"""

import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from omegaconf import OmegaConf

from gsbench.config import Config
from gsbench.errors import InputError, one_line
from gsbench.gates import messages
from gsbench.gates.screen import import_compiler, screen_time
from gsbench.measure.exact_views import rank
from gsbench.measure.record import Candidate, LengthChoice, ModelComparison, TimeScreen
from gsbench.measure.speed import Effort
from gsbench.models.gated import has_gates
from gsbench.run import fitting, measuring, progress
from gsbench.run.identity import RunSpec
from gsbench.run.settings import HOW_TO, candidates, with_candidate
from gsbench.run.setup import build, build_with_placeholders, check_scene
from gsbench.scenes import Scene
from gsbench.scenes.gaussian_ply import TrainedGaussians
from gsbench.schedule import Schedule
from gsbench.train.divergence import DivergedError
from gsbench.train.hooks.choices import Choices, ChosenOnVal, choices_in, length_name, lengths_of
from gsbench.train.loop import Trainer
from gsbench.train.optim import check_rates

FOLDER = "candidates"  # in the run's folder; each candidate has a folder there for its checkpoint


def plain(spec: RunSpec, config: Config) -> dict[str, Any]:
    """Return the settings of a training of a run as plain values: the run's, with the training's model and length.

    The checkpoint of a run has those of the training that is kept, so that its schedule is that of its length.
    """
    train = {"iterations": config.train.iterations, "lengths": lengths_of(config)}
    model = OmegaConf.to_container(OmegaConf.structured(config.model), resolve=True)
    groups = {"train": train, "effects": {"gate": config.effects.gate}}  # off where `gated_if_possible` says so
    changed = {name: spec.plain[name] | values for name, values in groups.items()}
    return spec.plain | changed | {"model": model, "agr": config.agr}


class OverBudgetError(InputError):
    """A candidate takes more seconds or milliseconds a frame than the user allows."""


@dataclass(frozen=True)
class Candidates:
    """The candidates of a run, by name. Each has the data and the seed of the run, and settings of its own."""

    spec: RunSpec
    scene: Scene
    start: TrainedGaussians | None  # trained Gaussians to start from; None: start from points
    settings: dict[str, Config]

    def trainer(self, name: str, *, quiet: bool) -> Trainer:
        """Return the trainer of a candidate at step 0; with `quiet`, nothing is printed about its initial points."""
        config = self.settings[name]
        return fitting.trainer_of(build(config), self.scene, config, self.start, quiet=quiet)

    def chosen(self, model: "ChosenModel") -> Trainer:
        """Train the candidates, print which is the best, and return its trainer with the costs of all."""
        results: list[Result] = []
        for name, config in self.settings.items():
            if model.compares:
                until = Schedule(config.train, config.model.sh_degree, config.agr).compares_after
                steps = (len(self.settings) - 1) * until + config.train.iterations  # one of them is trained to the end
            else:
                until = config.train.iterations
                steps = sum(each.train.iterations for each in self.settings.values())
            results.append(self.train(name, until, results, steps))
            top = highest(results)
            if not model.compares and top is not results[-1] and top.error is None:
                break
        chosen, tried = best(results), [result.candidate for result in results]
        if model.compares:
            comparison = ModelComparison(chosen.steps, chosen.candidate.name, tried)
            choice, message = ChosenOnVal(comparison=comparison), messages.of_comparison(comparison)
        else:
            length = LengthChoice(chosen.steps, tried)
            choice, message = ChosenOnVal(length=length), messages.of_lengths(length)
        print(f"{self.spec.name}: {message}", file=sys.stderr)
        trainer = self.trained(chosen, results, model)
        trainer.hook(Choices).chosen = choice
        return trainer

    def trained(self, chosen: "Result", results: Sequence["Result"], model: "ChosenModel") -> Trainer:
        """Return the trainer of the chosen candidate at the step of its checkpoint.

        The training of all other candidates counts as training before its own, and so do the time screen of model=auto
        and its CPU time.

        Raises:
            InputError: the checkpoint is gone or damaged.
        """
        run, trainer = self._run(chosen.candidate.name), self.trainer(chosen.candidate.name, quiet=True)
        resumed = replace(run, config=replace(run.config, resume=True))  # its checkpoint is of this command
        state = fitting.saved_state(resumed, self.scene)
        if state is None:
            raise InputError(f"{run.folder}: expected the checkpoint of the best candidate, it is gone: run again")
        trainer.load_state_dict(state)
        others = [result for result in results if result is not chosen]
        seconds = sum(other.candidate.seconds for other in others)
        trainer.stages.add("compare", seconds)
        if model.screen is not None:
            trainer.stages.add("screen", model.screen.seconds)
            seconds += model.screen.seconds
        trainer.curve.delay(seconds)
        for spent in (model.effort, *(other.effort for other in others)):
            trainer.effort.add(spent)
        return trainer

    def train(self, name: str, until: int, before: Sequence["Result"], steps: int) -> "Result":
        """Train a candidate to `until` steps, from its checkpoint if it has one, and return its PSNR on val.

        The results `before`, and the `steps` of the whole run, are for reports of progress.

        Raises:
            InputError: the checkpoint is damaged.
            Stopped: a signal asked the process to end; the checkpoint is saved.
        """
        spec, run = self.spec, self._run(name)
        trainer = self.trainer(name, quiet=bool(before))  # all start from the same points
        done, seconds = sum(each.steps for each in before), sum(each.candidate.seconds for each in before)
        error = frame_ms = None  # frame_ms stays None if the training fails or takes too long
        try:
            fitting.resume(trainer, run, fitting.saved_state(run, self.scene))
            fitting.fit(
                trainer,
                run,
                run.plain,
                follow=lambda: self._check_seconds(trainer),
                until=until,
                reporter=lambda: progress.Reporter(spec.folder, spec.overrides, steps, done, seconds),
            )
            frame_ms = measuring.time_frames(trainer, self.scene.val)[0].p50
            if (most := spec.config.effects.most_frame_ms) is not None and frame_ms > most:
                raise OverBudgetError(f"more than effects.most_frame_ms={most:g}")
        except (DivergedError, fitting.NoGaussianError, OverBudgetError) as raised:
            error = raised.with_traceback(None)  # the traceback keeps the trainer in memory, and so does the context
            error.__context__ = None
        psnr = None if frame_ms is None or trainer.curve.last is None else trainer.curve.last.psnr_val
        taken, reason = sum(trainer.stages.seconds.values()), one_line(error) if error else None
        return Result(Candidate(name, psnr, taken, reason, frame_ms), until, trainer.effort, error)

    def _check_seconds(self, trainer: Trainer) -> None:
        """Raise OverBudgetError if the training took too long by its last measurement on val."""
        most, last = self.spec.config.effects.most_seconds, trainer.curve.last
        if most is not None and last is not None and last.seconds > most:
            raise OverBudgetError(f"more than effects.most_seconds={most:g} after {last.iteration} iterations")

    def _run(self, name: str) -> RunSpec:
        """Return the run of a candidate, whose folder is in that of the run and holds only its checkpoint."""
        spec, config = self.spec, self.settings[name]
        return replace(
            spec,
            config=config,
            plain=plain(spec, config),
            folder=spec.folder / FOLDER / name,
            label=f"{spec.label} ({name})",
        )


@dataclass(frozen=True)
class Result:
    """What the training of a candidate gave, and what it cost."""

    candidate: Candidate
    steps: int  # after which its PSNR on val is measured
    effort: Effort
    error: DivergedError | fitting.NoGaussianError | OverBudgetError | None = None  # why it cannot be chosen

    @property
    def rank(self) -> tuple[bool, float]:
        """Return the value by which candidates are compared: none that cannot be chosen is above one that can."""
        return self.error is None, rank(self.candidate.psnr_val)


def highest(results: Sequence[Result]) -> Result:
    """Return the result with the highest PSNR on val, the last of equal ones, which may be one that failed."""
    return max(reversed(results), key=lambda result: result.rank)


def best(results: Sequence[Result]) -> Result:
    """Return the `highest` result.

    Raises:
        DivergedError, NoGaussianError, OverBudgetError: no candidate can be chosen; the error is that of the first.
    """
    top, first = highest(results), results[0]
    if top.error is not None and first.error is not None:
        raise type(first.error)(
            f"none of {len(results)} candidates can be chosen; {first.candidate.name}: {first.candidate.reason}"
        )
    return top


def gated_if_possible(config: Config) -> Config:
    """Return settings without gates if these cannot simplify the model, such as a field."""
    ungated = replace(config, effects=replace(config.effects, gate="off"))
    return config if has_gates(build(ungated)) else ungated


def check_candidates(config: Config, scene: Scene) -> None:
    """Raise InputError, before step 0, if the scene has no val views or a candidate cannot be trained on it.

    A scene without times is not checked, because model=auto compares nothing on it.
    """
    if not scene.val:
        raise InputError(
            f"effects.compare=true: expected views of val to compare models on, {scene.name} has none: "
            f"scene.val_every=8 takes every eighth training view",
            docs=HOW_TO,
        )
    for name, candidate in candidates(config).items():
        try:
            settings = gated_if_possible(candidate)
            check_scene(build(settings), scene, settings)
            check_rates(build_with_placeholders(settings, scene.extent).groups(), settings.model)
        except InputError as error:
            raise InputError(f"effects.compare=true, candidate {name}: {error}") from None


@dataclass(frozen=True)
class ChosenModel:
    """The settings of a training after model=auto was replaced by a model, and the test that chose it."""

    config: Config
    screen: TimeScreen | None = None  # the test that chose the model, for model=auto
    effort: Effort = field(default_factory=Effort)  # CPU time of this test

    @property
    def compares(self) -> bool:
        """Return whether a comparison on val must still choose the model: `effects.compare`, if the scene may move."""
        return self.config.effects.compare and self.screen is not None and self.screen.decision != "off"


def choose_model(spec: RunSpec, scene: Scene) -> ChosenModel:
    """Replace model=auto by a model with or without time, after a test whether the training views change with time.

    The reason is printed. If the test is undecided, the model has time: training 7DGS on a static scene costs a few
    seconds, but 6DGS on a moving scene loses the motion.

    Raises:
        InputError: the settings lack a candidate of model=auto.
    """
    import_compiler()
    effort = Effort()
    with effort:
        screen = screen_time(scene, spec.config.seed, spec.config.raster.backend)
        config = with_candidate(spec.config, "static" if screen.decision == "off" else "moving")
    chosen = ChosenModel(config, screen, effort)
    name = f"{config.model.name}{' with AGR' if config.agr else ''}"
    print(
        f"{spec.name}: time is {screen.decision}: {screen.reason}; "
        f"{'models are compared on val' if chosen.compares else name}",
        file=sys.stderr,
    )
    return chosen


def best_on_val(spec: RunSpec, scene: Scene, start: TrainedGaussians | None, model: ChosenModel) -> Trainer:
    """Return the trainer of the candidate with the highest PSNR on val, from which the run continues.

    The candidates are trained one after another, each with the settings and the seed of the run, so that the result is
    bit-equal to a run of the chosen one alone. Models are trained until they are compared. Lengths are trained to their
    last step, from the shortest on, and end with the first that is not better on val than all before it; each is gated
    as such a run is, after its PSNR on val was measured. The seconds of the time screen and of the other candidates
    count as training.

    A checkpoint of each candidate is kept until the choice is saved in the run's own checkpoint.

    Raises:
        InputError: a checkpoint is damaged.
        DivergedError, NoGaussianError, OverBudgetError: no candidate can be chosen; the error is that of the first.
        Stopped: a signal asked the process to end; the checkpoint of the present candidate is saved.
    """
    if model.compares:
        settings = {name: gated_if_possible(candidate) for name, candidate in candidates(spec.config).items()}
    else:
        settings = lengths(model.config)
    trainings, state = Candidates(spec, scene, start, settings), fitting.saved_state(spec, scene)
    name = choices_in(state).candidate if state else None
    if name is None:
        trainer = trainings.chosen(model)
        fitting.save(trainer.state_dict(), spec, scene, plain(spec, trainer.config))
    elif name in settings:
        trainer = trainings.trainer(name, quiet=False)
        fitting.resume(trainer, spec, state)
    else:
        raise InputError(
            f"checkpoint: expected one of {', '.join(settings)}, got {name!r:.80}: start over with resume=false"
        )
    shutil.rmtree(spec.folder / FOLDER, ignore_errors=True)
    return trainer


def reporter(spec: RunSpec, trainer: Trainer) -> progress.Reporter:
    """Report the progress of a run's last training; the steps of other candidates count as done."""
    comparison = trainer.hook(Choices).chosen.comparison
    others = len(comparison.candidates) - 1 if comparison else 0
    done = others * trainer.schedule.compares_after
    return progress.Reporter(spec.folder, spec.overrides, done + trainer.config.train.iterations, done)


def lengths(config: Config) -> dict[str, Config]:
    """Return the settings of each length, by a name such as "iterations=1000", the shortest first.

    Each length is twice the one before, and the last is `train.iterations`.
    """
    train, count = config.train, lengths_of(config)
    assert count is not None
    alone: dict[str, Any] = {"lengths": None}  # a dict, as mypy does not know the keys of hooks
    trains = [replace(train, iterations=train.iterations >> k, **alone) for k in reversed(range(count))]
    return {length_name(shorter.iterations): replace(config, train=shorter) for shorter in trains}
