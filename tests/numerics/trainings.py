"""Test whether hard trainings end with finite parameters, and how far float32 training drifts from float64."""

import contextlib
import io
import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from statistics import fmean, variance
from typing import Any

import torch
from tiny_training import VIEWS, compose, moving_square
from torch import Generator

from gsbench.config import Config
from gsbench.errors import InputError
from gsbench.models import GaussianModel
from gsbench.raster.exact import U
from gsbench.report.intervals import Spread
from gsbench.run.setup import build, load_scene
from gsbench.scenes.points import random_points
from gsbench.scenes.scene import Points, Scene, View
from gsbench.stability.float32_error import float64_camera
from gsbench.train.batches import generator
from gsbench.train.divergence import DivergedError, explain
from gsbench.train.loop import Trainer
from numerics.cases import Case, Cell, case, device_of

MODELS = ("3dgs", "4dgs", "6dgs", "7dgs")
STEPS, LONG_STEPS = 150, 2_000
DRIFT_STEPS, LONG_DRIFT_STEPS, DRIFT_POINTS = 150, 300, 1_000
DRIFTING = ("4dgs", "7dgs", "7dgs_noagr")  # the models whose drift the audit measures; `--long` measures all
SEEDS = (0, 1, 2)  # of the trainings whose drift is measured
SHAKEN = (1, 2, 3)  # seeds of the changes of start values
# Start values are changed by at most this part. In ten steps of 7DGS on suzanne, float32 changes gradients by 4e-6 of
# each (median, two seeds), a change of start values by 16 U changes them by 2e-6, and one by 64 U by 8e-6. After a
# smaller change, trainings stay on the side of a threshold on which float32 puts them.
SHAKE = 64 * U
CHANCE = 0.01  # the probability that a model without a drift is taken for one that has a drift
ENDS = {"forward": 0.0, "gradient": math.nan}  # the bound: the training ends as expected


@dataclass
class Training:
    """A training of the audit: its model, settings and scene."""

    model: str
    config: Config
    scene: Scene
    refused: bool = False  # it must be refused before the first step


@case("training", *MODELS, **ENDS)
def learning_rates_times_30(g: Generator, severity: float, model: str, steps: int = STEPS) -> Training:
    """Multiply all learning rates by 30, so that parameters reach the ends of their ranges."""
    config = compose(model, steps)
    for rate in config.model.lr.values():
        rate.start *= 30**severity
        rate.end = rate.end if rate.end is None else rate.end * 30**severity
    return Training(model, config, moving_square())


@case("training", *MODELS, **ENDS)
def one_frame(g: Generator, severity: float, model: str) -> Training:
    """Train on a single image, which determines neither depth, motion nor view dependence; the scene extent is zero."""
    scene = moving_square()
    views = scene.train[: max(1, round(VIEWS * (1 - severity)))]
    return Training(model, compose(model, STEPS), replace(scene, train=views, extent=4.4 * (1 - severity)))


@case("training", *MODELS, **ENDS)
def all_images_equal(g: Generator, severity: float, model: str) -> Training:
    """Train on black images: opacities decrease, and all Gaussians may be pruned."""
    scene = moving_square()
    views = [replace(view, pixels=view.image * (1 - severity)) for view in scene.train]
    return Training(model, compose(model, STEPS), replace(scene, train=views))


@case("training", *MODELS, **ENDS)
def seen_by_no_view(g: Generator, severity: float, model: str) -> Training:
    """Put half of the Gaussians outside all views: their gradients are 0, and Adam divides them by sqrt(0) + eps."""
    scene = moving_square()
    means = scene.points.means.clone()
    means[::2, 1] += 100 * severity
    return Training(model, compose(model, STEPS), replace(scene, points=Points(means, scene.points.colors)))


@case("training", "7dgs", **ENDS)
def reset_into_refinement(g: Generator, severity: float, model: str) -> Training:
    """Reset opacities just before AGR (neural refinement) starts, with 100 times the usual learning rate of AGR."""
    densify = ("train.densify.start=20", "train.densify.reset_every=100", "train.densify.stop=500")
    rest = ("train.recipe_iterations=300", "train.refine_from=100", "train.batch_size=1")
    config = compose(model, 2 * STEPS, *densify, *rest)
    config.model.lr["refinement"].start *= 100**severity
    return Training(model, config, moving_square())


@case("training", "6dgs", "7dgs", **ENDS)
def lambda_switched_on(g: Generator, severity: float, model: str) -> Training:
    """Start to train lambda halfway at 1000 times the usual rate, so that lambda goes to 0 or infinity. Lambda is the
    coefficient in the exponent by which opacity decreases with the distance in time or direction."""
    config = compose(model, STEPS, "train.lambda_from=15000")
    config.model.lr["lambda"].start = 1e-3 * 1000**severity
    return Training(model, config, moving_square())


@case("training", "3dgs", **ENDS)
def poisoned_photograph(g: Generator, severity: float, model: str) -> Training:
    """Make one pixel of a training image NaN: training must refuse the data before the first step."""
    scene = moving_square()
    scene.train[3].image[2, 5, 1] = math.nan
    return Training(model, compose(model, STEPS), scene, refused=True)


@case(
    "drift",
    *DRIFTING,
    "3dgs",
    "6dgs",
    "7dgs_nodir",
    "dgs",
    "ndgs",
    "dbs",
    "ubs",
    "freetime",
    forward=0.02,
    gradient=math.nan,
)
def single_against_double(
    g: Generator, severity: float, model: str, run_seed: int = 0, steps: int = DRIFT_STEPS
) -> Training:
    """Train 150 steps of the embedded scene suzanne at 40 x 40 pixels in float32 and in float64, and compare PSNR.
    Rounding may decide which Gaussians are split. The error is the difference in dB. `--long` trains 300 steps."""
    words = ("scene=suzanne", "scene.downscale=4", "train.batch_size=1", f"train.densify.every={steps // 3}")
    config = compose(model, steps, *words, f"seed={run_seed}")
    points = random_points(DRIFT_POINTS, 1.0, generator(run_seed))
    return Training(model, config, replace(load_scene(config), points=points))


def judge(case: Case, backend: str, **more: Any) -> Iterator[Cell]:
    """Yield a result for each model: error 0 if the training ends as expected, otherwise error 1."""
    for name in case.subjects:
        training: Training = case(model=name, **more)
        start, end, bad = time.perf_counter(), 1.0, 1.0
        try:
            trainer = fit(training, backend)
            bad, end = share_not_finite(trainer.model), float(training.refused)
            note = f"{training.config.train.iterations} steps, {psnr(trainer):.2f} dB, {len(trainer.model)} Gaussians"
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
    together)."""
    for name in case.subjects:
        drifts, notes, bad, ms = [(0.0, case.bound.forward)], [], 0.0, 0.0
        for seed in seeds:
            training: Training = case(model=name, run_seed=seed, **more)
            doubled = replace(training, scene=double(training.scene))
            exact = fit(doubled, "reference")
            start = time.perf_counter()
            single = fit(training, backend)
            ms += 1e3 * (time.perf_counter() - start)
            bad = max(bad, share_not_finite(single.model))
            singles, exacts = [_on_test(single)], [_on_test(exact)]
            notes.append(
                f"seed {seed}: {singles[0]:.4f} dB and {len(single.model)} Gaussians, in float64 "
                f"{exacts[0]:.4f} and {len(exact.model)}"
            )
            bound = case.bound.forward
            if not abs(singles[0] - exacts[0]) <= bound:
                singles += [_on_test(fit(training, backend, shake)) for shake in SHAKEN]
                exacts += [_on_test(fit(doubled, "reference", shake)) for shake in SHAKEN]
                bound = max(bound, _by_chance(singles, exacts, CHANCE / len(seeds)))
                notes.append(
                    f"with start values changed by {SHAKE / U:.0f} roundings, {_listed(singles[1:])} dB, "
                    f"in float64 {_listed(exacts[1:])}"
                )
            drifts.append((abs(fmean(singles) - fmean(exacts)), bound))
        error, bound = max(drifts, key=lambda pair: math.inf if math.isnan(pair[0]) else pair[0] / pair[1])
        at, limit = (case.area, case.name, name, "-", backend), replace(case.bound, forward=bound)
        yield Cell(*at, error, float("nan"), bad, ms, limit, "; ".join(notes))


def _by_chance(a: Sequence[float], b: Sequence[float], p: float) -> float:
    """Return the difference of the means of two samples that chance exceeds with probability p (Student's t)."""
    return Spread(variance(a) / len(a) + variance(b) / len(b), len(a) + len(b) - 2).half_width(1 - p)


def _on_test(trainer: Trainer) -> float:
    return trainer.psnr(trainer.scene.test)


def _listed(values: Sequence[float]) -> str:
    return ", ".join(f"{value:.4f}" for value in values)


def fit(training: Training, backend: str, shaken_by: int | None = None) -> Trainer:
    """Train to the last step, in the floating-point type of the scene's images.

    `shaken_by` is the seed of a change of all start values by at most SHAKE.

    Raises:
        DivergedError: a loss or gradient was not finite; the message names the parameter.
        InputError: the training refused the data.
    """
    config, scene = training.config, training.scene
    config.raster.backend, config.train.curve_points, config.device = backend, 1, device_of(backend)
    model = build(config)
    model.initialise(scene.points, scene.extent, generator(config.seed))
    model.to(config.device, scene.train[0].image.dtype)
    if shaken_by is not None:
        shake(model, shaken_by)
    scene = scene.to(config.device)
    trainer = Trainer(model, scene, scene.train, config)
    with contextlib.redirect_stderr(io.StringIO()):  # one progress bar is enough
        try:
            trainer.run(lambda _: None, training.model)
        except DivergedError as error:
            raise DivergedError(f"{error}; {explain(model)}") from None
    return trainer


@torch.no_grad()
def shake(model: GaussianModel, seed: int) -> None:
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

    def views(views: Sequence[View]) -> list[View]:
        return [replace(view, camera=float64_camera(view.camera), pixels=view.image.double()) for view in views]

    points = scene.points and Points(scene.points.means, scene.points.colors)
    return replace(scene, train=views(scene.train), val=views(scene.val), test=views(scene.test), points=points)
