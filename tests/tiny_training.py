"""A training small enough for a test: its settings, and a scene of a few pixels in memory."""

import copy
import functools
import math
from dataclasses import replace

import hydra
import torch
from hydra.core.global_hydra import GlobalHydra
from omegaconf import OmegaConf

from gsbench.config import CONF, Config, register_schema
from gsbench.run.setup import build
from gsbench.scenes.scene import Camera, Points, Scene, View
from gsbench.train.batches import generator
from gsbench.train.loop import Trainer

SIZE = 16  # pixels a side
VIEWS = 12
POINTS = 80
NARROW = {
    "deformable": ["model.options.width=24"],
    "hexplane": [
        f"model.options.{option}" for option in ("resolution=8", "time_resolution=6", "channels=4", "width=8")
    ],
    "scgs": [f"model.options.{option}" for option in ("nodes=16", "width=24", "depth=2")],
}  # networks small enough for a test


def compose(model: str, steps: int, *overrides: str) -> Config:
    """The settings of a short training with the experiment `+exp=mini`; its scene is not loaded."""
    return copy.deepcopy(_composed(model, steps, *overrides))


@functools.cache
def _composed(model: str, steps: int, *overrides: str) -> Config:
    register_schema()
    names = ["+exp=mini", "scene=moving-matte", f"model={model}", f"train.iterations={steps}"]
    names += ["train.densify.every=25", *NARROW.get(model, []), *overrides]
    if GlobalHydra.instance().is_initialized():
        composed = hydra.compose("config", names)
    else:
        with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
            composed = hydra.compose("config", names)
    config: Config = OmegaConf.to_object(composed)  # type: ignore[assignment]
    return config


def moving_square(views: int = VIEWS, dtype: torch.dtype = torch.float32) -> Scene:
    """A bright square on black that moves with time, seen by cameras on a circle of four units around the origin."""
    train = []
    for i in range(views):
        moment, angle = i / max(1, views - 1), 2 * math.pi * i / views
        image = torch.zeros(SIZE, SIZE, 3, dtype=dtype)
        left = 3 + round(5 * moment)
        image[5:11, left : left + 5] = torch.tensor([1.0, 0.9, 0.7], dtype=dtype)
        c, s = math.cos(angle), math.sin(angle)
        viewmat = torch.eye(4, dtype=dtype)
        viewmat[:3, :3] = torch.tensor([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
        viewmat[2, 3] = 4.0
        focal = SIZE * 1.4
        K = torch.tensor([[focal, 0.0, SIZE / 2], [0.0, focal, SIZE / 2], [0.0, 0.0, 1.0]], dtype=dtype)
        train.append(View(f"train/{i}", Camera(viewmat, K, SIZE, SIZE), moment, image))
    g = torch.Generator().manual_seed(0)
    points = Points(torch.rand(POINTS, 3, generator=g) * 1.6 - 0.8, torch.rand(POINTS, 3, generator=g))
    return Scene("moving-square", train, [], train, (0.0, 0.0, 0.0), 4.4, points, "of tests/tiny_training.py")


def near_and_far() -> Scene:
    """The moving square seen by three cameras that most Gaussians are behind, and by one that sees all."""
    square = moving_square()
    far = square.train[0]
    viewmat = far.camera.viewmat.clone()
    viewmat[2, 3] *= 0.1
    near = replace(far, camera=replace(far.camera, viewmat=viewmat))
    return replace(square, train=[near, near, near, far], val=[far], test=[far])


def trainer(model: str = "7dgs", *overrides: str, scene: Scene | None = None) -> Trainer:
    """A trainer of 100 steps at step 0, of the moving square with three views of val and two of test by default."""
    config = compose(model, 100, *overrides)
    if scene is None:
        square = moving_square()
        scene = replace(square, val=square.train[:3], test=square.train[3:5])
    built = build(config)
    assert scene.points is not None
    built.initialise(scene.points, scene.extent, generator(config.seed))
    scene = scene.to(config.device)
    return Trainer(built.to(config.device), scene, scene.test, config)


def train(trainer: Trainer, until: int | None = None) -> Trainer:
    """Train to the end or until so many steps are finished, save nothing, and return the trainer."""
    trainer.run(lambda _: None, "square", lambda: trainer.step != until)
    return trainer
