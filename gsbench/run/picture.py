"""Draw the Gaussians of a finished run by effect set, as one of the evaluated cameras sees them."""

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
        folder: of the run; its checkpoint is read.
        camera: the number of the evaluated view.
        time: in [0, 1]; None: that of the view.
        data_root: the folder of the data set; by default that of the run.

    Raises:
        InputError: there is no run, no data or no such view, or the time is none.
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
