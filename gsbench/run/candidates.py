"""Train several candidates for one run, one after another, each with a checkpoint in a folder of its own."""

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from omegaconf import OmegaConf

from gsbench.config import Config
from gsbench.errors import InputError, one_line
from gsbench.measure.exact_views import rank
from gsbench.measure.record import Candidate, TimeScreen
from gsbench.measure.speed import Effort
from gsbench.run import fitting, progress
from gsbench.run.identity import Run
from gsbench.run.setup import build
from gsbench.scenes import Scene
from gsbench.scenes.gaussian_ply import TrainedGaussians
from gsbench.train.divergence import DivergedError
from gsbench.train.hooks.choices import lengths_of
from gsbench.train.loop import Trainer

FOLDER = "candidates"  # in the run's folder; each candidate has a folder there for its checkpoint


def plain(this: Run, config: Config) -> dict[str, Any]:
    """Return the settings of a training of a run as plain values: the run's, with the training's model and length.

    The checkpoint of a run has those of the training that is kept, so that its schedule is that of its length.
    """
    length = {"iterations": config.train.iterations, "lengths": lengths_of(config)}
    model = OmegaConf.to_container(OmegaConf.structured(config.model), resolve=True)
    return this.plain | {"train": this.plain["train"] | length, "model": model, "agr": config.agr}


@dataclass(frozen=True)
class Candidates:
    """The candidates of a run, by name. Each has the data and the seed of the run, and settings of its own."""

    this: Run
    scene: Scene
    start: TrainedGaussians | None  # trained Gaussians to start from; None: start from points
    settings: dict[str, Config]

    def trainer(self, name: str) -> Trainer:
        """Return the trainer of a candidate at step 0."""
        config = self.settings[name]
        return fitting.trainer_of(build(config), self.scene, config, self.start)

    def chosen(self, known: Callable[[dict[str, Any]], str | None], choose: Callable[[], Trainer]) -> Trainer:
        """Return the trainer of the candidate that the run's own checkpoint names, or else of the one to choose now.

        The choice is saved in the run's checkpoint, before the checkpoints of the candidates are deleted.

        Args:
            known: returns the name of the chosen candidate in the state of a checkpoint; None if there is none.
            choose: trains candidates, and returns the trainer of the best.

        Raises:
            InputError: a checkpoint is damaged.
        """
        state = fitting.saved_state(self.this, self.scene)
        name = known(state) if state else None
        if name is None:
            trainer = choose()
            fitting.save(trainer.state_dict(), self.this, self.scene, plain(self.this, trainer.config))
        elif name in self.settings:
            trainer = self.trainer(name)
            fitting.resume(trainer, self.this, state)
        else:
            raise InputError(f"checkpoint: expected one of {', '.join(self.settings)}, got {name!r:.80}: "
                             f"start over with resume=false")  # fmt: skip
        shutil.rmtree(self.this.folder / FOLDER, ignore_errors=True)
        return trainer

    def trained(
        self, chosen: "Result", results: Sequence["Result"], screen: TimeScreen | None, effort: Effort
    ) -> Trainer:
        """Return the trainer of the chosen candidate at the step of its checkpoint.

        The training of all other candidates counts as training before its own, and so do the time screen of model=auto
        and its CPU time, `effort`.

        Raises:
            InputError: the checkpoint is gone or damaged.
        """
        run, trainer = self._run(chosen.candidate.name), self.trainer(chosen.candidate.name)
        state = fitting.saved_state(replace(run, config=replace(run.config, resume=True)), self.scene)
        if state is None:
            raise InputError(f"{run.folder}: expected the checkpoint of the best candidate, it is gone: run again")
        trainer.load_state_dict(state)
        others = [result for result in results if result is not chosen]
        seconds = sum(other.candidate.seconds for other in others)
        trainer.stages.add("compare", seconds)
        if screen is not None:
            trainer.stages.add("screen", screen.seconds)
            seconds += screen.seconds
        trainer.curve.delay(seconds)
        for spent in (effort, *(other.effort for other in others)):
            trainer.effort.add(spent)
        return trainer

    def train(self, name: str, until: int, before: Sequence["Result"], steps: int) -> "Result":
        """Train a candidate to the step `until`, from its checkpoint if it has one, and return its PSNR on val.

        Args:
            name: the name of the candidate.
            until: the number of finished steps after which the training stops.
            before: the results of the candidates that were trained before, for reports of progress.
            steps: the number of steps of the whole run, for these reports.

        Raises:
            InputError: the checkpoint is damaged.
            Stopped: a signal asked the process to end; the checkpoint is saved.
        """
        this, run, trainer = self.this, self._run(name), self.trainer(name)
        done, seconds = sum(each.steps for each in before), sum(each.candidate.seconds for each in before)
        error = None
        try:
            fitting.resume(trainer, run, fitting.saved_state(run, self.scene))
            fitting.fit(trainer, run, run.plain, until=until, reporter=lambda: progress.Reporter(
                this.folder, this.overrides, steps, done, seconds
            ))  # fmt: skip
        except (DivergedError, fitting.NoGaussianError) as raised:
            error = raised.with_traceback(None)  # the traceback keeps the trainer in memory, and so does the context
            error.__context__ = None
        psnr = None if error or trainer.curve.last is None else trainer.curve.last.psnr_val
        spent = sum(trainer.stages.seconds.values())
        return Result(Candidate(name, psnr, spent, one_line(error) if error else None), until, trainer.effort, error)

    def _run(self, name: str) -> Run:
        """Return the run of a candidate, whose folder is in that of the run and holds only its checkpoint."""
        this, config = self.this, self.settings[name]
        return replace(this, config=config, plain=plain(this, config), folder=this.folder / FOLDER / name,
                       label=f"{this.label} ({name})")  # fmt: skip


@dataclass(frozen=True)
class Result:
    """What the training of a candidate gave, and what it cost."""

    candidate: Candidate
    steps: int  # after which its PSNR on val is measured
    effort: Effort
    error: DivergedError | fitting.NoGaussianError | None = None  # why the training failed

    @property
    def rank(self) -> tuple[bool, float]:
        """Return the value by which candidates are compared: none that failed is above one that did not."""
        return self.error is None, rank(self.candidate.psnr_val)


def highest(results: Sequence[Result]) -> Result:
    """Return the result with the highest PSNR on val, the last of equal ones, which may be one that failed."""
    return max(reversed(results), key=lambda result: result.rank)


def best(results: Sequence[Result]) -> Result:
    """Return the `highest` result.

    Raises:
        DivergedError, NoGaussianError: all candidates failed; the error is that of the first.
    """
    top, first = highest(results), results[0]
    if top.error is not None and first.error is not None:
        raise type(first.error)(
            f"all {len(results)} candidates failed; {first.candidate.name}: {first.candidate.reason}"
        )
    return top
