"""A frame of the viewer: its settings are its own, costs and the bound on float32 are right, two models share it."""

import time
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from models.small import lively

from gsbench import kernels
from gsbench.config import Config
from gsbench.errors import InputError
from gsbench.gates import picture
from gsbench.gates.gate import most_cost
from gsbench.kernels import raster
from gsbench.kernels.backends import AUTO, REFERENCE, Backend
from gsbench.kernels.library import Library
from gsbench.measure.images import Pixels, rounding_image, to_bytes
from gsbench.models import CameraTime
from gsbench.models.effect_sets import NAMES, EffectSets
from gsbench.models.render import rasterize_slice, render
from gsbench.run.load import LoadedRun, SceneDescription
from gsbench.scenes import Camera
from gsbench.scenes.scene import UP
from gsbench.schedule import ActiveComponents
from gsbench.stability.float32_error import check_exactness, float64_model, render_twice
from gsbench.view import video
from gsbench.view.frame import (
    CLASS,
    COST,
    RASTER,
    SLICE,
    STAGES,
    Frame,
    FrameCost,
    FrameRenderer,
    FrameRequest,
    StageWatch,
    beside,
    wiped,
)

SIZE = 40
BLACK = torch.zeros(3)
NOW = FrameRequest(0.4)
needs_kernels = pytest.mark.skipif(not kernels.available(), reason="the kernels are not built")


def renderer(
    backend: Backend = AUTO, effect_sets: EffectSets | None = None, variant: str = "7dgs_agr"
) -> FrameRenderer:
    """Of 7DGS with AGR or of another model, in the midst of a training."""
    model = lively(variant, count=80, backend=backend).float()
    model.set_active(ActiveComponents(3, model.agr, True))
    model.effect_sets = effect_sets
    scene = SceneDescription("small", "0", 4.0, [0.0, 0.0, 0.0], True, SIZE, SIZE, list(UP), [0.0] * 3, 1.0)
    run = LoadedRun(model.requires_grad_(False), Config(), scene, 1, Path("7dgs/seed0"))
    return FrameRenderer(run, "7dgs", most_cost(model))


@pytest.fixture(scope="module")
def agr() -> FrameRenderer:
    return renderer()


def camera_of(azimuth: float, agr: FrameRenderer) -> Camera:
    return video.around(agr.run, azimuth, 0.3)


def image_of(model: Any, camera: Camera) -> Pixels:
    return to_bytes(render(model, camera, 0.4, BLACK).cpu().numpy())


def test_a_frame_is_the_models_image(agr):
    """Catches a viewer that shows another picture than the one that is measured, and times of zero."""
    camera = camera_of(0.5, agr)
    frame = agr.render(camera, NOW)
    assert (frame.image == image_of(agr.run.model, camera)).all()
    assert frame.image.max() > 30
    assert frame.ms(SLICE) > 0
    assert frame.ms(RASTER) > 0


def test_settings_are_those_of_one_frame(agr):
    """Catches AGR, a degree or a viewpoint without effect, or that the next frame still has, or that training had not.
    A frozen viewpoint slices from there and draws from here."""
    here, there = camera_of(0.5, agr), camera_of(2.0, agr)
    plain = agr.render(here, NOW).image
    gaussians = agr.run.model.slice(CameraTime.at(there.center, 0.4))
    frozen = to_bytes(rasterize_slice(gaussians, here, BLACK, AUTO).image[0].cpu().numpy())
    flat = lively("7dgs_agr", count=80).float().requires_grad_(False)
    flat.splats["shN"].data.zero_()
    changed = {
        "viewpoint": agr.render(here, FrameRequest(0.4, there.center)).image,
        "AGR": agr.render(here, FrameRequest(0.4, agr=False)).image,
        "degree 0": agr.render(here, FrameRequest(0.4, sh_degree=0)).image,
        "degree 1": agr.render(here, FrameRequest(0.4, sh_degree=1)).image,
    }
    assert (changed["viewpoint"] == frozen).all()
    assert (changed["degree 0"] == image_of(flat, here)).all()
    assert len({image.tobytes() for image in (plain, *changed.values())}) == 5
    assert (agr.render(here, NOW).image == plain).all()
    early = renderer()
    for name, trained in (("AGR", {"refine": False}), ("degree 1", {"sh_degree": 1})):
        early.trained_active = replace(agr.trained_active, **trained)
        assert (early.render(here, NOW).image == changed[name]).all()


@pytest.mark.parametrize(
    ("variant", "effect_sets"),
    [("7dgs_agr", None), ("7dgs_agr", EffectSets(16, 32, torch.full((80,), 3, dtype=torch.int32))), ("stg_full", None)],
    ids=["without effect sets", "with effect sets", "decoded"],
)
def test_colours_are_those_of_the_picture_of_effect_sets(variant, effect_sets):
    """Catches colours that mean something else than in effect_sets.png, another background, and a missing decode."""
    gated = renderer(effect_sets=effect_sets, variant=variant)
    camera = camera_of(0.5, gated)
    panels = picture.draw(gated.run.model, camera, 0.4, BLACK)[picture.LINE :]
    factor = -(-picture.LEAST_WIDTH // SIZE)
    step = factor * SIZE + picture.GAP
    for i, colours in enumerate(("image", CLASS, COST)):
        panel = panels[: factor * SIZE : factor, i * step :][:, : factor * SIZE : factor]
        assert (gated.render(camera, FrameRequest(0.4, colours=colours)).image == panel).all()
    assert gated.counts == gated.run.model.count_by_effects()
    assert ([gated.counts[name] for name in NAMES] == [16, 16, 48]) == (effect_sets is not None)


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
def test_a_kernels_time_is_its_stages(agr, kernel, stage, monkeypatch):
    """Catches time that counts for another stage, or for none."""
    run, slow = Library._run, 0.02

    def run_slowly(library: Library, device: torch.device, name: str, *values: object) -> None:
        if name == kernel:
            time.sleep(slow)
        run(library, device, name, *values)

    monkeypatch.setattr(Library, "_run", run_slowly)
    (cost,) = agr.render(camera_of(0.5, agr), NOW).costs
    assert tuple(cost.ms) == (*STAGES[SLICE], *STAGES[RASTER])
    assert max(cost.ms, key=lambda name: cost.ms[name]) == stage
    assert cost.ms[stage] >= 1000 * slow


def test_what_one_call_computes_is_not_divided():
    """Catches a GPU's rasterizer whose time counts for the stage that is noted first, or that runs again."""
    watch, image = StageWatch("cpu"), torch.zeros(3)
    assert watch.record(raster._project, [], (), ([image], {})) == [image]
    watch.end(RASTER)
    assert [*watch.ms] == [RASTER]


def test_what_torch_computes_alone_is_not_divided(agr):
    """Catches stages of zero milliseconds, and time that is not counted, without kernels."""
    (cost,) = renderer(REFERENCE).render(camera_of(0.5, agr), NOW).costs
    assert list(cost.ms) == [SLICE, RASTER]
    assert cost.of(SLICE) == cost.ms[SLICE] > 0
    assert cost.of(RASTER) == cost.ms[RASTER] > 0
    (without_agr,) = agr.render(camera_of(0.5, agr), FrameRequest(0.4, agr=False)).costs
    assert "AGR" not in without_agr.ms


def test_two_models_share_an_image():
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


@needs_kernels
def test_the_bound_is_that_of_the_stability_command(agr):
    """Catches a bound of another view, time or unit, and a summary of other pixels."""
    near = camera_of(0.5, agr)
    camera = replace(near, K=near.K * torch.tensor([0.3, 0.3, 1.0]))  # a wide angle: some pixels show nothing
    start = time.perf_counter()
    error = agr.float32_error(camera, NOW)
    seconds = time.perf_counter() - start
    exact = render_twice(agr.run.model, float64_model(agr.run.model), camera, 0.4, BLACK, False).exact
    bound, covered = 255 * exact.bound, exact.culprit >= 0
    assert (error.image == rounding_image(bound.numpy())).all()
    assert 0.2 < float(covered.double().mean()) < 0.95
    assert error.image.max() > 50
    assert error.largest == pytest.approx(float(bound.max()))
    assert error.median == pytest.approx(float(bound[covered].median()))
    assert error.undecided == pytest.approx(float(exact.undecided.double().mean()))
    assert 0 < error.seconds < seconds


@needs_kernels
def test_both_precisions_have_the_settings_of_the_browser(agr):
    """Catches a setting that only one of the two slices has, whose difference would count as rounding."""
    camera, there = camera_of(0.5, agr), camera_of(2.0, agr)
    plain = agr.float32_error(camera, NOW)
    for settings in ({"center": there.center}, {"agr": False}, {"sh_degree": 0}):
        changed = agr.float32_error(camera, NOW._replace(**settings))
        assert (plain.image != changed.image).any()
        assert changed.median < 0.1
    assert (agr.float32_error(camera, NOW).image == plain.image).all()


def test_a_bound_leaves_the_frame_that_is_rendered_its_settings(agr):
    """Catches a bound in its own thread that switches effects off in the middle of a frame."""
    with ThreadPoolExecutor(1) as pool:
        with agr._lock:  # a frame is being rendered
            before = agr.run.model.active
            bound = pool.submit(agr.float32_error, camera_of(0.5, agr), NOW._replace(sh_degree=0))
            assert not wait([bound], 0.3).done
            assert agr.run.model.active is before
        bound.result()


def test_without_the_cpu_kernels_there_is_no_bound(agr, monkeypatch):
    """Catches a bound of images that another backend renders."""
    with pytest.raises(InputError, match="CPU kernels"):
        renderer(REFERENCE).float32_error(camera_of(0.5, agr), NOW)
    on_gpu: Any = SimpleNamespace(splats={"means": torch.empty(2, 3, device="meta")}, backend=AUTO)
    with pytest.raises(InputError, match="--device cpu"):
        check_exactness(on_gpu)
    with pytest.raises(InputError, match="SpacetimeFeatureModel decodes it"):
        renderer(variant="stg_full").float32_error(camera_of(0.5, agr), NOW)
    monkeypatch.setattr(kernels, "available", lambda: False)
    with pytest.raises(InputError, match="reinstall"):
        check_exactness(agr.run.model)


@needs_kernels
def test_a_model_that_does_not_compute_in_float64_has_no_bound(monkeypatch):
    """Catches a user's model whose error is not an InputError, or that answers in float32 and counts as exact."""
    agr = renderer()
    camera, single = camera_of(0.5, agr), agr.run.model.slice(CameraTime.at(BLACK, 0.4))
    slice_of = type(agr.run.model).slice

    def fails(model: Any, query: CameraTime) -> Any:
        if model is agr.run.model:
            return slice_of(model, query)
        raise TypeError("only float32")

    monkeypatch.setattr(type(agr.run.model), "slice", fails)
    with pytest.raises(InputError, match="does not compute in float64: only float32"):
        agr.float32_error(camera, NOW)
    monkeypatch.setattr(type(agr.run.model), "slice", lambda *_: single)
    with pytest.raises(InputError, match="expected Gaussians of torch"):
        agr.float32_error(camera, NOW)
