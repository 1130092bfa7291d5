"""Load a trained model from a run's folder or from a PLY of 3DGS, with the views in which its images are measured."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from gsbench.errors import InputError
from gsbench.models import GaussianModel, build
from gsbench.models.cameras import around
from gsbench.models.start import start_from
from gsbench.run.checks import evaluated_views
from gsbench.run.load import load_run, scene_of
from gsbench.scenes.trained import MAX_DEGREE, read_trained
from gsbench.schedule import ActiveComponents
from gsbench.stability.frame import Shot
from gsbench.train.seeding import generator

VIEWS = 10  # of an orbit
SIZE = 400  # pixels a side of the images of a PLY
DISTANCE = 3.0  # of an orbit around a PLY, in median distances of its Gaussians from their middle


@dataclass(frozen=True)
class Subject:
    """A trained model, its views, and where the picture of its errors is written."""

    title: str
    model: GaussianModel
    shots: Sequence[Shot]
    background: Sequence[float]
    antialias: bool
    picture: Path
    note: str  # what a reader must know of the views; "" for the evaluated views of a run


def load(path: Path, out: Path, data_root: str | None = None) -> Subject:
    """Load a model with its views.

    Args:
        path: the folder of a run, or a PLY of 3DGS. A run is measured in its evaluated views; without its data set, or
            from a PLY, in views on an orbit, of which there are no photographs.
        out: the folder in which a PLY's picture is written; a run's picture lies in its own folder.
        data_root: the folder of the data set, if it is not the one in the run's settings.

    Raises:
        InputError: the folder has no checkpoint, or the file is not a PLY of trained Gaussians.
    """
    return _of_ply(path, out) if path.suffix.lower() == ".ply" else _of_run(path, data_root)


def _of_run(folder: Path, data_root: str | None) -> Subject:
    run = load_run(folder)
    note = ""
    try:
        scene = scene_of(run, data_root)
        views = evaluated_views(scene, run.config.scene.eval_split)
        shots = [Shot(view.name, view.camera, view.time, view.image) for view in views]
    except InputError as error:
        if data_root is not None:
            raise
        note = f"No photographs, so {VIEWS} views of an orbit: {error}"
        shots = orbit_shots(run.model, run.scene.extent, run.scene.width, run.scene.height, run.scene.has_time)
    title = "/".join(folder.absolute().parts[-3:])
    return Subject(title, run.model, shots, run.scene.background, run.config.raster.antialias,
                   folder / "exactness.png", note)  # fmt: skip


def _of_ply(path: Path, out: Path) -> Subject:
    trained = read_trained(path)
    model = build("3dgs", sh_degree=MAX_DEGREE)
    start_from(model, trained, 1.0, generator(0))
    model.set_active(ActiveComponents(MAX_DEGREE, False, False))
    model.requires_grad_(False)
    middle = trained.means.median(0).values
    extent = DISTANCE * float((trained.means - middle).norm(dim=-1).median())
    note = f"Views: {VIEWS} on an orbit around the median of the means, {extent:.3g} world units away."
    shots = orbit_shots(model, max(extent, 1e-6), SIZE, SIZE, False)
    return Subject(path.name, model, shots, (0.0, 0.0, 0.0), False, out / f"{path.stem}.exactness.png", note)


def orbit_shots(model: GaussianModel, distance: float, width: int, height: int, has_time: bool) -> list[Shot]:
    """Return views on a circle around a model, without photographs; times run from 0 to 1."""
    return [
        Shot(f"orbit {i}", around(model, distance, width, height, 2 * math.pi * i / VIEWS),
             i / (VIEWS - 1) if has_time else None, None)
        for i in range(VIEWS)
    ]  # fmt: skip
