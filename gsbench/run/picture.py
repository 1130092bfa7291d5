"""Draw the Gaussians of a finished run in colours for their dependence on time, direction and AGR (a network)."""

from pathlib import Path

import torch

from gsbench.effects.picture import draw
from gsbench.errors import InputError
from gsbench.measure.images import Pixels
from gsbench.run.checks import evaluated_views
from gsbench.run.load import load_run, scene_of


def draw_run(folder: Path, camera: int, time: float | None, data_root: str | None = None) -> Pixels:
    """Draw the Gaussians of a run in colours that show if they depend on time, direction and AGR (a network).

    Returns uint8 [H', W', 3] RGB.

    Args:
        folder: the folder of the run, with its checkpoint.
        camera: the index of the evaluated view whose camera is used.
        time: the time in [0, 1]; None for the time of this view.
        data_root: the folder of the data set; None for the folder in the run's settings.

    Raises:
        InputError: the run, the data or the view does not exist, or the time is not in [0, 1].
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
