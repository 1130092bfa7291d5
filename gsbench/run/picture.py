"""Draw the Gaussians of a finished run in the colours of the effects that they keep, seen by an evaluated camera."""

from pathlib import Path

import torch

from gsbench.effects.picture import draw
from gsbench.errors import InputError
from gsbench.measure.images import Pixels
from gsbench.run.checks import evaluated_views
from gsbench.run.load import load_run, scene_of


def draw_run(folder: Path, camera: int, time: float | None, data_root: str | None = None) -> Pixels:
    """Draw `gsbench.effects.picture.draw` of a run: uint8 [H', W', 3] RGB.

    Args:
        folder: the folder of the run, which has its checkpoint.
        camera: the number of the evaluated view whose camera is used.
        time: the time in [0, 1]; None: the time of this view.
        data_root: the folder of the data set; by default the one that the run was trained on.

    Raises:
        InputError: there is no run, no data or no such view, or the time is not in [0, 1].
    """
    if time is not None and not 0 <= time <= 1:
        raise InputError(f"--time: expected 0 to 1, got {time}")
    loaded = load_run(folder)
    scene = scene_of(loaded, data_root)
    views = evaluated_views(scene, loaded.config.scene.eval_split)
    if not 0 <= camera < len(views):
        raise InputError(f"--camera: expected 0 to {len(views) - 1}, the evaluated views of {scene.name}, got {camera}")
    view = views[camera]
    background = torch.tensor(scene.background)
    when = view.time if time is None else time
    return draw(loaded.model, view.camera, when, background, loaded.config.raster.antialias)
