"""The viewer's bound on the error of float32: it is that of the stability command, and refused where it has none."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from test_frame import renderer, seen_from

from gsbench import kernels
from gsbench.errors import InputError
from gsbench.kernels.backends import AUTO, REFERENCE
from gsbench.measure.images import rounding_image
from gsbench.models import Query
from gsbench.models.twins import exact_model, render_twins
from gsbench.view.frame import FrameRequest
from gsbench.view.rounding import check_exactness

needs_kernels = pytest.mark.skipif(not kernels.available(), reason="the kernels are not built")


@needs_kernels
def test_the_bound_is_that_of_the_stability_command() -> None:
    """Catches a bound of another view, time or unit, and a summary of other pixels."""
    one = renderer()
    near = seen_from(0.5, one)
    K = near.K * torch.tensor([0.3, 0.3, 1.0])  # a wide angle: some pixels show nothing
    camera = replace(near, K=K)
    found = one.rounding(camera, FrameRequest(0.4))
    exact = render_twins(one.run.model, exact_model(one.run.model), camera, 0.4, torch.zeros(3), False).exact
    bound = 255 * exact.bound
    assert (found.image == rounding_image(bound.numpy())).all()
    assert 0.2 < float((exact.culprit >= 0).double().mean()) < 0.95
    assert found.image.max() > 50
    assert found.largest == pytest.approx(float(bound.max()))
    assert found.median == pytest.approx(float(bound[exact.culprit >= 0].median()))
    assert found.undecided == pytest.approx(float(exact.undecided.double().mean()))
    assert found.seconds > 0


@needs_kernels
@pytest.mark.parametrize("change", ["frozen direction", "without AGR", "harmonics"])
def test_both_precisions_have_the_settings_of_the_browser(change: str) -> None:
    """Catches a setting that only one of the two slices has, whose difference would count as rounding."""
    one = renderer()
    camera, there = seen_from(0.5, one), seen_from(2.0, one)
    request = {"frozen direction": FrameRequest(0.4, there.center), "without AGR": FrameRequest(0.4, agr=False),
               "harmonics": FrameRequest(0.4, sh_degree=0)}[change]  # fmt: skip
    plain, changed = one.rounding(camera, FrameRequest(0.4)), one.rounding(camera, request)
    assert (plain.image != changed.image).any()
    assert changed.median < 0.1
    assert (one.rounding(camera, FrameRequest(0.4)).image == plain.image).all()


def test_without_the_cpu_kernels_there_is_no_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a bound of images that another backend renders, and a stack trace that ends the browser's thread."""
    one = renderer(REFERENCE)
    with pytest.raises(InputError, match="CPU kernels"):
        one.rounding(seen_from(0.5, one), FrameRequest(0.4))
    on_gpu: Any = SimpleNamespace(splats={"means": torch.empty(2, 3, device="meta")}, backend=AUTO)
    with pytest.raises(InputError, match="--device cpu"):
        check_exactness(on_gpu)
    monkeypatch.setattr(kernels, "available", lambda: False)
    with pytest.raises(InputError, match="reinstall"):
        check_exactness(renderer().run.model)


@needs_kernels
def test_a_model_that_does_not_compute_in_float64_has_no_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a user's model whose error ends the browser's thread, or that answers in float32 and counts as exact."""
    one, query = renderer(), Query.at(torch.zeros(3), 0.4)
    camera, own = seen_from(0.5, one), one.run.model.slice(query)
    slice_of = type(one.run.model).slice

    def fails(model: Any, query: Query) -> Any:
        if model is one.run.model:
            return slice_of(model, query)
        raise TypeError("only float32")

    monkeypatch.setattr(type(one.run.model), "slice", fails)
    with pytest.raises(InputError, match="does not compute in float64: only float32"):
        one.rounding(camera, FrameRequest(0.4))
    monkeypatch.setattr(type(one.run.model), "slice", lambda *_: own)
    with pytest.raises(InputError, match="expected Gaussians of torch"):
        one.rounding(camera, FrameRequest(0.4))
