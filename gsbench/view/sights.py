"""Find the views that a run was trained and measured on, where its data are still there."""

from dataclasses import replace

from gsbench.errors import InputError
from gsbench.run.load import LoadedRun
from gsbench.run.setup import load_scene
from gsbench.scenes import Scene, View


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


def find_view(scene: Scene, name: str) -> View:
    """Return the view of that name, such as test/r_003, or the training view of that number, from 0.

    Raises:
        InputError: there is none.
    """
    if name.isascii() and name.isdigit() and int(name) < len(scene.train):
        return scene.train[int(name)]
    for view in (*scene.train, *scene.val, *scene.test):
        if view.name == name:
            return view
    raise InputError(f"--camera: expected a training view's number, 0 to {len(scene.train) - 1}, or a view's name such "
                     f"as {scene.train[0].name}, got '{name}'")  # fmt: skip
