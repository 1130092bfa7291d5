"""Test whether hard trainings end with finite parameters, and how far float32 training drifts from float64."""

import contextlib
import io
import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from statistics import fmean, variance
from typing import Any

import torch

from gsbench.errors import InputError
from gsbench.models import GaussianModel
from gsbench.raster.exact import U
from gsbench.report.intervals import Spread
from gsbench.run.setup import build
from gsbench.scenes.scene import Camera, Points, Scene, View
from gsbench.stability.cases import Case, Cell, device_of
from gsbench.stability.training_cases import Training
from gsbench.train.diagnosis import explain
from gsbench.train.finite_check import DivergedError
from gsbench.train.loop import Trainer
from gsbench.train.seeding import generator

SEEDS = (0, 1, 2)  # of the trainings whose drift is measured
SHAKEN = (1, 2, 3)  # seeds of the changes of start values
# Start values are changed by at most this part. In ten steps of 7DGS on suzanne, float32 changes gradients by 4e-6 of
# each (median, two seeds), a change of start values by 16 U changes them by 2e-6, and one by 64 U by 8e-6. After a
# smaller change, trainings stay on the side of a threshold on which float32 puts them (docs/stability.md).
SHAKE = 64 * U
CHANCE = 0.01  # the probability that a model without a drift is said to have one


def judge(case: Case, backend: str, **more: Any) -> Iterator[Cell]:
    """Yield a result for each model: error 0 if the training ends as expected, otherwise error 1."""
    for name in case.subjects:
        training: Training = case(model=name, **more)
        start, end, bad, note = time.perf_counter(), 1.0, 1.0, ""
        steps = training.config.train.iterations
        try:
            trainer = fit(training, backend)
            bad = share_not_finite(trainer.model)
            end = float(training.refused)
            note = f"{steps} steps, {psnr(trainer):.2f} dB, {len(trainer.model)} Gaussians"
        except DivergedError as error:
            note = f"diverged: {error}"
        except InputError as error:
            end, bad = float(not training.refused), 0.0 if training.refused else 1.0
            note = f"refused: {error}"
        ms = 1e3 * (time.perf_counter() - start)
        yield Cell(case.area, case.name, name, "-", backend, end, float("nan"), bad, ms, case.bound, note)


def drift(case: Case, backend: str, seeds: Sequence[int] = SEEDS, **more: Any) -> Iterator[Cell]:
    """Yield, for each model, the difference in test PSNR of float32 and float64 training that is nearest to its bound.

    There is one difference for each seed. The float64 training uses the torch implementation. Some trainings amplify
    every rounding, for example if it decides which Gaussians are split. So where the difference exceeds the bound, both
    are trained again from start values that are changed by at most SHAKE, and the difference is that of the means. Its
    bound is then the largest difference of the means that chance explains (Student's t, 1 % for all seeds of a model
    together).
    """
    for name in case.subjects:
        found, notes, bad, ms = [(0.0, case.bound.forward)], [], 0.0, 0.0
        for seed in seeds:
            training: Training = case(model=name, run_seed=seed, **more)
            doubled = replace(training, scene=double(training.scene))
            exact = fit(doubled, "reference")
            start = time.perf_counter()
            single = fit(training, backend)
            ms += 1e3 * (time.perf_counter() - start)
            bad = max(bad, share_not_finite(single.model))
            singles, exacts = [_on_test(single)], [_on_test(exact)]
            notes.append(f"seed {seed}: {singles[0]:.4f} dB and {len(single.model)} Gaussians, in float64 "
                         f"{exacts[0]:.4f} and {len(exact.model)}")  # fmt: skip
            bound = case.bound.forward
            if not abs(singles[0] - exacts[0]) <= bound:
                singles += [_on_test(fit(training, backend, one)) for one in SHAKEN]
                exacts += [_on_test(fit(doubled, "reference", one)) for one in SHAKEN]
                bound = max(bound, _by_chance(singles, exacts, CHANCE / len(seeds)))
                notes.append(f"with start values changed by {SHAKE / U:.0f} roundings, {_listed(singles[1:])} dB, "
                             f"in float64 {_listed(exacts[1:])}")  # fmt: skip
            found.append((abs(fmean(singles) - fmean(exacts)), bound))
        error, bound = max(found, key=lambda pair: math.inf if math.isnan(pair[0]) else pair[0] / pair[1])
        yield Cell(case.area, case.name, name, "-", backend, error, float("nan"), bad, ms,
                   replace(case.bound, forward=bound), "; ".join(notes))  # fmt: skip


def _by_chance(a: Sequence[float], b: Sequence[float], p: float) -> float:
    """Return the difference of the means of two samples that chance exceeds with probability p (Student's t)."""
    spread = Spread(variance(a) / len(a) + variance(b) / len(b), len(a) + len(b) - 2)
    return spread.half_width(1 - p)


def _on_test(trainer: Trainer) -> float:
    return trainer.psnr(trainer.scene.test)


def _listed(values: Sequence[float]) -> str:
    return ", ".join(f"{value:.4f}" for value in values)


def fit(training: Training, backend: str, shaken_by: int | None = None) -> Trainer:
    """Train to the last step, in the floating-point type of the scene's images.

    Args:
        training: the training.
        backend: the backend that renders.
        shaken_by: the seed of a change of all start values by at most SHAKE; None for no change.

    Raises:
        DivergedError: a loss or gradient was not finite; the message names the parameter.
        InputError: the training refused the data.
    """
    config, scene = training.config, training.scene
    config.raster.backend = backend
    config.train.curve_points = 1
    model = build(config)
    assert scene.points is not None
    model.initialise(scene.points, scene.extent, generator(config.seed))
    dtype, config.device = scene.train[0].image.dtype, device_of(backend)
    model.to(config.device, dtype)
    if shaken_by is not None:
        _shake(model, shaken_by)
    scene = scene.to(config.device)
    trainer = Trainer(model, scene, scene.train, config)
    with contextlib.redirect_stderr(io.StringIO()):  # one progress bar is enough
        try:
            trainer.run(lambda _: None, training.model)
        except DivergedError as error:
            raise DivergedError(f"{error}; {explain(model)}") from None
    return trainer


@torch.no_grad()
def _shake(model: GaussianModel, seed: int) -> None:
    """Change every parameter by a random part of itself, at most SHAKE."""
    g = torch.Generator().manual_seed(seed)
    for parameter in model.parameters():
        change = 2 * torch.rand(parameter.shape, generator=g, dtype=parameter.dtype) - 1
        parameter.mul_(1 + SHAKE * change.to(parameter.device))


def psnr(trainer: Trainer) -> float:
    """Return the mean PSNR over the training views, in dB."""
    return trainer.psnr(trainer.scene.train)


def share_not_finite(model: GaussianModel) -> float:
    """Return the share of the model's parameter values (including network weights) that are NaN or infinite."""
    values = torch.cat([p.detach().flatten() for p in model.parameters()])
    return float((~values.isfinite()).double().mean()) if values.numel() else 0.0


def double(scene: Scene) -> Scene:
    """Convert a scene to float64, except its points, so that float32 and float64 training start from equal values."""

    def view(seen: View) -> View:
        camera = Camera(seen.camera.viewmat.double(), seen.camera.K.double(), seen.camera.width, seen.camera.height)
        return replace(seen, camera=camera, pixels=seen.image.double())

    train, val, test = ([view(v) for v in views] for views in (scene.train, scene.val, scene.test))
    points = scene.points and Points(scene.points.means, scene.points.colors)
    return replace(scene, train=train, val=val, test=test, points=points)
