"""The metric `psnr_float32`: which views it is of, and that a model without it loses no run."""

from dataclasses import replace

import pytest
import torch

from gsbench import kernels
from gsbench.models import Query
from gsbench.models.sliced import Gaussians3D
from gsbench.run.rounding import VIEWS, psnr_float32
from gsbench.run.setup import build
from gsbench.stability import frame
from gsbench.stability.training_cases import compose, moving_square
from gsbench.train.loop import Trainer
from gsbench.train.seeding import generator

pytestmark = pytest.mark.skipif(not kernels.available(), reason="the kernels are not built")


def trainer(*overrides: str) -> Trainer:
    """A trainer at its step 0, evaluated on eight views."""
    config = compose("7dgs", 100, *overrides)
    made, square = build(config), moving_square()
    assert square.points is not None
    made.initialise(square.points, square.extent, generator(config.seed))
    return Trainer(made, replace(square, val=[], test=square.train[:8]), square.train[:8], config)


def test_it_is_the_largest_change_of_three_spaced_views() -> None:
    """Catches a mean or a sum instead of the largest change, other views, and a bound instead of a change."""
    one = trainer("raster.backend=cpu")
    found, why = psnr_float32(one)
    assert not why
    shots = [frame.Shot(view.name, view.camera, view.time, view.image) for view in (one.views[i] for i in (0, 2, 5))]
    assert len(shots) == VIEWS
    views = frame.measure(one.model, shots, one.scene.background, "").views
    assert found == max(abs(view.psnr_change or 0.0) for view in views) > 0


def test_a_run_without_the_cpu_kernels_says_why_it_has_none() -> None:
    """Catches a backend whose images are compared with those of another one."""
    found, why = psnr_float32(trainer("raster.backend=reference"))
    assert found is None
    assert "needs raster.backend=cpu" in why


@pytest.mark.parametrize("kind", [RuntimeError, TypeError])
def test_a_model_of_float32_alone_loses_no_run(kind: type[Exception], monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches an error of a user's model in float64 that ends a trained run."""
    one = trainer("raster.backend=cpu")
    own = type(one.model).slice

    def single(self: object, query: Query) -> Gaussians3D:
        if query.center.dtype == torch.float64:
            raise kind("expected scalar type Float but found Double")
        return own(self, query)  # type: ignore[arg-type]

    monkeypatch.setattr(type(one.model), "slice", single)
    found, why = psnr_float32(one)
    assert found is None
    assert why == "the model has no image in float64: expected scalar type Float but found Double"


def test_equal_images_have_no_change() -> None:
    """Catches an infinity, or no number at all, where an image equals its view, whose PSNR is capped."""
    one = trainer("raster.backend=cpu")
    with torch.no_grad():
        one.views = [replace(view, pixels=one.render(view)) for view in one.views]
    found, why = psnr_float32(one)
    assert (found, why) == (0.0, "")
