"""Gaussians drawn by effect set: each in its colour, in the legend, at its cost; of a run, by the command line."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from tiny_run import gsbench, overrides, write_moving_square

from gsbench.gates import picture
from gsbench.gates.gate import COLORING, COSTS, REFINING, SLICING, cost_of, most_cost
from gsbench.gates.messages import EFFECT_SETS
from gsbench.measure import record
from gsbench.measure.images import Pixels
from gsbench.models import GaussianModel, build
from gsbench.models.effect_sets import NAMES, EffectSets
from gsbench.models.gaussian_batch import Gaussians3D
from gsbench.models.simplifications import STATIC
from gsbench.report.render.palette import SETS, THEMES
from gsbench.report.sections import on_demand
from gsbench.run.load import load_run, scene_of
from gsbench.scenes import Camera, Points
from gsbench.schedule import ActiveComponents

CAMERA = Camera(torch.eye(4), torch.tensor([[50.0, 0, 50], [0, 50, 10], [0, 0, 1]]), 100, 20)
CENTRES = (10, 30, 50, 70, 90)  # pixels of five Gaussians, four standard deviations of which are between two
ENLARGED = 3
OPTIONS = {"7dgs": {"lambda_t": 0.5, "lambda_d": 0.3}, "3dgs": {}}


def five(name: str = "7dgs", *, agr: bool = True, effect_sets: EffectSets | None = None) -> GaussianModel:
    """A model of five opaque grey Gaussians in a row, whatever is asked of it."""
    model = build(name, agr=agr, **OPTIONS[name])
    means = torch.tensor([[(x - 50) / 10, 0.0, 5.0] for x in CENTRES])
    model.initialise(Points(means, torch.full((5, 3), 0.5)), 1.0, torch.Generator().manual_seed(0))
    model.set_active(ActiveComponents(3, agr, True))
    model.effect_sets = effect_sets
    batch = Gaussians3D(means, 0.35 * torch.eye(3).expand(5, 3, 3), torch.full((5,), 0.999), torch.full((5, 3), 0.5))
    model.slice = lambda _: batch
    return model


def one_of_each() -> GaussianModel:
    """Gaussians of each effect set, in the order of NAMES, with harmonics of degrees 3, 3, 2, 1, 0."""
    return five(effect_sets=EffectSets(1, 3, torch.tensor([3, 3, 2, 1, 0], dtype=torch.int32)))


def panel(image: Pixels, number: int) -> list[list[int]]:
    """The colours of one panel at the five centres."""
    row = picture.LINE + ENLARGED * 10
    return [image[row, number * (ENLARGED * 100 + picture.GAP) + ENLARGED * x].tolist() for x in CENTRES]


def test_each_class_has_its_colour():
    """Catches rows taken for those of another effect set, swapped red and blue, panels in another order, and a file of
    many megabytes for a scene of full size."""
    model = one_of_each()
    image = picture.draw(model, CAMERA, 0.5, torch.zeros(3))
    assert picture.kinds_of(model).tolist() == [0, 1, 1, 2, 2]
    drawn = 255 * picture.effect_set_colors(model)
    assert drawn.round(decimals=3).tolist() == [list(picture.COLOURS[NAMES[kind]]) for kind in picture.kinds_of(model)]
    assert dict(zip(NAMES, torch.bincount(picture.kinds_of(model)).tolist(), strict=True)) == model.count_by_effects()
    assert np.abs(np.array(panel(image, 0)) - 127.5).max() < 3
    colours = [picture.COLOURS[NAMES[kind]] for kind in picture.kinds_of(model)]
    assert np.abs(np.array(panel(image, 1)) - colours).max() < 6
    corner = image[picture.LINE, ENLARGED * 100 + picture.GAP]
    assert corner.tolist() == [255, 255, 255], "the effect sets stand on white, whatever the background is"
    wide = picture.draw(model, Camera(CAMERA.viewmat, CAMERA.K, 2000, 500), 0.5, torch.zeros(3))
    assert wide.shape[:2] == (160 + 2 * picture.LINE, 3 * picture.MOST_WIDTH + 2 * picture.GAP)


def test_the_legend_counts(monkeypatch):
    """Catches a count beside the wrong name, a swatch of another colour than its Gaussians, and one of none."""
    written = []
    monkeypatch.setattr(cv2, "putText", lambda *arguments: written.append(arguments[1]))
    model = five(effect_sets=EffectSets(0, 4, torch.zeros(5, dtype=torch.int32)))
    image = picture.draw(model, CAMERA, 0.5, torch.ones(3))
    counts = {"conditioned": 4, "static": 1}
    assert written[3:] == [f"{EFFECT_SETS[name]}: {number}" for name, number in counts.items()]
    assert written[1] == "5 Gaussians by effect set"
    legend = image[picture.LINE + ENLARGED * 20 :]
    for i, name in enumerate(counts):
        left = i % 3 * (ENLARGED * 100 + picture.GAP)
        assert legend[i // 3 * picture.LINE + 10, left + 10].tolist() == list(picture.COLOURS[name])


def test_what_a_pixel_pays_for():
    """Catches costs of other Gaussians than those that are seen, without colours, or on a scale of their own."""
    model = one_of_each()
    geometry = [REFINING + SLICING, SLICING, SLICING, COSTS[STATIC], COSTS[STATIC]]
    expected = [g + COLORING[degree] for g, degree in zip(geometry, (3, 3, 2, 1, 0), strict=True)]
    assert cost_of(model).tolist() == pytest.approx(expected)
    assert most_cost(model) == REFINING + SLICING + COLORING[3]
    shown = panel(picture.draw(model, CAMERA, 0.5, torch.ones(3)), 2)
    bright = [sum(colour) for colour in shown]
    assert bright == sorted(bright, reverse=True)
    assert shown[0][0] > 230, "a Gaussian that pays for everything is bright yellow"
    assert shown[0][1] > 230


@pytest.mark.parametrize(
    ("name", "agr", "kind"), [("7dgs", True, "refined"), ("7dgs", False, "conditioned"), ("3dgs", False, "static")]
)
def test_a_model_without_classes_is_of_one_class(name, agr, kind):
    """Catches a model that was not gated and cannot be drawn, or is drawn as what it is not."""
    model = five(name, agr=agr)
    assert picture.kinds_of(model).tolist() == [NAMES.index(kind)] * 5
    shown = panel(picture.draw(model, CAMERA, 0.5, torch.zeros(3)), 1)
    assert np.abs(np.array(shown) - picture.COLOURS[kind]).max() < 6


def test_the_page_has_the_same_colours():
    """Catches an effect set that has one colour in the picture and another in the figure above it."""
    page = dict(zip(on_demand.SETS, (THEMES[variable][0] for variable in SETS), strict=False))
    for name, (r, g, b) in picture.COLOURS.items():
        assert f"#{r:02x}{g:02x}{b:02x}" == page[name]
    assert tuple(picture.COLOURS) == tuple(EFFECT_SETS) == NAMES


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run that is gated at its end."""
    root = tmp_path_factory.mktemp("run")
    data = write_moving_square(root / "data")
    done = gsbench(*overrides(data, root / "r", "model=7dgs", "effects.gate=end", "effects.budget_db=0.01"))
    assert done.returncode == 0, done.stderr
    (path,) = record.find(root)
    return path.parent


def test_a_gated_run_leaves_a_picture(folder):
    """Catches a run that leaves no picture, or not where the report looks, and one of another view than the first."""
    assert record.read(folder / record.FILE_NAME).on_demand
    run = load_run(folder)
    first, black = scene_of(run).test[0], torch.zeros(3)
    drawn = picture.draw(run.model, first.camera, first.time, black, run.config.raster.antialias)
    assert np.array_equal(cv2.cvtColor(cv2.imread(str(folder / "effect_sets.png")), cv2.COLOR_BGR2RGB), drawn)
