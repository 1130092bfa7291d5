"""Train a model: initialise it, continue from a checkpoint if there is one, and stop when a signal asks for it."""

import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from gsbench.config import Config, DataConfig
from gsbench.config_roles import training_hash
from gsbench.errors import InputError
from gsbench.models import GaussianModel
from gsbench.run import progress, stop
from gsbench.run.identity import RunSpec
from gsbench.run.load import SceneDescription
from gsbench.run.setup import evaluated_views
from gsbench.scenes import Points, Scene
from gsbench.scenes.gaussian_ply import TrainedGaussians
from gsbench.scenes.points import frustum_points, random_points, share_of_points_seen
from gsbench.scenes.scene import STANDARD
from gsbench.train import checkpoint
from gsbench.train.batches import generator
from gsbench.train.checkpoint import Checkpoint
from gsbench.train.divergence import DivergedError
from gsbench.train.loop import Trainer

LEAST_SEEN = 0.25  # share of random initial points that cameras must see; others are never trained


class NoGaussianError(InputError):
    """A training has pruned all Gaussians."""


def trainer_of(
    model: GaussianModel, scene: Scene, config: Config, start: TrainedGaussians | None, *, quiet: bool = False
) -> Trainer:
    """Initialise the Gaussians of a model, from trained ones or from points, and return the trainer at step 0.

    With `quiet`, nothing is printed about the points.
    """
    random = generator(config.seed)
    if start is not None:
        model.start_from(start, scene.extent, random)
    else:
        model.initialise(initial_points(config.data, scene, random, quiet=quiet), scene.extent, random)
    model.to(config.device)
    return Trainer(model, scene, evaluated_views(scene, config.scene.eval_split), config)


def saved_state(spec: RunSpec, scene: Scene) -> dict[str, Any] | None:
    """Return the state in the checkpoint of the run's folder; None if there is none that the settings allow to use.

    Raises:
        InputError: the checkpoint is damaged.
    """
    path, hashes = _checkpoint_of(spec, scene)
    return checkpoint.load(path, *hashes, spec.config.device) if spec.config.resume else None


def resume(trainer: Trainer, spec: RunSpec, state: dict[str, Any] | None) -> bool:
    """Continue from the `saved_state` of a run, and return whether there is one.

    Raises:
        InputError: the state belongs to another training.
    """
    if state is None:
        return False
    trainer.load_state_dict(state)
    path = spec.folder / checkpoint.FILE_NAME
    print(f"{spec.name}: continues from step {trainer.step} of {path}", file=sys.stderr)
    return True


def save(state: dict[str, Any], spec: RunSpec, scene: Scene, plain: dict[str, Any]) -> None:
    """Write the checkpoint of a run: a trainer's state, with the settings as plain values."""
    path, hashes = _checkpoint_of(spec, scene)
    checkpoint.save(path, Checkpoint(*hashes, state, plain, asdict(SceneDescription.of(scene))))


def _checkpoint_of(spec: RunSpec, scene: Scene) -> tuple[Path, tuple[str, str]]:
    """Return the path of a run's checkpoint, and the hashes of the settings and of the data that it must have."""
    return spec.folder / checkpoint.FILE_NAME, (training_hash(spec.plain), scene.fingerprint)


def fit(
    trainer: Trainer,
    spec: RunSpec,
    plain: dict[str, Any],
    reporter: Callable[[], progress.Reporter],
    follow: Callable[[], None] = lambda: None,
    until: int | None = None,
) -> None:
    """Train to the last step, or until `until` steps are finished; `follow` is called after every step.

    `plain` holds the settings for the checkpoint. `reporter` starts to report the progress, once signals are handled.

    Raises:
        NoGaussianError: no Gaussian is left.
        DivergedError: a loss or gradient was not finite.
        Stopped: a signal asked the process to end; the checkpoint is saved.
    """
    path = spec.folder / checkpoint.FILE_NAME
    with stop.requested() as request:
        report = reporter()
        if trainer.step:
            report(trainer.step, sum(trainer.stages.seconds.values()), trainer.curve.last)

        def goes_on() -> bool:
            follow()
            if report.is_due():
                report(trainer.step, sum(trainer.stages.seconds.values()), trainer.curve.last)
            return request.signal is None and trainer.step != until

        if trainer.step != until:  # a checkpoint may be there already
            trainer.run(lambda state: save(state, spec, trainer.scene, plain), spec.name, goes_on)
            report(trainer.step, sum(trainer.stages.seconds.values()), trainer.curve.last)
    if request.signal is not None:  # asked here, so that a signal after the last step is not lost
        raise stop.Stopped(
            request.signal,
            f"{spec.name}: stopped at step {trainer.step}, saved in {path}: the same command continues from there",
        )
    _check_fitted(trainer)


def _check_fitted(trainer: Trainer) -> None:
    """Raise DivergedError if a parameter is not finite, and NoGaussianError if no Gaussian is left."""
    for name, parameter in trainer.model.named_parameters():  # images would not show a colour of -inf, which is black
        if not parameter.isfinite().all():
            raise DivergedError(f"step {trainer.step}: '{name}' has values that are not finite")
    if not len(trainer.model):
        raise NoGaussianError(
            "no Gaussian is left: the training pruned all of them; look at train.densify, "
            "model.min_opacity and data.initial_half_width"
        )


def initial_points(data: DataConfig, scene: Scene, random: torch.Generator, *, quiet: bool = False) -> Points:
    """Return the points of a data set, or sample some in a cube or in the frustum that all cameras share.

    The share of sampled points that at least one training camera sees is printed, and that of others if `data.near`
    hides most of them, unless `quiet`.

    Raises:
        InputError: cameras see none of the points beyond `data.near`, or too few of sampled ones.
    """
    cameras = [view.camera.to("cpu") for view in scene.train]
    if scene.points is not None:
        share = 1.0 if data.near is None else share_of_points_seen(scene.points, cameras, LEAST_SEEN)
        where = f"of {len(scene.points.means)} initial points, training cameras see {share:.1%} beyond"
        if share == 0:
            raise InputError(f"{scene.name}: data.near: {where} {data.near:g}: lower it")
        if share < LEAST_SEEN and not quiet:
            print(f"{scene.name}: {where} data.near={data.near:g}", file=sys.stderr)
        return scene.points
    if data.initial_half_width is None:
        return frustum_points(data.initial_points, cameras, scene.extent, random)
    points = random_points(data.initial_points, data.initial_half_width, random)
    share = share_of_points_seen(points, cameras)
    where = f"{data.initial_points} initial points in a cube of half width {data.initial_half_width:g}"
    if share < LEAST_SEEN:
        away = sum(bool(camera.viewmat[2, 3] < 0) for camera in cameras)  # the depth of the origin, the cube's centre
        axes = (
            f"; {away} of {len(cameras)} cameras look away from it: are their axes right (in transforms*.json x "
            f"right, y up, z back)?"
        )
        near = "" if data.near is None else f"lower data.near={data.near:g}, or "
        raise InputError(
            f"{scene.name}: expected {where}, of which cameras see at least {LEAST_SEEN:.0%}, they see "
            f"{share:.1%}: {near}set data.initial_half_width (cameras are {STANDARD:g} away from what they look "
            f"at), or null for points that all cameras see{axes if away else ''}"
        )
    if not quiet:
        print(f"{scene.name}: {where}; {share:.0%} are seen by at least one camera", file=sys.stderr)
    return points
