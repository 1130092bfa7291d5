"""Check the settings, the data set, the device and the folder of a run before the first training step."""

import dataclasses
import importlib.resources
import itertools
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch

from gsbench.config import Config, LearningRate
from gsbench.config_roles import facts, flat
from gsbench.errors import InputError, did_you_mean, one_line
from gsbench.kernels.backends import resolve
from gsbench.measure import perceptual
from gsbench.measure.atomic import write_atomically
from gsbench.measure.record import run_path
from gsbench.models import GaussianModel
from gsbench.run.grammar import typed
from gsbench.run.identity import hash_of
from gsbench.scenes import Scene, View
from gsbench.scenes.gaussian_ply import TrainedGaussians, read_trained, share_seen
from gsbench.train.hooks import hook_types
from gsbench.train.losses import WINDOW

BACKGROUNDS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}
PACKAGE = "pkg://"  # in front of the module whose files data.root names
LEAST_GAUSSIANS = 4  # the fewest Gaussians to start from: initial scales come from three neighbours
ENOUGH_SEEN = 0.5  # share of Gaussians to start from that a camera sees; below it a line says so


def check_config(config: Config) -> None:
    """Raise InputError if a setting is invalid, or if this machine lacks the device, backend or LPIPS weights."""
    check_values(config)
    check_device(config.device)
    resolve(config.raster.backend, torch.device(config.device).type)
    for backbone, file in lpips_weights(config).items():
        perceptual.load(backbone, file, config.device)


def check_values(config: Config) -> None:
    """Raise InputError if a setting is invalid on every machine, for instance out of its range."""
    check_keys(config, Config, "")
    for dotted, value in flat(dataclasses.asdict(config)):
        facts(dotted).check(dotted, value)
    _check_steps(config)
    for hook in hook_types():
        hook.check(config)
    _check_coarse(config.train.coarse or [])
    for name, rate in config.model.lr.items():
        _check_rate(f"model.lr.{name}", rate)


def trained_start(config: Config) -> TrainedGaussians | None:
    """Read the trained Gaussians from which a training starts; return None if the training starts from points.

    Raises:
        InputError: the file is not a PLY file of Gaussians, holds fewer than four, or does not have the SHA-256 in the
            settings.
    """
    if config.init.ply is None:
        if config.init.ply_sha256 is not None:
            raise InputError("init.ply_sha256: expected it beside init.ply, got no file: add +init.ply=FILE")
        return None
    path = Path(config.init.ply).expanduser()
    trained = read_trained(path)
    if len(trained) < LEAST_GAUSSIANS:
        raise InputError(f"{path}: expected at least {LEAST_GAUSSIANS} Gaussians, found {len(trained)}")
    found = hash_of(config.init.ply)
    if found != config.init.ply_sha256:
        raise InputError(f"init.ply={config.init.ply}: expected the SHA-256 {config.init.ply_sha256!s:.70}, found "
                         f"{found}: another file, or one that has just changed")  # fmt: skip
    return trained


def check_start(trained: TrainedGaussians, scene: Scene) -> None:
    """Print the share of trained Gaussians that the training cameras see if it is below ENOUGH_SEEN.

    Raises:
        InputError: the cameras see none of them, so that a training would move none.
    """
    cameras = [view.camera.to("cpu") for view in scene.train]
    share = share_seen(trained, cameras, ENOUGH_SEEN)
    if share == 0:
        raise InputError(f"init.ply: expected Gaussians of {scene.name}, no training camera sees one of the "
                         f"{len(trained)}: is the file of another scene, or in other coordinates or units?",
                         docs="viewing.md#start-from-a-ply")  # fmt: skip
    if share < ENOUGH_SEEN:
        print(f"{scene.name}: the training cameras see {share:.0%} of the Gaussians of init.ply: is it of this scene?",
              file=sys.stderr)  # fmt: skip


def lpips_weights(config: Config) -> dict[str, Path]:
    """Return the weight files of LPIPS networks in the settings, by network ("alex", "vgg")."""
    given = {"alex": config.protocol.lpips_alex, "vgg": config.protocol.lpips_vgg}
    return {backbone: Path(file).expanduser() for backbone, file in given.items() if file}


def check_keys(value: Any, kind: Any, place: str) -> None:
    """Raise InputError if the settings have an unknown key, which Hydra's `+key=` adds without an error."""
    if isinstance(value, dict):
        for name, one in value.items():
            check_keys(one, type(one), f"{place}.{name}")
    if not dataclasses.is_dataclass(kind):
        return
    known = {one.name for one in dataclasses.fields(kind)}
    for name, one in vars(value).items():
        dotted = f"{place}.{name}".lstrip(".")
        if name not in known:
            raise InputError(f"config key '{dotted}' is not known. {did_you_mean(name, known)}")
        check_keys(one, type(one), dotted)


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


def scene_folder(config: Config) -> Path:
    """Return the folder of the scene, found under `data.root` by the scene's name or by its name in the published data.

    Raises:
        InputError: there is no such folder, and the message lists the names that were tried; or a name leads out of
            `data.root`.
    """
    data, scene = config.data, config.scene
    check_scene_names(config)
    names = [scene.name, *([scene.released_as] if scene.released_as else [])]
    folders = [data_root(data.root) / name for name in names]
    for folder in folders:
        if folder.is_dir():
            return folder
    for root in _roots_nearby(data_root(data.root), names):
        raise InputError(f"data.root={data.root}: expected the folder that holds {' or '.join(map(repr, names))}: "
                         f"type {typed('data.root', str(root), several=False)}",
                         docs="data.md#what-is-read")  # fmt: skip
    published = f"; {data.dataset} is published at: {data.published}" if data.published else ""
    raise InputError(
        f"data.root={data.root}: expected a folder {' or '.join(map(repr, names))} with a scene, such "
        f"as transforms_{{train,val,test}}.json and the images they name, looked for {' and '.join(map(str, folders))}"
        f"{published}",
        docs="data.md#what-is-read",
    )


def _roots_nearby(root: Path, names: Sequence[str]) -> Iterator[Path]:
    """Yield folders that hold a scene, if `root` is one or two folders above such a folder, or is the scene's own."""
    if root.is_dir() and root.absolute().name in names:
        yield root.absolute().parent
    for name in names:
        for pattern in (f"*/{name}", f"*/*/{name}"):
            yield from (path.parents[name.count("/")] for path in sorted(root.glob(pattern)) if path.is_dir())


def check_scene_names(config: Config) -> None:
    """Raise InputError unless the scene's name, and every folder in its published name, is a name of a folder."""
    for name in (config.scene.name, *(config.scene.released_as or config.scene.name).split("/")):
        run_path(Path(), config.experiment, name, config.model.name, config.seed)


def data_root(root: str) -> Path:
    """Return the folder of a data set, given as a path or as `pkg://module` for data inside a Python package.

    Raises:
        InputError: the module does not exist, or the path is invalid.
    """
    if "\0" in root:
        raise InputError(f"data.root: expected a path, got {root!r:.200}")
    if not root.startswith(PACKAGE):
        return Path(root).expanduser()
    try:
        return Path(str(importlib.resources.files(root.removeprefix(PACKAGE))))
    except (ImportError, ValueError, TypeError) as error:
        raise InputError(f"data.root: expected pkg://MODULE of an installed package, got {root!r}: {error}") from None


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
