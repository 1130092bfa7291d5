"""Measure how exact the float32 images of a run's model or of a PLY are (`python -m gsbench.stability RUN|FILE.ply`).

Each image is rendered again in float64. The audit of hard cases is `make stability`, in a checkout.
"""

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from gsbench.errors import InputError, one_line, refuse_options
from gsbench.models import GaussianModel, build
from gsbench.models.cameras import around
from gsbench.models.registry import import_models
from gsbench.process.ending import end_with
from gsbench.run.load import load_run, scene_of
from gsbench.run.setup import LEAST_GAUSSIANS, check_folder, evaluated_views
from gsbench.scenes.gaussian_ply import read_trained
from gsbench.scenes.ply import SUFFIXES
from gsbench.stability.float32_error import Shot, measure
from gsbench.train.batches import generator

VIEWS = 10  # of an orbit
SIZE = 400  # pixels a side of the images of a PLY
OUT = Path("results/stability")
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


def main(arguments: list[str] | None = None) -> int:
    """Print and draw how exact a model's images are; return the exit code: 0, or 2 if the model cannot be read."""
    parser = argparse.ArgumentParser(prog="python -m gsbench.stability", description=__doc__)
    parser.add_argument("model", type=Path, metavar="RUN_FOLDER|FILE.ply", help="whose images are measured")
    parser.add_argument("--json", action="store_true", help="print all numbers as JSON, and draw no picture")
    parser.add_argument("--data-root", metavar="FOLDER", help="of the run's data set, where it has moved")
    parser.add_argument("--model-module", metavar="MODULE", help="that registers the run's model")
    parser.add_argument("--out", type=Path, help="folder of a PLY's picture (results/stability)")
    options = parser.parse_args(arguments)
    from gsbench.stability import report  # imports matplotlib

    try:
        if options.model.suffix.lower() in SUFFIXES:
            refuse_options(options, ("data_root", "model_module"), "a PLY")
            out = options.out or OUT
            if not options.json:
                check_folder(out, "--out")
            subject = of_ply(options.model, out)
        else:
            refuse_options(options, ("out",), "a run")
            import_models(options.model_module)
            subject = of_run(options.model, options.data_root)
        exactness = measure(subject.model, subject.shots, subject.background, subject.title, subject.antialias)
        if options.json:
            print(report.json_of(exactness))
            return 0
        report.draw(exactness, subject.picture)
    except (InputError, OSError) as error:
        print(f"gsbench.stability: error: {one_line(error)}", file=sys.stderr)
        return 2
    if subject.note:
        print(f"{subject.note}\n")
    print(report.text(exactness))
    print(f"Written: {subject.picture}")
    return 0


def of_run(folder: Path, data_root: str | None = None) -> Subject:
    """Load the model of a run with its evaluated views; without its data set with views of an orbit, no photographs.

    Raises:
        InputError: the folder has no checkpoint, or `data_root`, where the data set has moved, does not have it.
    """
    run, note = load_run(folder), ""
    try:
        shots = [Shot.of(view) for view in evaluated_views(scene_of(run, data_root), run.config.scene.eval_split)]
    except InputError as error:
        if data_root is not None:
            raise
        note = f"No photographs, so {VIEWS} views of an orbit: {error}"
        shots = orbit_shots(run.model, run.scene.extent, run.scene.width, run.scene.height, run.scene.has_time)
    title = "/".join(folder.absolute().parts[-3:])
    return Subject(
        title, run.model, shots, run.scene.background, run.config.raster.antialias, folder / "exactness.png", note
    )


def of_ply(path: Path, out: Path) -> Subject:
    """Load a PLY as a 3DGS model, with views of an orbit around the median of its means; `out` is for its picture.

    Raises:
        InputError: the file is not a PLY of trained Gaussians.
    """
    trained = read_trained(path)
    if len(trained) < LEAST_GAUSSIANS:
        raise InputError(f"{path}: expected at least {LEAST_GAUSSIANS} Gaussians, found {len(trained)}")
    model = build("3dgs")
    model.start_from(trained, 1.0, generator(0))
    middle = trained.means.median(0).values
    distance = DISTANCE * float((trained.means - middle).norm(dim=-1).median())
    note = f"Views: {VIEWS} on an orbit around the median of the means, {distance:.3g} world units away."
    shots = orbit_shots(model, max(distance, 1e-6), SIZE, SIZE, False)
    return Subject(path.name, model, shots, (0.0, 0.0, 0.0), False, out / f"{path.stem}.exactness.png", note)


def orbit_shots(model: GaussianModel, distance: float, width: int, height: int, has_time: bool) -> list[Shot]:
    """Return views on a circle around a model, without photographs; times run from 0 to 1."""
    return [
        Shot(
            f"orbit {i}",
            around(model, distance, width, height, 2 * math.pi * i / VIEWS),
            i / (VIEWS - 1) if has_time else None,
            None,
        )
        for i in range(VIEWS)
    ]


if __name__ == "__main__":
    end_with("gsbench.stability", main)
