"""Load the model of a finished or broken run back from its folder, and the scene that it was trained on."""

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gsbench.config import Config
from gsbench.errors import InputError
from gsbench.measure.schema import parse
from gsbench.models import GaussianModel
from gsbench.models.registry import is_registered
from gsbench.run.setup import build, load_scene
from gsbench.scenes import Scene
from gsbench.scenes.scene import Points
from gsbench.schedule import Schedule
from gsbench.train import checkpoint
from gsbench.train.draws import generator


@dataclass(frozen=True)
class SceneDescription:
    """What is to be known of a scene to render a model of it, without its images."""

    name: str
    fingerprint: str  # Scene.fingerprint of the data that the model was trained on
    extent: float  # world units
    background: list[float]  # RGB in [0, 1]
    has_time: bool
    width: int  # of the first training view, pixels
    height: int

    @classmethod
    def of(cls, scene: Scene) -> "SceneDescription":
        """Describe a loaded scene."""
        camera = scene.train[0].camera
        return cls(scene.name, scene.fingerprint, scene.extent, list(scene.background), scene.has_time,
                   camera.width, camera.height)  # fmt: skip


@dataclass(frozen=True)
class LoadedRun:
    """A trained model, ready to render, with the config and the scene that it was trained by."""

    model: GaussianModel
    config: Config
    scene: SceneDescription
    step: int  # finished steps; below config.train.iterations where the run was broken off
    folder: Path


def load_run(folder: str | Path, device: str = "cpu", backend: str = "auto") -> LoadedRun:
    """Load the model, the config and a description of the scene from the folder of a run.

    Only the checkpoint is read. It is untrusted: nothing in it is executed, and its config and tensors are checked.

    Args:
        folder: of the run, such as results/mini/suzanne/7dgs/seed0.
        device: to render on.
        backend: to render with, whatever the run was trained with: auto, reference, cpu or cuda.

    Raises:
        InputError: the folder has no checkpoint, or the checkpoint is damaged or not of its own config.

    Example:
        The run of `python -m gsbench +exp=mini model=3dgs scene=moving-matte train.iterations=20`.

        >>> import torch
        >>> from gsbench import Query, load_run
        >>> run = load_run("results/mini/moving-matte/3dgs,iterations=20/seed0")
        >>> run.scene.name, run.step, run.config.seed
        ('moving-matte', 20, 0)
        >>> gaussians = run.model.slice(Query.at(torch.tensor([0.0, -4.0, 0.0]), 0.5))
        >>> gaussians.means.shape == (len(run.model), 3)
        True
    """
    path = Path(folder) / checkpoint.FILE_NAME
    if not path.exists():
        raise InputError(f"{folder}: expected the folder of a run with a {checkpoint.FILE_NAME}, found none: "
                         f"run it again, or name its folder, results/EXPERIMENT/SCENE/MODEL/seedK")  # fmt: skip
    found = checkpoint.read(path, device)
    config = typed_config(found.config, path)
    config.device, config.raster.backend = device, backend
    scene = parse(SceneDescription, found.scene, str(path))
    model = build(config)
    points = torch.eye(4, 3)  # as few as there can be; `load_state` replaces them
    model.initialise(Points(points, points), scene.extent, generator(config.seed))
    model.to(device)
    try:
        model.load_state(found.state["model"])
        step = checkpoint.whole_number("step", found.state["step"], config.train.iterations)
    except (KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: expected a training's state, it lacks {error}") from None
    schedule = Schedule(config.train, config.model.sh_degree, config.agr)
    model.set_phase(schedule.phase(max(0, step - 1)))
    return LoadedRun(model.requires_grad_(False), config, scene, step, Path(folder))


def scene_of(run: LoadedRun, data_root: str | None = None) -> Scene:
    """Load the scene that a run was trained on.

    Args:
        run: whose config names the scene.
        data_root: the folder of its data set, where it is no longer the one in the config.

    Raises:
        InputError: the data are gone, have a fault, or are others than those of the training.
    """
    config = replace(run.config, data=replace(run.config.data, root=data_root or run.config.data.root))
    try:
        scene = load_scene(config)
    except InputError as error:
        raise InputError(f"{error}; name the folder of the data by --data-root") from None
    if scene.fingerprint != run.scene.fingerprint:
        raise InputError(f"{run.scene.name} in {config.data.root}: expected the data of the training, found others: "
                         f"name the right folder by --data-root")  # fmt: skip
    return scene


def plain_description(scene: Scene) -> dict[str, Any]:
    """Describe a scene in plain values, as a checkpoint holds it."""
    return asdict(SceneDescription.of(scene))


def typed_config(plain: dict[str, Any], path: Path) -> Config:
    """Type the plain config of a checkpoint; raises InputError where it is not one.

    A checkpoint is untrusted, so that the module it names for its model is never imported: the user does it.
    """
    try:
        typed = OmegaConf.merge(OmegaConf.structured(Config), OmegaConf.create(plain))
        config: Config = OmegaConf.to_object(typed)  # type: ignore[assignment]
    except (OmegaConfBaseException, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path}: expected the config of a run: {str(error).splitlines()[0]}") from None
    module, config.model.module = config.model.module, None
    if module is not None and not is_registered(config.model.name):
        raise InputError(f"{path}: expected a model that is known, got '{config.model.name}' of the module "
                         f"{module!a:.80}, which a checkpoint cannot import: do it by --model-module, or `import` it "
                         f"before load_run")  # fmt: skip
    return config
