"""The rows of `python -m benchmarks`, on few Gaussians: nothing is timed here."""

from collections import Counter

import pytest
import torch

from benchmarks import rows, scene
from benchmarks.__main__ import HEADER, line
from benchmarks.stages import MODELS, SUCCESSORS, blended_alphas, recorded, stages
from benchmarks.training import one_view
from gsbench.kernels.headers import ALPHA_MIN
from gsbench.models import CameraTime
from gsbench.models.render import rasterize_slice


def test_no_two_rows_have_one_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches rows that --against would compare with each other's times."""
    monkeypatch.setattr(rows, "model", lambda name, _, **options: scene.model(name, 50, **options))
    monkeypatch.setattr(rows, "gaussians", lambda _: scene.gaussians(50))
    monkeypatch.setitem(rows.SECTIONS, "stages", lambda: stages(50, 32))
    names = Counter((row.section, row.name) for section in rows.SECTIONS.values() for row in section())
    assert len(names) > 100
    assert {name for name, count in names.items() if count > 1} == set()


def test_every_stage_is_timed_once_and_has_a_floor() -> None:
    """Catches a stage that is left out or that cannot be called twice, and a floor that is zero."""
    stage_rows = list(stages(50, 32))
    for row in stage_rows:
        for _ in range(2):
            row.call()
        assert row.name.endswith("whole step") or (row.floor is not None and row.floor[1] > 0), row.name
    both = ("slice", "colours", "project", "blend")
    expected = {f"{stage} {way}" for stage in both for way in ("forward", "backward")}
    expected |= {"check values", "bin", "loss forward + backward", "Adam", "whole step"}
    for name in MODELS:
        agr = {"AGR forward", "AGR backward"} if name == "7dgs" else set()
        names_of = [row.name.removeprefix(f"{name} ") for row in stage_rows if row.name.startswith(f"{name} ")]
        assert sorted(names_of) == sorted(expected | agr)
    for name in SUCCESSORS:
        names_of = [row.name for row in stage_rows if row.name.startswith(f"{name} ")]
        assert names_of == [f"{name} slice forward", f"{name} slice backward"]


def test_a_trained_model_shows_a_part_of_its_rows_in_order() -> None:
    """Catches stages that are timed with every Gaussian visible, or with visible ones far apart."""
    for name in ("4dgs", "7dgs", "dgs", "dbs", "freetime"):
        fitted, view = scene.trained(name, 1600), one_view(32, 32)
        gaussians = fitted.slice(CameraTime.of(view.camera, view.time)).opacities >= ALPHA_MIN
        assert abs(float(gaussians.float().mean()) - scene.VISIBLE) < 0.02
        assert gaussians.unflatten(0, (-1, 16)).any(1).float().mean() < 0.6  # it is 1 in any order


def test_gradients_of_a_stage_are_added_in_place() -> None:
    """Catches a backward row that allocates its gradients, which most views of a batch do not."""
    fitted = scene.model("7dgs", 50)
    call = recorded(fitted, one_view(32, 32))["slice_triangular"]
    gradient = fitted.splats["motion"].grad
    assert gradient is not None
    before = gradient.clone()
    call.backward_again()
    torch.testing.assert_close(gradient, 1.5 * before)


def test_blended_alphas_are_those_of_the_image() -> None:
    """Catches a floor that counts pixels beyond the Gaussian, or Gaussians behind the end of a pixel."""
    view = one_view(32, 24)
    fitted = scene.model("3dgs", 4, sigma=0.3)
    fitted.select(torch.tensor([0]))
    gaussians = fitted.slice(CameraTime.of(view.camera, view.time))
    drawn = rasterize_slice(gaussians, view.camera, torch.zeros(3), fitted.backend).alpha > 0
    assert 0 < drawn.sum() < drawn.numel()
    assert blended_alphas(recorded(fitted, view)["project"]) == drawn.sum()
    stacked = scene.model("3dgs", 20, sigma=30.0)  # each covers the image: 1e-4 of the light is left after some
    stacked.splats["opacities"].data.fill_(2.0)
    full = blended_alphas(recorded(stacked, view)["project"])
    assert 3 * 32 * 24 < full < 6 * 32 * 24


def test_a_row_shows_the_time_of_a_pixel() -> None:
    """Catches numbers below another column's heading."""
    result = {"name": "a", "median": 2.0, "p10": 1.0, "p90": 3.0, "wall": 4.0, "pixels": 1000, "target_ms": 1.0,
              "least_ms": 0.5, "limit": "flops"}  # fmt: skip
    cells = [cell.strip() for cell in line(result).split("|")]
    assert dict(zip([cell.strip() for cell in HEADER.split("|")], cells, strict=True))["ns a pixel"] == "2000.0"
