"""Refuse a faulty config, data set or device before the first training step."""

import importlib.resources
from collections.abc import Iterable
from pathlib import Path

import torch

from gsbench.backends import resolve
from gsbench.config import Config
from gsbench.errors import InputError, did_you_mean, one_line
from gsbench.models import GaussianModel
from gsbench.scenes import Scene, View
from gsbench.train.optim import OPTIMIZERS

BACKGROUNDS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}
SPLITS = ("test", "val")


def check_config(config: Config) -> None:
    """Raise InputError for a value of the config that no run can have on this machine."""
    _check_choice("data.background", config.data.background, BACKGROUNDS)
    _check_choice("scene.eval_split", config.scene.eval_split, SPLITS)
    _check_choice("optim", config.optim, OPTIMIZERS)
    train = config.train
    counts = {"iterations": train.iterations, "recipe_iterations": train.recipe_iterations,
              "batch_size": train.batch_size, "densify.every": train.densify.every}  # fmt: skip
    for key, count in counts.items():
        if count < 1:
            raise InputError(f"train.{key}: expected at least 1, got {count}")
    check_device(config.device)
    resolve(config.raster.backend, torch.device(config.device).type)


def _check_choice(key: str, value: str, known: Iterable[str]) -> None:
    if value not in known:
        raise InputError(f"{key} '{value}' is not known. {did_you_mean(value, known)}")


def check_device(name: str) -> None:
    """Raise InputError unless `name` is a device that torch can use here."""
    kind = name.partition(":")[0]
    if kind not in ("cpu", "cuda"):
        raise InputError(f"device '{name}' is not known. {did_you_mean(kind, ['cpu', 'cuda'])}")
    try:
        torch.zeros(1, device=name)
    except (RuntimeError, AssertionError) as error:
        raise InputError(f"device '{name}' cannot be used here ({one_line(error)}); use device=cpu") from None


def scene_folder(config: Config) -> Path:
    """Find the folder of the config's scene.

    Raises:
        InputError: there is none inside data.root.
    """
    data, name = config.data, config.scene.name
    root = data_root(data.root)
    folder = root / name
    if root.resolve() not in folder.resolve().parents:
        raise InputError(f"scene.name: expected the name of a folder in data.root, got '{name}'")
    if not folder.is_dir():
        published = f"; {data.dataset} is published at: {data.published}" if data.published else ""
        raise InputError(
            f"data.root={data.root}: expected a folder '{name}' with transforms_{{train,val,test}}.json and the "
            f"images they name, looked for {folder}{published}"
        )
    return folder


def data_root(root: str) -> Path:
    """Return the folder that data.root names: a path, or pkg://module for data inside a package."""
    if not root.startswith("pkg://"):
        return Path(root).expanduser()
    return Path(str(importlib.resources.files(root.removeprefix("pkg://"))))


def check_times(model: GaussianModel, scene: Scene, name: str) -> None:
    """Raise InputError where the model `name` observes time and the scene has no times."""
    if "time" in model.observes and not scene.has_time:
        raise InputError(f"{name}: expected a scene with times, {scene.name} has none: use 3dgs or 6dgs")


def evaluated_views(scene: Scene, split: str) -> list[View]:
    """Return the views that a run is measured on; raises InputError if the split has none."""
    views = scene.val if split == "val" else scene.test
    if not views:
        raise InputError(f"{scene.name}: expected views in the split '{split}', there are none")
    return views
