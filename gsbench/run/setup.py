"""Build the model and load the scene that a config names."""

import torch

from gsbench import models, scenes
from gsbench.backends import resolve
from gsbench.config import Config
from gsbench.models import GaussianModel
from gsbench.run.checks import BACKGROUNDS, scene_folder
from gsbench.scenes import Scene


def build(config: Config) -> GaussianModel:
    """Build the model of a config, without Gaussians yet; raises InputError as `models.build` does."""
    return models.build(
        config.model.name,
        module=config.model.module,
        agr=config.agr,
        agr_octaves=config.model.agr_octaves,
        sh_degree=config.model.sh_degree,
        backend=resolve(config.raster.backend, torch.device(config.device).type),
        **config.model.options,
    )


def load_scene(config: Config) -> Scene:
    """Load the scene of a config onto its device.

    Raises:
        InputError: the data set is missing or has a fault.
    """
    background = BACKGROUNDS[config.data.background]
    chosen = config.scene
    scene = scenes.load(scene_folder(config), downscale=chosen.downscale, background=background, frames=chosen.frames)
    return scene.to(config.device)
