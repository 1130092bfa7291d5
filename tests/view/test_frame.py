"""A frame of the viewer: what is switched is one client's, colours and costs are right, two models share an image."""

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from models.small import lively

from gsbench.config import Config
from gsbench.effects import picture
from gsbench.effects.gate import most_cost
from gsbench.kernels.backends import AUTO, REFERENCE, Backend
from gsbench.kernels.library import Library
from gsbench.measure.images import to_bytes
from gsbench.models import Query
from gsbench.models.effect_sets import DIRECTION, NAMES, TIME, EffectSets
from gsbench.models.render import rasterize_slice, render
from gsbench.run.load import LoadedRun, SceneDescription
from gsbench.scenes import Camera
from gsbench.schedule import ActiveComponents
from gsbench.view import paths
from gsbench.view.__main__ import main
from gsbench.view.client import camera_at
from gsbench.view.frame import CLASS, COST, Frame, FrameCost, FrameRenderer, FrameRequest, beside, wiped
from gsbench.view.resolution import LEAST_PIXELS, MOST_PIXELS, MOVING_MS, Resolution
from gsbench.view.stages import RASTER, SLICE, STAGES

SIZE = 40


def renderer(backend: Backend = AUTO, effect_sets: EffectSets | None = None) -> FrameRenderer:
    """Of 7DGS with AGR, in the midst of a training."""
    model = lively("7dgs_agr", count=80, backend=backend).float()
    model.set_active(ActiveComponents(3, True, True))
    model.effect_sets = effect_sets
    scene = SceneDescription("small", "0", 4.0, [0.0, 0.0, 0.0], True, SIZE, SIZE)
    return FrameRenderer(
        LoadedRun(model.requires_grad_(False), Config(), scene, 1, Path("7dgs/seed0")), "7dgs", most_cost(model)
    )


def of_every_effect_set() -> EffectSets:
    """Of 80 Gaussians, 16 of each effect set."""
    frozen = torch.zeros(80, dtype=torch.uint8)
    frozen[32:48], frozen[48:64] = TIME, DIRECTION
    return EffectSets(16, 64, torch.full((80,), 3, dtype=torch.int32), frozen)


@pytest.fixture(scope="module")
def one() -> FrameRenderer:
    return renderer()


def seen_from(azimuth: float, one: FrameRenderer) -> Camera:
    return paths.around(one.run, azimuth, 0.3)


def test_a_frame_is_the_models_image(one: FrameRenderer) -> None:
    """Catches a viewer that shows another picture than the one that is measured, and times of zero."""
    camera = seen_from(0.5, one)
    frame = one.render(camera, FrameRequest(0.4))
    assert (frame.image == to_bytes(render(one.run.model, camera, 0.4, torch.zeros(3)).cpu().numpy())).all()
    assert frame.image.max() > 30
    assert frame.ms(SLICE) > 0
    assert frame.ms(RASTER) > 0


def test_a_frozen_direction_slices_from_there_and_draws_from_here(one: FrameRenderer) -> None:
    """Catches a frozen slice that is also drawn from its old place, or that is not frozen."""
    here, there = seen_from(0.5, one), seen_from(2.0, one)
    frozen = one.render(here, FrameRequest(0.4, there.center)).image
    gaussians = one.run.model.slice(Query.at(there.center, 0.4))
    expected = to_bytes(rasterize_slice(gaussians, here, torch.zeros(3), AUTO).image[0].cpu().numpy())
    assert (frozen == expected).all()
    assert (frozen != one.render(here, FrameRequest(0.4)).image).any()


def test_agr_is_switched_for_one_frame(one: FrameRenderer) -> None:
    """Catches a client that switches AGR off for all others, or on where the training had not yet."""
    camera = seen_from(0.5, one)
    on, off, again = (one.render(camera, FrameRequest(0.4, agr=agr)).image for agr in (True, False, True))
    assert (on != off).any()
    assert (on == again).all()
    early = renderer()
    early.trained_active = replace(early.trained_active, refine=False)
    assert (early.render(camera, FrameRequest(0.4)).image == off).all()


def test_harmonics_are_cut_for_one_frame(one: FrameRenderer) -> None:
    """Catches colours that still change with the direction at degree 0, and a cut that the next frame still has."""
    camera = seen_from(0.5, one)
    images = [one.render(camera, FrameRequest(0.4, sh_degree=degree)).image for degree in (0, 1, 3)]
    assert (one.render(camera, FrameRequest(0.4)).image == images[2]).all()
    flat = lively("7dgs_agr", count=80).float()
    flat.splats["shN"].data.zero_()
    assert (to_bytes(render(flat.requires_grad_(False), camera, 0.4, torch.zeros(3)).cpu().numpy()) == images[0]).all()
    assert len({image.tobytes() for image in images}) == 3
    early = renderer()
    early.trained_active = replace(early.trained_active, sh_degree=1)
    assert (early.render(camera, FrameRequest(0.4)).image == images[1]).all()


@pytest.mark.parametrize("effect_sets", [None, of_every_effect_set()], ids=["without effect sets", "with effect sets"])
def test_colours_are_those_of_the_picture_of_effect_sets(effect_sets: EffectSets | None) -> None:
    """Catches a viewer whose colours mean something else than in effect_sets.png, or stand on another background."""
    made = renderer(effect_sets=effect_sets)
    camera = seen_from(0.5, made)
    panels = picture.draw(made.run.model, camera, 0.4, torch.zeros(3))[picture.LINE :]
    factor = -(-picture.LEAST_WIDTH // SIZE)
    step = factor * SIZE + picture.GAP
    for i, colours in enumerate(("image", CLASS, COST)):
        panel = panels[: factor * SIZE : factor, i * step :][:, : factor * SIZE : factor]
        assert (made.render(camera, FrameRequest(0.4, colours=colours)).image == panel).all()
    assert made.counts == made.run.model.count_by_effects()
    assert all(made.counts[name] == 16 for name in NAMES) == (effect_sets is not None)


@pytest.mark.parametrize(
    ("kernel", "stage"),
    [
        ("refine", "AGR"),
        ("slice_triangular", "conditioning"),
        ("show_colors", "colours"),
        ("project", "projection"),
        ("count_tiles", "binning"),
        ("fill_tiles", "binning"),
        ("blend", "blending"),
    ],
)
def test_a_kernels_time_is_its_stages(
    one: FrameRenderer, kernel: str, stage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches time that counts for another stage, or for none."""
    run, slow = Library._run, 0.02

    def run_slowly(library: Library, name: str, *values: object) -> None:
        if name == kernel:
            time.sleep(slow)
        run(library, name, *values)

    monkeypatch.setattr(Library, "_run", run_slowly)
    (cost,) = one.render(seen_from(0.5, one), FrameRequest(0.4)).costs
    assert tuple(cost.ms) == (*STAGES[SLICE], *STAGES[RASTER])
    assert max(cost.ms, key=lambda name: cost.ms[name]) == stage
    assert cost.ms[stage] >= 1000 * slow


def test_what_torch_computes_alone_is_not_divided() -> None:
    """Catches stages of zero milliseconds, and time that is not counted, without kernels."""
    made = renderer(REFERENCE)
    (cost,) = made.render(seen_from(0.5, made), FrameRequest(0.4)).costs
    assert list(cost.ms) == [SLICE, RASTER]
    assert cost.of(SLICE) == cost.ms[SLICE] > 0
    assert cost.of(RASTER) == cost.ms[RASTER] > 0
    (without_agr,) = renderer().render(seen_from(0.5, made), FrameRequest(0.4, agr=False)).costs
    assert "AGR" not in without_agr.ms


def test_two_models_share_an_image() -> None:
    """Catches swapped sides, an edge at the wrong place and costs that are not added."""
    ms = {"AGR": 0.25, "conditioning": 0.75, "blending": 2.0}
    left, right = (Frame(np.full((4, 8, 3), value, np.uint8), (FrameCost(str(value), ms),)) for value in (10, 20))
    both = beside(left, right)
    assert both.image.shape == (4, 16, 3)
    assert (both.image[:, :7] == 10).all()
    assert (both.image[:, 8:] == 20).all()
    assert (both.ms(SLICE), both.ms(RASTER)) == (2, 4)
    assert [cost.name for cost in both.costs] == ["10", "20"]
    part = wiped(left, right, 2).image
    assert (part[:, :2] == 10).all()
    assert (part[:, 3:] == 20).all()
    assert (wiped(left, right, 0).image == 20).all()
    assert (wiped(left, right, 8).image == 10).all()


def test_resolution_falls_while_the_camera_moves() -> None:
    """Catches a large window that stutters, a frame at rest that stays coarse, and a size of zero."""
    resolution = Resolution()
    for _ in range(3):  # 1 us a pixel and 10 ms a slice: 30,000 pixels
        width, height = resolution.size(1000, 500, limited=True)
        resolution.took(width * height, 10.0, width * height / 1000)
    assert width * height == pytest.approx(1000 * (MOVING_MS - 10), rel=0.02)
    assert width / height == pytest.approx(2, rel=0.02)
    assert resolution.size(1000, 500, limited=False) == (1000, 500)
    width, height = resolution.size(8000, 4000, limited=False)
    assert width * height == pytest.approx(MOST_PIXELS, rel=0.01)
    resolution.took(100, 500.0, 900.0)
    width, height = resolution.size(1000, 500, limited=True)
    assert width * height == pytest.approx(LEAST_PIXELS, rel=0.02)
    assert min(resolution.size(1, 3000, limited=True)) >= 1


def test_a_browsers_camera_is_ours(one: FrameRenderer) -> None:
    """Catches a pose that is inverted, mirrored or with the horizontal field of view."""
    camera = seen_from(0.7, one)
    flip = camera.viewmat[:3, :3].T.double()
    w = float((1 + flip.trace()).sqrt()) / 2
    x, y, z = (float(flip[i, j] - flip[j, i]) / (4 * w) for i, j in ((2, 1), (0, 2), (1, 0)))
    vertical = 2 * np.arctan(SIZE / 2 / float(camera.K[1, 1]))
    again = camera_at(camera.center.double().numpy(), np.array([w, x, y, z]), vertical, SIZE, SIZE)
    torch.testing.assert_close(again.viewmat, camera.viewmat, atol=1e-5, rtol=0)
    torch.testing.assert_close(again.K, camera.K)


def test_a_folder_without_a_checkpoint_is_told_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Catches a stack trace, and a server that serves nothing."""
    assert main([str(tmp_path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"gsbench.view: {tmp_path}: expected the folder of a run")
    assert main([str(tmp_path), "--port", "0"]) == 2
    assert "--port" in capsys.readouterr().err
