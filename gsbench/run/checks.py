"""Check the settings of a run, the device, the folder and the scene, before the first training step."""

import dataclasses
import itertools
from pathlib import Path
from typing import Any

import torch

from gsbench.config import Config, LearningRate
from gsbench.config_roles import facts, flat
from gsbench.errors import InputError, did_you_mean, one_line
from gsbench.kernels.backends import resolve
from gsbench.measure import perceptual
from gsbench.measure.atomic import write_atomically
from gsbench.models import GaussianModel
from gsbench.scenes import Scene, View
from gsbench.train.hooks import hook_types
from gsbench.train.losses import WINDOW


def check_config(config: Config) -> None:
    """Raise InputError if a setting is invalid, or if this machine lacks the device, backend or LPIPS weights."""
    check_values(config)
    check_device(config.device)
    resolve(config.raster.backend, torch.device(config.device).type)
    for backbone, file in lpips_weights(config).items():
        perceptual.load(backbone, file, config.device)


def check_values(config: Config) -> None:
    """Raise InputError if a setting is invalid on every machine, for instance out of its range."""
    _check_keys(config)
    for dotted, value in flat(dataclasses.asdict(config)):
        facts(dotted).check(dotted, value)
    _check_steps(config)
    for hook in hook_types():
        hook.check(config)
    _check_coarse(config.train.coarse or [])
    for name, rate in config.model.lr.items():
        _check_rate(f"model.lr.{name}", rate)


def lpips_weights(config: Config) -> dict[str, Path]:
    """Return the weight files of LPIPS networks in the settings, by network ("alex", "vgg")."""
    files = {"alex": config.protocol.lpips_alex, "vgg": config.protocol.lpips_vgg}
    return {backbone: Path(file).expanduser() for backbone, file in files.items() if file}


def _check_keys(value: Any, place: str = "") -> None:
    """Raise InputError if the settings have an unknown key, which Hydra's `+key=` adds without an error."""
    known = {field.name for field in dataclasses.fields(value)} if dataclasses.is_dataclass(value) else None
    members = value if isinstance(value, dict) else vars(value) if known else {}
    for name, member in members.items():
        dotted = f"{place}.{name}".lstrip(".")
        if known is not None and name not in known:
            raise InputError(f"config key '{dotted}' is not known. {did_you_mean(name, known)}")
        _check_keys(member, dotted)


def _check_steps(config: Config) -> None:
    """Raise InputError if learning rates are to fall after the last step."""
    step, length = config.train.cooldown_from, config.train.recipe_iterations
    if step is not None and step >= length:
        raise InputError(f"train.cooldown_from: expected a step below train.recipe_iterations={length}, the length for "
                         f"which steps are given, got {step}")  # fmt: skip


def _check_rate(key: str, rate: LearningRate) -> None:
    """Raise InputError if a learning rate is negative, or if a log-linear decay starts or ends at zero."""
    if rate.start < 0 or (rate.end is not None and (rate.end <= 0 or rate.start == 0)):
        raise InputError(f"{key}: expected start >= 0, and start > 0 with end > 0 or null, "
                         f"got start {rate.start}, end {rate.end}")  # fmt: skip


def _check_coarse(coarse: list[list[int]]) -> None:
    """Raise InputError unless `coarse` is a valid list of (downscaling factor, last step) pairs.

    An example is [[4, 3000], [2, 15000]]: factors decrease and steps increase.
    """
    are_pairs = all(len(pair) == 2 for pair in coarse)
    factors, steps = ([pair[at] for pair in coarse] if are_pairs else [] for at in (0, 1))
    fall = all(a > b for a, b in itertools.pairwise([*factors, 1]))
    rise = all(a < b for a, b in itertools.pairwise([0, *steps]))
    if not are_pairs or not fall or not rise:
        raise InputError(f"train.coarse: expected pairs (factor above 1, step of the recipe until which images are so "
                         f"much smaller), factors falling and steps rising, such as [[4,3000],[2,15000]], "
                         f"got {coarse}")  # fmt: skip


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
