"""Build the model and load the scene that settings name, and check that they and this machine can do the run."""

import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch

from gsbench import models, scenes
from gsbench.config import Config
from gsbench.errors import InputError, one_line
from gsbench.kernels.backends import resolve
from gsbench.measure import perceptual
from gsbench.measure.atomic import write_atomically
from gsbench.measure.record import run_path
from gsbench.models import GaussianModel
from gsbench.models.rehearsal import rehearse
from gsbench.run.grammar import typed
from gsbench.run.identity import hash_of
from gsbench.run.settings import check_device_name, data_root, lpips_weights
from gsbench.scenes import Points, Scene, View
from gsbench.scenes.gaussian_ply import TrainedGaussians, read_trained, share_seen
from gsbench.train.batches import generator
from gsbench.train.hooks import hook_types
from gsbench.train.losses import WINDOW

BACKGROUNDS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}
LEAST_GAUSSIANS = 4  # the fewest Gaussians to start from: initial scales come from three neighbours
ENOUGH_SEEN = 0.5  # share of Gaussians to start from that a camera sees; below it a line says so


def build(config: Config) -> GaussianModel:
    """Build the model that the settings name, without Gaussians.

    Raises:
        InputError: the model or an option is unknown, its code has a mistake, or a training hook needs another model.
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
    options |= config.model.options
    rehearse(models.build(config.model.name, **options), config.model.name)
    model = models.build(config.model.name, **options)
    for hook in hook_types():
        hook.check_model(model, config)
    return model


def build_with_placeholders(config: Config, extent: float) -> GaussianModel:
    """Build the model with four placeholder Gaussians, so that it has its parameters before the true ones are known.

    `extent` is the radius of the scene, world units. It raises the same errors as `build`.
    """
    model, points = build(config), torch.eye(4, 3)  # also their colours
    model.initialise(Points(points, points), extent, generator(config.seed))
    return model


def load_scene(config: Config) -> Scene:
    """Load the scene that the settings name, and move it to the device.

    Raises:
        InputError: the data set does not exist or is invalid.
    """
    scene = scenes.load(
        scene_folder(config),
        downscale=config.scene.downscale,
        resize=config.scene.resize,
        background=BACKGROUNDS[config.data.background],
        frames=config.scene.frames,
        repair=config.data.repair,
        leave_out=config.scene.leave_out,
    )
    if config.data.near is not None:
        scene = scene.with_near(config.data.near)
    if config.scene.val_every is not None:
        scene = scene.with_val(config.scene.val_every)
    return scene.to(config.device)


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
    for root in _roots_nearby(data_root(data.root), names):  # the first is named
        raise InputError(
            f"data.root={data.root}: expected the folder that holds {' or '.join(map(repr, names))}: "
            f"type {typed('data.root', str(root), several=False)}",
            docs="data.md#what-is-read",
        )
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
    for name in names:  # which may have folders, such as "scenes/trex"
        for pattern in (f"*/{name}", f"*/*/{name}"):
            yield from (path.parents[name.count("/")] for path in sorted(root.glob(pattern)) if path.is_dir())


def check_scene_names(config: Config) -> None:
    """Raise InputError unless the scene's name, and every folder in its published name, is a name of a folder."""
    for name in (config.scene.name, *(config.scene.released_as or config.scene.name).split("/")):
        run_path(Path(), config.experiment, name, config.model.name, config.seed)


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
    path = Path(os.path.expanduser(config.init.ply))
    trained = read_trained(path)
    if len(trained) < LEAST_GAUSSIANS:
        raise InputError(f"{path}: expected at least {LEAST_GAUSSIANS} Gaussians, found {len(trained)}")
    present = hash_of(config.init.ply)
    if present != config.init.ply_sha256:
        raise InputError(
            f"init.ply={config.init.ply}: expected the SHA-256 {config.init.ply_sha256!s:.70}, got "
            f"{present}: another file, or one that has just changed"
        )
    return trained


def check_start(trained: TrainedGaussians, scene: Scene) -> None:
    """Print the share of trained Gaussians that the training cameras see if it is below ENOUGH_SEEN.

    Raises:
        InputError: the cameras see none of them, so that a training would move none.
    """
    cameras = [view.camera.to("cpu") for view in scene.train]
    share = share_seen(trained, cameras, ENOUGH_SEEN)
    if share == 0:
        raise InputError(
            f"init.ply: expected Gaussians of {scene.name}, no training camera sees one of the "
            f"{len(trained)}: is the file of another scene, in other coordinates or units, or nearer than data.near?",
            docs="viewing.md#start-from-a-ply",
        )
    if share < ENOUGH_SEEN:
        print(
            f"{scene.name}: the training cameras see {share:.0%} of the Gaussians of init.ply: is it of this scene?",
            file=sys.stderr,
        )


def check_machine(config: Config) -> None:
    """Raise InputError if this machine lacks the device or the LPIPS weights of the settings."""
    check_device(config.device)
    for backbone, file in lpips_weights(config).items():
        perceptual.load(backbone, file, config.device)


def check_folder(folder: Path, key: str = "results") -> None:
    """Create the folder of a run if needed; raise InputError, which names `key`, if files cannot be written there."""
    probe = folder / ".probe"
    try:
        write_atomically(probe, b"")
        probe.unlink()
    except OSError as error:
        raise InputError(f"{key}: expected a folder that can be written, got {folder}: {error.strerror}") from None


def check_device(name: str) -> None:
    """Raise InputError unless `name` is a device that torch can use on this machine."""
    check_device_name(name)
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
        raise InputError(
            f"{scene.name}: expected training cameras at different places, all are at one: sizes and "
            f"rates are relative to the cameras' radius, which is 0"
        )
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
