"""Load the model of a finished or interrupted run from its folder, and the scene on which it was trained."""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta
from omegaconf import OmegaConf

from gsbench.config import Config
from gsbench.errors import InputError, one_line
from gsbench.models import GaussianModel
from gsbench.models.registry import is_registered
from gsbench.reading import parse
from gsbench.run.settings import EMBEDDED, PACKAGE, check_values
from gsbench.run.setup import build_with_placeholders, check_scene_names, load_scene
from gsbench.scenes import Scene
from gsbench.scenes.scene import Placement
from gsbench.schedule import Schedule
from gsbench.train import checkpoint

LARGEST_EXTENT = 1e18  # world units: squares stay finite in single precision
Side = Annotated[int, Meta(ge=1, le=1 << 16)]  # pixels
THREE = Meta(min_length=3, max_length=3)


@dataclass(frozen=True)
class SceneDescription:
    """The properties of a scene that rendering needs: name, extent, background, time, image size, up."""

    name: str
    fingerprint: str  # Scene.fingerprint of the data that the model was trained on
    extent: Annotated[float, Meta(gt=0, lt=LARGEST_EXTENT)]  # world units
    background: Annotated[list[Annotated[float, Meta(ge=0, le=1)]], THREE]  # RGB
    has_time: bool
    width: Side  # of the first training view, pixels
    height: Side
    up: Annotated[list[float], THREE]  # Scene.up, a unit vector
    center: Annotated[list[Annotated[float, Meta(ge=-LARGEST_EXTENT, le=LARGEST_EXTENT)]], THREE]  # of Scene.placement
    unit: Annotated[float, Meta(ge=1 / LARGEST_EXTENT, le=LARGEST_EXTENT)]  # of Scene.placement

    @classmethod
    def of(cls, scene: Scene) -> "SceneDescription":
        """Return the description of a loaded scene."""
        camera = scene.train[0].camera
        return cls(
            name=scene.name,
            fingerprint=scene.fingerprint,
            extent=scene.extent,
            background=list(scene.background),
            has_time=scene.has_time,
            width=camera.width,
            height=camera.height,
            up=list(scene.up),
            center=list(scene.placement.center),
            unit=scene.placement.unit,
        )

    @property
    def placement(self) -> Placement:
        """Return where the scene lies in the user's coordinates."""
        x, y, z = self.center
        return Placement((x, y, z), self.unit)


@dataclass(frozen=True)
class LoadedRun:
    """A trained model that can be rendered, with the settings and the scene description of its training."""

    model: GaussianModel
    config: Config
    scene: SceneDescription
    step: int  # finished steps; fewer than config.train.iterations if the run was interrupted
    folder: Path

    @property
    def near(self) -> float:
        """The near plane of its cameras, world units."""
        return self.scene.placement.near_to_standard(self.config.data.near)


def load_run(folder: str | Path, device: str = "cpu", backend: str = "auto") -> LoadedRun:
    """Load the model, the settings and a description of the scene from the folder of a run.

    Only the checkpoint is read. It is not trusted: no code in it is executed, and its settings and tensors are checked.

    Args:
        folder: the folder of the run, such as results/mini/suzanne/7dgs/seed0.
        device: the device on which to render.
        backend: the backend with which to render: auto, reference, cpu or cuda. It may differ from that of the
            training.

    Raises:
        InputError: the folder has no checkpoint, or the checkpoint is damaged or does not match its settings.

    Example:
        First run `python -m gsbench +exp=mini model=3dgs scene=moving-matte train.iterations=20`.

        >>> import torch
        >>> from gsbench import CameraTime, load_run
        >>> run = load_run("results/mini/moving-matte/3dgs,iterations=20/seed0")
        >>> run.scene.name, run.step, run.config.seed
        ('moving-matte', 20, 0)
        >>> gaussians = run.model.slice(CameraTime.at(torch.tensor([0.0, -4.0, 0.0]), 0.5))
        >>> gaussians.means.shape == (len(run.model), 3)
        True
    """
    path = Path(folder) / checkpoint.FILE_NAME
    if Path(folder).is_file():
        raise InputError(f"{folder}: expected the folder of a run, got a file: name the folder of a {path.name}")
    if not path.exists():
        raise InputError(
            f"{folder}: expected the folder of a run with a {checkpoint.FILE_NAME}, found none: "
            f"run it again, or name its folder, results/EXPERIMENT/SCENE/MODEL/seedK",
            docs="runs.md#the-folder-of-a-run",
        )
    saved = checkpoint.read(path, device)
    config = typed_config(saved.config, path)
    config.device, config.raster.backend = device, backend
    scene = parse(SceneDescription, saved.scene, f"{path}: scene")
    if abs(math.hypot(*scene.up) - 1) > 1e-6:
        raise InputError(f"{path}: scene: expected a unit vector up, got {scene.up!r:.80}")
    model = build_with_placeholders(config, scene.extent).to(device)  # `load_state` replaces the placeholders
    try:
        model.load_state(saved.state["model"])
        step = checkpoint.whole_number("step", saved.state["step"], config.train.iterations)
    except (InputError, MemoryError):
        raise
    except Exception as error:  # parts of an untrusted file may have any type
        raise InputError(f"{path}: expected a training's state, it lacks {one_line(error)!s:.200}") from None
    schedule = Schedule(config.train, config.model.sh_degree, config.agr, model.warm_up)
    model.set_active(schedule.active(max(0, step - 1)))
    return LoadedRun(model.requires_grad_(False), config, scene, step, Path(folder))


def scene_of(run: LoadedRun, data_root: str | None = None) -> Scene:
    """Load the scene on which a run was trained, from `data_root` or from the folder in its settings.

    Raises:
        InputError: the data do not exist, are invalid, or differ from the data of the training.
    """
    root = data_root or trusted_root(run.config.data.root, run.folder)
    config = replace(run.config, data=replace(run.config.data, root=root))
    try:
        scene = load_scene(config)
    except InputError as error:
        raise InputError(f"{error}; name the folder of the data by --data-root") from None
    if scene.fingerprint != run.scene.fingerprint:
        raise InputError(
            f"{run.scene.name} in {config.data.root}: expected the data of the training, found others: "
            f"name the right folder by --data-root"
        )
    if scene.placement != run.scene.placement:
        raise InputError(
            f"{run.folder}: expected a run trained at {scene.placement}, where this gsbench places "
            f"{run.scene.name}, got one trained at {run.scene.placement}: train it again"
        )
    return scene


def trusted_root(root: str, where: Path) -> str:
    """Return `root`, the data folder in a checkpoint, if it is safe to use.

    Raises:
        InputError: `root` names a Python package other than gsbench's; finding its files would import untrusted code.
    """
    if root.startswith(PACKAGE) and root != EMBEDDED:
        raise InputError(
            f"{where}: expected data in a folder or in {EMBEDDED}, its checkpoint names {root!r:.80}, "
            f"which would be imported: if you trust it, name it by --data-root"
        )
    return root


def typed_config(plain: dict[str, Any], path: Path) -> Config:
    """Convert the settings in a checkpoint from plain values to a `Config`.

    A checkpoint is not trusted, so the Python module that it names for its model is not imported here; the user must
    import it.

    Raises:
        InputError: the settings are invalid, or a name leads out of the data folder.
    """
    try:
        typed = OmegaConf.merge(OmegaConf.structured(Config), OmegaConf.create(_without_interpolations(plain)))
        config: Config = OmegaConf.to_object(typed)  # type: ignore[assignment]
    except Exception as error:  # OmegaConf raises many types of exceptions
        raise InputError(f"{path}: expected the config of a run: {one_line(error)[:200]}") from None
    try:
        check_values(config)
        check_scene_names(config)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    module, config.model.module = config.model.module, None
    if module is not None and not is_registered(config.model.name):
        raise InputError(
            f"{path}: expected a model that is known, got '{config.model.name}' of the module "
            f"{module!a:.80}, which a checkpoint cannot import: do it by --model-module, or `import` it "
            f"before load_run",
            docs="adding_a_model.md",
        )
    return config


def _without_interpolations(value: Any) -> Any:
    """Return plain values; raise ValueError if a text has `${`, as in ${oc.env:NAME}, which would be resolved."""
    if isinstance(value, str) and "${" in value:
        raise ValueError(f"expected resolved values, got {value!r:.80}")
    members = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, member in members:
        _without_interpolations(key)
        _without_interpolations(member)
    return value
