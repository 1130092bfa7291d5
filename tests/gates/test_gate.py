"""What a gate chooses, and what it makes of a model."""

import copy
import math
from dataclasses import replace

import pytest
import torch
from test_sensitivity import slice_of
from torch import Tensor
from worlds import BLACK, MODEL_SIZE, OPTIONS, N, camera, gated, probed, trained_a_little, views_of

from gsbench.gates.gate import apply, choose, gate_within
from gsbench.gates.hook import share_with_direction
from gsbench.gates.sensitivity import probe
from gsbench.kernels.headers import LOG_SIZE_MAX
from gsbench.measure.exact_views import capped
from gsbench.measure.quality import psnr
from gsbench.models import CameraTime, GaussianModel
from gsbench.models.effect_sets import EffectSets
from gsbench.models.gaussian_batch import tensors_of
from gsbench.models.render import render
from gsbench.models.simplifications import simplifications_of


def images(model: GaussianModel) -> list[Tensor]:
    return [render(model, camera(azimuth, 0.3, MODEL_SIZE), azimuth / 6, BLACK) for azimuth in range(5)]


def assert_same_images(first: GaussianModel, second: GaussianModel, atol: float) -> None:
    for a, b in zip(images(first), images(second), strict=True):
        torch.testing.assert_close(a, b, atol=atol, rtol=0)


@pytest.mark.parametrize("name", OPTIONS)
def test_more_budget_buys_more(name):
    """Catches a gate that changes an image though its budget is zero, a price of error with the wrong sign, a sum of
    errors that is not held, and numbers of what is frozen that stay as they were."""
    before, free = gated(name, 0.0)
    assert len(free) <= N
    assert_same_images(before, free, atol=2e-6)
    shares, sensitivity = (0.0, 0.1, 1.0, 10.0), probed(name)[1]
    assert all(choose(sensitivity, before, share).predicted <= share for share in shares)
    sizes = [gated(name, share)[1].stored_bytes() for share in shares]
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[-1] < 0.8 * sizes[0]
    after = gated(name, 1.0)[1]
    for key, used in after.used_entries(after.effect_sets).items():
        unused = after.splats[key].masked_fill(used, after.constant(key))
        assert key == "right_quats" or (unused == after.constant(key)).all(), key  # which are left ones' partners


def test_a_static_gaussian_changes_with_nothing():
    """Catches a Gaussian that still moves with time or direction after both were frozen."""
    model, sensitivity = probed("7dgs")
    here = CameraTime.at(torch.tensor([0.0, 0.0, -4.0]), 0.2)
    later, beside = CameraTime.at(here.center, 0.9), CameraTime.at(torch.tensor([4.0, 0.0, 0.0]), 0.2)
    after = copy.deepcopy(model)
    everything = choose(sensitivity, after, 0.0)
    all_rows = {key: torch.full((N,), key == "static") for key in everything.geometry}
    apply(after, sensitivity.simplifications, replace(everything, geometry=all_rows))
    assert after.count_by_effects()["static"] == len(after) == N
    for other in (later, beside):
        for a, b in zip(after.slice(here)[:3], after.slice(other)[:3], strict=True):
            torch.testing.assert_close(a, b, atol=1e-5, rtol=1e-5)
    assert (after.splats["log_diagonal"][:, [*after.rows["t"], *after.rows["d"]]] == LOG_SIZE_MAX).all()


@pytest.mark.parametrize("name", OPTIONS)
def test_a_gated_model_is_gated_again(name):
    """Catches rows sorted into the wrong effect set: with the effect sets forgotten the images stay the same; a gate
    that undoes or pays again for what an earlier one did; a simplification of a gated model that changes Gaussians
    whose errors the probe does not look at."""
    _, after = gated(name, 3.0)
    rows, effect_sets = after.count_by_effects(), after.effect_sets
    assert sum(rows.values()) == len(after) < N
    assert 0 <= effect_sets.refined <= effect_sets.conditioned <= len(after)
    plain, again = copy.deepcopy(after), copy.deepcopy(after)
    plain.effect_sets = effect_sets._replace(conditioned=len(after))
    assert_same_images(after, plain, atol=1e-5)
    views = views_of(after, 1)[:10]
    sensitivity = probe(after, views, BLACK)
    remaining, _ = apply(again, sensitivity.simplifications, choose(sensitivity, again, 0.0))
    assert again.count_by_effects()["refined"] <= rows["refined"]
    assert len(remaining) <= len(after)
    assert_same_images(after, again, atol=1e-5)
    queries = [CameraTime.of(view.camera, view.time) for view in views]
    live = [after.slice(query) for query in queries]
    for simplification in simplifications_of(after, queries, live):
        changing = simplification.rows
        for query, before in zip(queries, live, strict=True):
            changed = slice_of(after, simplification, before, query)
            slices = (
                x._replace(factors=x.factors @ x.factors.mT) for x in (before, changed)
            )  # freezing turns a factor
            for a, b in zip(*map(tensors_of, slices), strict=True):
                torch.testing.assert_close(a[changing:], b[changing:], atol=1e-5, rtol=1e-5)
        errors = sensitivity.errors[simplification.name]
        assert (errors[changing:] == 0).all()
        assert changing == 0 or (errors[:changing] > 0).any()


def test_the_share_with_direction_is_of_rows_that_change_with_it():
    """Catches static rows that count as seen from each side: 20 of 60 are conditioned."""
    model = trained_a_little("7dgs", 0)
    assert share_with_direction(model) == 1
    model.effect_sets = EffectSets(0, 20, torch.zeros(N, dtype=torch.int32))
    assert share_with_direction(model) == 20 / 60


def test_the_loss_is_measured_and_not_only_predicted():
    """Catches a gate that goes by its prediction where the views it is checked on say otherwise."""
    model = trained_a_little("7dgs", 0)
    views = views_of(model, 1)
    sensitivity = probe(model, views[5:], BLACK)

    def measure(shown: GaussianModel) -> float:
        return sum(psnr(render(shown, view.camera, view.time, BLACK), view.image) for view in views[:5]) / 5

    copied = gate_within(model, sensitivity, 0.3, measure)
    assert copied.gate.measured_db <= 0.3
    assert copied.gate.measured_db == pytest.approx(measure(model) - measure(copied.model), abs=1e-9)
    assert sum(copied.gate.rows.values()) == N
    assert copied.gate.bytes < copied.gate.bytes_before == model.stored_bytes()
    assert model.effect_sets is None
    predicted = choose(sensitivity, model, copied.gate.share).predicted
    assert copied.gate.predicted_db == pytest.approx(10 * math.log10(1 + predicted))
    harmless = gate_within(model, sensitivity, 0.3, lambda _: 30.0)
    assert harmless.gate.share == 0.1, "a share of 0.2 is predicted to cost more than twice the allowed 0.3 dB"
    worse = iter([30.0] + [20.0] * 20)
    assert gate_within(model, sensitivity, 0.3, lambda _: next(worse)) is None
    exact = [psnr(view.image, view.image) for view in views[:5]]
    assert gate_within(model, sensitivity, 0.3, lambda _: sum(map(capped, exact)) / 5) is None, "nothing shows a loss"
