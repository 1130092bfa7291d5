"""Define short trainings of tiny scenes, with settings or data that drive parameters to extreme values."""

import math
from dataclasses import dataclass, replace

import hydra
import torch
from hydra.core.global_hydra import GlobalHydra
from omegaconf import OmegaConf
from torch import Generator, Tensor

from gsbench.config import CONF, Config, register_schema
from gsbench.run.setup import load_scene
from gsbench.scenes.points import random_points
from gsbench.scenes.scene import Camera, Points, Scene, View
from gsbench.stability.cases import case
from gsbench.train.seeding import generator

MODELS = ("3dgs", "4dgs", "6dgs", "7dgs")
SIZE = 16  # pixels a side
VIEWS = 12
POINTS = 80
STEPS = 150
LONG_STEPS = 2_000
DRIFT_STEPS, LONG_DRIFT_STEPS, DRIFT_POINTS = 150, 300, 1_000
DRIFTING = ("4dgs", "7dgs", "7dgs_noagr")  # the models whose drift the audit measures; `--long` measures all


@dataclass
class Training:
    """A training of the stability audit: its model, settings and scene."""

    model: str
    config: Config
    scene: Scene
    refused: bool = False  # it must be refused before the first step


def compose(model: str, steps: int, *overrides: str) -> Config:
    """Return the settings of a short training with the experiment `+exp=mini`, without loading its scene."""
    register_schema()
    names = ["+exp=mini", "scene=moving-matte", f"model={model}", f"train.iterations={steps}",
             "train.densify.every=25", *overrides]  # fmt: skip
    if GlobalHydra.instance().is_initialized():
        composed = hydra.compose("config", names)
    else:
        with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
            composed = hydra.compose("config", names)
    config: Config = OmegaConf.to_object(composed)  # type: ignore[assignment]
    return config


def moving_square(views: int = VIEWS, dtype: torch.dtype = torch.float32) -> Scene:
    """Make a scene in which a bright square on black moves with time, seen by cameras on a circle."""
    made = []
    for i in range(views):
        moment, angle = i / max(1, views - 1), 2 * math.pi * i / views
        image = torch.zeros(SIZE, SIZE, 3, dtype=dtype)
        left = 3 + round(5 * moment)
        image[5:11, left : left + 5] = torch.tensor([1.0, 0.9, 0.7], dtype=dtype)
        made.append(View(f"train/{i}", camera_on_circle(angle, dtype), moment, image))
    g = torch.Generator().manual_seed(0)
    points = Points(torch.rand(POINTS, 3, generator=g) * 1.6 - 0.8, torch.rand(POINTS, 3, generator=g))
    return Scene("moving-square", made, [], made, (0.0, 0.0, 0.0), 4.4, points, "made here")


def camera_on_circle(angle: float, dtype: torch.dtype) -> Camera:
    """Make a camera four units from the origin that looks at the origin."""
    c, s = math.cos(angle), math.sin(angle)
    viewmat = torch.eye(4, dtype=dtype)
    viewmat[:3, :3] = torch.tensor([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
    viewmat[2, 3] = 4.0
    focal = SIZE * 1.4
    K = torch.tensor([[focal, 0.0, SIZE / 2], [0.0, focal, SIZE / 2], [0.0, 0.0, 1.0]], dtype=dtype)
    return Camera(viewmat, K, SIZE, SIZE)


def faster(config: Config, factor: float) -> Config:
    """Multiply all learning rates in the settings by `factor`."""
    for rate in config.model.lr.values():
        rate.start *= factor
        rate.end = rate.end if rate.end is None else rate.end * factor
    return config


@case("training", *MODELS, forward=0.0, gradient=math.nan)
def learning_rates_times_30(g: Generator, severity: float, model: str, steps: int = STEPS) -> Training:  # noqa: ARG001
    """Multiply all learning rates by 30, so that parameters reach the ends of their ranges."""
    return Training(model, faster(compose(model, steps), 30**severity), moving_square())


@case("training", *MODELS, forward=0.0, gradient=math.nan)
def one_frame(g: Generator, severity: float, model: str) -> Training:  # noqa: ARG001
    """Train on a single image, which determines neither depth, motion nor view dependence; the scene extent is zero."""
    scene = moving_square()
    views = scene.train[: max(1, round(VIEWS * (1 - severity)))]
    return Training(model, compose(model, STEPS), replace(scene, train=views, extent=4.4 * (1 - severity)))


@case("training", *MODELS, forward=0.0, gradient=math.nan)
def all_images_equal(g: Generator, severity: float, model: str) -> Training:  # noqa: ARG001
    """Train on black images: opacities decrease, and all Gaussians may be pruned."""
    scene = moving_square()
    views = [replace(view, pixels=view.image * (1 - severity)) for view in scene.train]
    return Training(model, compose(model, STEPS), replace(scene, train=views))


@case("training", *MODELS, forward=0.0, gradient=math.nan)
def seen_by_no_view(g: Generator, severity: float, model: str) -> Training:  # noqa: ARG001
    """Put half of the Gaussians outside all views: their gradients are 0, and Adam divides them by sqrt(0) + eps."""
    scene = moving_square()
    assert scene.points is not None
    means: Tensor = scene.points.means.clone()
    means[::2, 1] += 100 * severity
    return Training(model, compose(model, STEPS), replace(scene, points=Points(means, scene.points.colors)))


@case("training", "7dgs", forward=0.0, gradient=math.nan)
def reset_into_refinement(g: Generator, severity: float, model: str) -> Training:  # noqa: ARG001
    """Reset opacities just before AGR (neural refinement) starts, with 100 times the usual learning rate of AGR."""
    config = compose(model, 2 * STEPS, "train.recipe_iterations=300", "train.densify.start=20",
                     "train.densify.reset_every=100", "train.densify.stop=500",
                     "train.refine_from=100", "train.batch_size=1")  # fmt: skip
    config.model.lr["refinement"].start *= 100**severity
    return Training(model, config, moving_square())


@case("training", "6dgs", "7dgs", forward=0.0, gradient=math.nan)
def lambda_switched_on(g: Generator, severity: float, model: str) -> Training:  # noqa: ARG001
    """Start to train lambda halfway at 1000 times the usual rate, so that lambda goes to 0 or infinity.

    Lambda is the coefficient in the exponent by which opacity decreases with the distance in time or direction.
    """
    config = compose(model, STEPS, "train.lambda_from=15000")
    config.model.lr["lambda"].start = 1e-3 * 1000**severity
    return Training(model, config, moving_square())


@case("training", "3dgs", forward=0.0, gradient=math.nan)
def poisoned_photograph(g: Generator, severity: float, model: str) -> Training:  # noqa: ARG001
    """Make one pixel of a training image NaN: training must refuse the data before the first step."""
    scene = moving_square()
    scene.train[3].image[2, 5, 1] = math.nan
    return Training(model, compose(model, STEPS), scene, refused=True)


@case("drift", *DRIFTING, "3dgs", "6dgs", "7dgs_nodir", "dgs", "ndgs", "dbs", "ubs", "freetime", forward=0.02,
      gradient=math.nan)  # fmt: skip
def single_against_double(
    g: Generator, severity: float, model: str, run_seed: int = 0, steps: int = DRIFT_STEPS,  # noqa: ARG001
) -> Training:  # fmt: skip
    """Train 150 steps of the embedded scene suzanne at 40 x 40 pixels in float32 and in float64, and compare PSNR.

    Rounding may decide which Gaussians are split. The error is the difference in dB. `--long` trains 300 steps.
    """
    config = compose(model, steps, "scene=suzanne", "scene.downscale=4", f"seed={run_seed}", "train.batch_size=1",
                     f"train.densify.every={steps // 3}")  # fmt: skip
    points = random_points(DRIFT_POINTS, 1.0, generator(run_seed))
    return Training(model, config, replace(load_scene(config), points=points))
