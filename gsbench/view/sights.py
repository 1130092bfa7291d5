"""Find a view of a scene by its number or its name."""

from gsbench.errors import InputError
from gsbench.scenes import Scene, View


def find_view(scene: Scene, name: str) -> View:
    """Return the view of that name, such as test/r_003, or the training view of that number, from 0.

    Raises:
        InputError: there is none.
    """
    if name.isascii() and name.isdigit() and len(name) < 10 and int(name) < len(scene.train):
        return scene.train[int(name)]
    for view in (*scene.train, *scene.val, *scene.test):
        if view.name == name:
            return view
    raise InputError(f"--camera: expected a training view's number, 0 to {len(scene.train) - 1}, or a view's name such "
                     f"as {scene.train[0].name}, got '{name[:100]}'")  # fmt: skip
