"""Build the model and load the scene that a config names."""

from typing import Any

import torch

from gsbench import models, scenes
from gsbench.config import Config
from gsbench.errors import InputError
from gsbench.kernels.backends import resolve
from gsbench.models import GaussianModel
from gsbench.run.checks import BACKGROUNDS, check_gates, scene_folder
from gsbench.scenes import Scene


def build(config: Config) -> GaussianModel:
    """Build the model of a config, without Gaussians yet.

    Raises:
        InputError: as `models.build`, an option has a key of its own, or effects cannot be removed from this model
            although the config asks for it.
    """
    own: dict[str, Any] = {
        "module": config.model.module,
        "agr": config.agr,
        "agr_octaves": config.model.agr_octaves,
        "sh_degree": config.model.sh_degree,
        "backend": resolve(config.raster.backend, torch.device(config.device).type),
    }
    for name in config.model.options:
        if name in (*own, "name"):
            key = {"agr": "agr", "backend": "raster.backend"}.get(name, f"model.{name}")
            raise InputError(f"model.options: expected no '{name}', which has a key of its own: set {key}")
    model = models.build(config.model.name, **own, **config.model.options)
    check_gates(model, config)
    return model


def load_scene(config: Config) -> Scene:
    """Load the scene of a config onto its device.

    Raises:
        InputError: the data set is missing or has a fault.
    """
    background = BACKGROUNDS[config.data.background]
    chosen = config.scene
    scene = scenes.load(scene_folder(config), downscale=chosen.downscale, background=background, frames=chosen.frames)
    return scene.to(config.device)
