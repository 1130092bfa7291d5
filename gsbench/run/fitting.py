"""Train a model: initialise it, continue from a checkpoint if there is one, and stop when a signal asks for it."""

import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from gsbench.config import Config, DataConfig
from gsbench.errors import InputError
from gsbench.measure.settings import training_hash
from gsbench.measure.speed import reset_peak_memory
from gsbench.models import GaussianModel
from gsbench.models.start import start_from
from gsbench.run import progress, stop
from gsbench.run.checks import evaluated_views
from gsbench.run.identity import Run
from gsbench.run.load import plain_description
from gsbench.run.resolve import Resolved
from gsbench.scenes import Points, Scene
from gsbench.scenes.points import frustum_points, random_points
from gsbench.scenes.trained import TrainedGaussians
from gsbench.train import checkpoint
from gsbench.train.checkpoint import Checkpoint
from gsbench.train.finite_check import DivergedError
from gsbench.train.loop import Trainer
from gsbench.train.seeding import generator


def trainer_of(model: GaussianModel, scene: Scene, config: Config, start: TrainedGaussians | None) -> Trainer:
    """Initialise the Gaussians of a model and return the trainer at step 0.

    Args:
        model: the model, still without Gaussians.
        scene: the scene with its views, and with initial points if the data set has some.
        config: the settings of the run.
        start: trained Gaussians to start from; None to start from points.
    """
    random = generator(config.seed)
    if start is not None:
        start_from(model, start, scene.extent, random)
    else:
        model.initialise(scene.points or initial_points(config.data, scene, random), scene.extent, random)
    model.to(config.device)
    return Trainer(model, scene, evaluated_views(scene, config.scene.eval_split), config)


def resume(trainer: Trainer, this: Run, resolved: Resolved) -> None:
    """Continue from the checkpoint in the run's folder if there is one that the settings allow to use.

    Args:
        trainer: the trainer at step 0.
        this: the run to train, with its folder.
        resolved: the settings of the run after model=auto was replaced by a model; the seconds of this choice count as
            training.

    Raises:
        InputError: the checkpoint is damaged.
    """
    config = resolved.config
    reset_peak_memory(config.device)
    path, hashes = _checkpoint_of(this, trainer)
    state = checkpoint.load(path, *hashes, config.device) if config.resume else None
    if state is not None:
        trainer.load_state_dict(state)
        print(f"{this.name}: continues from step {trainer.step} of {path}", file=sys.stderr)
    elif resolved.screen is not None:
        trainer.stages.add("screen", resolved.screen.seconds)
        trainer.effort.add(resolved.effort)


def _checkpoint_of(this: Run, trainer: Trainer) -> tuple[Path, tuple[str, str]]:
    """Return the path of a run's checkpoint, and the hashes of the settings and of the data that it must have."""
    return this.folder / checkpoint.FILE_NAME, (training_hash(this.plain), trainer.scene.fingerprint)


def fit(trainer: Trainer, this: Run, config: Config, plain: dict[str, Any], follow: Callable[[], None]) -> None:
    """Train to the last step.

    Args:
        trainer: the trainer at its first step.
        this: the run to train, with its folder.
        config: the settings of the run after model=auto was replaced by a model.
        plain: the settings as plain values, for the checkpoint.
        follow: a function that is called after every step.

    Raises:
        InputError: no Gaussian is left.
        DivergedError: a loss or gradient was not finite.
        Stopped: a signal asked the process to end; the checkpoint is saved.
    """
    path, hashes = _checkpoint_of(this, trainer)
    about = plain, plain_description(trainer.scene)
    with stop.requested() as request:
        report = progress.Reporter(this.folder, this.overrides, config.train.iterations)

        def goes_on() -> bool:
            follow()
            if report.is_due():
                report(trainer.step, sum(trainer.stages.seconds.values()), trainer.curve.last)
            return request.signal is None

        trainer.run(lambda state: checkpoint.save(path, Checkpoint(*hashes, state, *about)), this.name, goes_on)
        if request.signal is not None and trainer.step < config.train.iterations:
            report.end()
            if request.signal == signal.SIGUSR2:  # submitit's handler puts the job back into the queue, and ends it
                request.hand_on(request.signal)
            raise stop.Stopped(request.signal, f"{this.name}: stopped at step {trainer.step}, saved in {path}: "
                                               f"the same command continues from there")  # fmt: skip
    _check_fitted(trainer)


def _check_fitted(trainer: Trainer) -> None:
    """Raise DivergedError if a parameter is not finite, and InputError if no Gaussian is left."""
    for name, parameter in trainer.model.named_parameters():  # images would not show a colour of -inf, which is black
        if not parameter.isfinite().all():
            raise DivergedError(f"step {trainer.step}: '{name}' has values that are not finite")
    if not len(trainer.model):
        raise InputError("no Gaussian is left: the training pruned all of them; look at train.densify, "
                         "model.min_opacity and data.initial_half_width")  # fmt: skip


def initial_points(data: DataConfig, scene: Scene, random: torch.Generator) -> Points:
    """Sample initial points for a data set without points, in a cube or in the frustum that all cameras share."""
    if data.initial_half_width is not None:
        return random_points(data.initial_points, data.initial_half_width, random)
    cameras = [view.to("cpu").camera for view in scene.train]
    return frustum_points(data.initial_points, cameras, scene.extent, random)
