"""When Gaussians can be seen, and what AGR leaves out at other times."""

import copy
import itertools
import math
from dataclasses import replace

import pytest
import torch
from worlds import BLACK, N, trained_a_little, views_of

from gsbench.gates.gate import apply, choose, effect_sets_of
from gsbench.gates.sensitivity import probe, share_asleep, visible_times
from gsbench.kernels.headers import ALPHA_MIN
from gsbench.models import CameraTime, GaussianModel
from gsbench.models.render import render


def fleeting() -> GaussianModel:
    """A model of 7D Gaussians, most of which are there for a part of the clip; the first five are never."""
    model = trained_a_little("7dgs", 0)
    model.splats["log_diagonal"].data[:, 3] = math.log(0.02)
    model.splats["coupling"].data *= 0.02
    model.splats["opacities"].data[:5] = -20.0
    return model


def test_when_a_gaussian_is_seen():
    """Catches a visible interval that leaves out a view which shows the Gaussian, moved or not, or that is too long."""
    model = fleeting()
    views = views_of(model, 1)
    times = sorted(view.time for view in views if view.time is not None)
    gap = max(b - a for a, b in itertools.pairwise(times))
    intervals = visible_times(model, views)
    shown = torch.zeros(N, len(views), dtype=torch.bool)
    for i, view in enumerate(views):
        query = CameraTime.of(view.camera, view.time)
        for raw in (model.refined(query), dict(model.splats.items())):
            shown[:, i] |= model.slice_geometry(raw, query)[2] >= ALPHA_MIN
    at = torch.tensor([view.time for view in views])
    for row in range(N):
        times_shown = at[shown[row]]
        if not len(times_shown):
            assert intervals[row].tolist() == [math.inf, -math.inf]
            continue
        torch.testing.assert_close(intervals[row], torch.stack([times_shown.min() - gap, times_shown.max() + gap]))
    assert intervals[:5, 0].isinf().all()
    assert not intervals[5:, 0].isinf().all()
    assert (intervals[:, 1] - intervals[:, 0]).max() < 1 or shown.float().mean() < 0.9, (
        "a model whose Gaussians never sleep"
    )


def test_a_scene_without_times():
    """Catches a Gaussian of a still scene that is taken for hidden because there is no time."""
    model = trained_a_little("6dgs", 0)
    still = [replace(view, time=None) for view in views_of(model, 1)[:8]]
    intervals = visible_times(model, still)
    assert not intervals[:, 0].isinf().all()
    assert set(intervals[:, 0].tolist()) <= {0.0, math.inf}


def test_agr_rests_unseen():
    """Catches intervals of other rows than their own, that change a training view, or that no checkpoint holds."""
    model = fleeting()
    views = views_of(model, 1)
    intervals = visible_times(model, views)
    sensitivity = probe(model, views, BLACK)
    gated, resting = copy.deepcopy(model), copy.deepcopy(model)
    choice = choose(sensitivity, model, 0.0)
    rows, _ = apply(gated, sensitivity.simplifications, choice)
    again, _ = apply(resting, sensitivity.simplifications, choice, intervals)
    assert sorted(rows.tolist()) == sorted(again.tolist())
    assert torch.equal(resting.effect_sets.intervals, intervals[again[: resting.effect_sets.refined]])
    assert not (again < 5).any(), "Gaussians that are never seen cost nothing to remove"
    for view in views:
        a, b = (render(shown, view.camera, view.time, BLACK) for shown in (gated, resting))
        torch.testing.assert_close(a, b, atol=1e-5, rtol=0)
    asleep = share_asleep(resting, views)
    assert 0.2 < asleep < 1
    assert share_asleep(gated, views) is None
    other = trained_a_little("7dgs", 1)
    other.load_state(resting.pack())
    assert torch.equal(other.effect_sets.intervals, resting.effect_sets.intervals)
    assert resting.stored_bytes() == gated.stored_bytes() + 8 * resting.effect_sets.refined
    assert len(effect_sets_of(resting).intervals) == resting.effect_sets.refined


@pytest.mark.parametrize("most", [30, 10])
def test_what_no_view_shows_is_removed(most):
    """Catches a Gaussian that is kept, and refined, because the views that were probed are not all there are."""
    model = fleeting()
    views = views_of(model, 1)
    hidden = visible_times(model, views)[:, 0].isinf()
    errors = probe(model, views, BLACK, most=most, hidden=hidden).errors["removed"]
    assert (errors[hidden] == 0).all()
    after = copy.deepcopy(model)
    sensitivity = probe(model, views, BLACK, most=most, hidden=hidden)
    rows, _ = apply(after, sensitivity.simplifications, choose(sensitivity, model, 0.0))
    assert not hidden[rows].any()
