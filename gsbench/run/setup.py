"""Build the model and load the scene that the settings name."""

from typing import Any

import torch

from gsbench import models, scenes
from gsbench.config import Config
from gsbench.errors import InputError
from gsbench.kernels.backends import resolve
from gsbench.models import GaussianModel
from gsbench.run.checks import BACKGROUNDS, scene_folder
from gsbench.scenes import Points, Scene
from gsbench.train.hooks import hook_types
from gsbench.train.seeding import generator


def build(config: Config) -> GaussianModel:
    """Build the model that the settings name, without Gaussians.

    Raises:
        InputError: the model or an option is unknown, or a training hook needs another model.
    """
    options: dict[str, Any] = {
        "module": config.model.module,
        "agr": config.agr,
        "agr_octaves": config.model.agr_octaves,
        "sh_degree": config.model.sh_degree,
        "backend": resolve(config.raster.backend, torch.device(config.device).type),
    }
    for name in config.model.options:
        if name in (*options, "name"):
            key = {"agr": "agr", "backend": "raster.backend"}.get(name, f"model.{name}")
            raise InputError(f"model.options: expected no '{name}', which has a key of its own: set {key}")
    model = models.build(config.model.name, **options, **config.model.options)
    for hook in hook_types():
        hook.check_model(model, config)
    return model


def build_with_placeholders(config: Config, extent: float) -> GaussianModel:
    """Build the model with four placeholder Gaussians, so that it has its parameters before the true ones are known.

    It raises the same errors as `build`.

    Args:
        config: the settings.
        extent: the radius of the scene, world units.
    """
    model, points = build(config), torch.eye(4, 3)
    model.initialise(Points(points, points), extent, generator(config.seed))
    return model


def load_scene(config: Config) -> Scene:
    """Load the scene that the settings name, and move it to the device.

    Raises:
        InputError: the data set does not exist or is invalid.
    """
    background = BACKGROUNDS[config.data.background]
    chosen = config.scene
    scene = scenes.load(
        scene_folder(config),
        downscale=chosen.downscale,
        resize=chosen.resize,
        background=background,
        frames=chosen.frames,
        repair=config.data.repair,
    )
    if chosen.val_every is not None:
        scene = scene.with_val(chosen.val_every)
    return scene.to(config.device)
