"""Check that this machine, the folder of a run and its scene can do what its settings ask, before the first step."""

from pathlib import Path

import torch

from gsbench.config import Config
from gsbench.errors import InputError, did_you_mean, one_line
from gsbench.kernels.backends import resolve
from gsbench.measure import perceptual
from gsbench.measure.atomic import write_atomically
from gsbench.models import GaussianModel
from gsbench.run.settings import lpips_weights
from gsbench.scenes import Scene, View
from gsbench.train.hooks import hook_types
from gsbench.train.losses import WINDOW


def check_machine(config: Config) -> None:
    """Raise InputError if this machine lacks the device, the backend or the LPIPS weights of the settings."""
    check_device(config.device)
    resolve(config.raster.backend, torch.device(config.device).type)
    for backbone, file in lpips_weights(config).items():
        perceptual.load(backbone, file, config.device)


def check_folder(folder: Path) -> None:
    """Create the folder of a run if needed; raise InputError if files cannot be written there."""
    probe = folder / ".probe"
    try:
        write_atomically(probe, b"")
        probe.unlink()
    except OSError as error:
        raise InputError(f"results: expected a folder that can be written, got {folder}: {error.strerror}") from None


def check_device(name: str) -> None:
    """Raise InputError unless `name` is a device that torch can use on this machine."""
    kind = name.partition(":")[0]
    if kind not in ("cpu", "cuda") or name.startswith("cpu:"):
        raise InputError(f"device '{name}' is not known. {did_you_mean(kind, ['cpu', 'cuda'])}")
    try:
        torch.zeros(1, device=name)
    except (RuntimeError, AssertionError) as error:
        raise InputError(f"device '{name}' cannot be used here ({one_line(error)}); use device=cpu") from None


def check_scene(model: GaussianModel, scene: Scene, config: Config) -> None:
    """Raise InputError if the scene cannot train the model.

    Reasons are a model with time for a scene without time, cameras that are all at one place, images that are too
    small, and training hooks that need views of val.
    """
    if ("time" in model.observes or config.agr) and not scene.has_time:
        what = "agr=true" if config.agr else config.model.name
        raise InputError(
            f"{what}: expected a scene with times, {scene.name} has none: use 3dgs or 6dgs, agr=false", docs="models.md"
        )
    if not scene.extent > 0:
        raise InputError(f"{scene.name}: expected training cameras at different places, all are at one: sizes and "
                         f"rates are relative to the cameras' radius, which is 0")  # fmt: skip
    factor = max((pair[0] for pair in config.train.coarse or []), default=1)
    side = min(min(view.camera.width, view.camera.height) for view in scene.train)
    if side // factor < WINDOW:
        key = f"train.coarse, after the factor {factor}" if factor > 1 else f"scene.downscale={config.scene.downscale}"
        raise InputError(f"{key}: expected images of at least {WINDOW} pixels, the loss's window, got {side // factor}")
    for hook in hook_types():
        hook.check_scene(scene, config)


def evaluated_views(scene: Scene, split: str) -> list[View]:
    """Return the views of the evaluated split ("test" or "val").

    Raises:
        InputError: the split has no views.
    """
    views = scene.val if split == "val" else scene.test
    if not views:
        raise InputError(f"{scene.name}: expected views in the split '{split}', there are none")
    return views
