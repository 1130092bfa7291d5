"""When Gaussians can be visible: their intervals, by which a training sorts their rows, and their least lifetimes."""

import pytest
import torch
from small import CAMERA, NAMES, Moments, fresh, joint, lively
from test_equations import conditioned

from gsbench.kernels.headers import ALPHA_MIN
from gsbench.models import CameraTime, registry
from gsbench.models.cholesky import CholeskyModel
from gsbench.train.rows import START_BINS, Rows

# The raw parameter and the column that hold the size in time, and a number that makes this size tiny.
IN_TIME = {
    "4dgs": ("scales", 3, -20.0),
    "dbs": ("precision", -1, 20.0),
    "dgs": ("precision", -1, 20.0),
    **dict.fromkeys(("freetime", "freetime_plus", "sharptime", "stg", "stg_full"), ("durations", 0, -20.0)),
    "ubs": ("scales", -1, -20.0),
}
TIMED = [
    name
    for name in NAMES
    if name in IN_TIME.keys() - {"ubs"}
    or ("time" in registry.find(name).observes and issubclass(registry.find(name), CholeskyModel))
]
# Nothing else dims these: they are visible in the whole of their intervals.
EXACT = ("7dgs_nodir", "freetime", "sharptime", "stg", "stg_full")
LEAST = 0.04


@pytest.mark.parametrize("variant", [*TIMED, "7dgs_paper", "7dgs_raw", "7dgs_nodir, bounded"])
def test_outside_its_interval_a_gaussian_is_culled(variant):
    """Catches a duration in other units, a lambda, an exponent or an opacity that is left out, raw times, the 1/2 of
    f_temp in a joint gate, and an interval that is too long: rows would be sorted into an order that saves nothing."""
    model = conditioned(variant, 200) if "," in variant else lively(variant, 200)
    if variant == "dbs":
        model.splats["betas"].data.clamp_(min=-1.5)  # weaker ones end at the floor, where they may stay visible
    if variant == "ndgs" or "," in variant:
        model.splats["log_diagonal"].data[:, model.rows["t"]] -= 2.0  # short in time
        times, lifetimes = model.lifetimes()
        torch.testing.assert_close(times, torch.sigmoid(model.splats["times"][:, 0]))
        S_t = joint(model)[:, -1, -1] / (2 if variant == "ndgs" else 1) / model.lambda_of("time")
        torch.testing.assert_close(lifetimes, S_t.sqrt())
    elif variant not in ("dgs", "dbs"):
        model.splats["times"].data[:4, 0] = torch.tensor([-9.0, -9.0, 10.0, 10.0])  # visible never
    if variant == "freetime_plus":
        model.splats["permanence"].data[4:12] = torch.linspace(-0.3, 2.0, 8)[:, None]  # some are visible always
    intervals = model.visible_intervals()
    assert variant in ("dgs", "dbs", "ndgs") or "," in variant or intervals[:4].isinf().all()
    first, last = intervals.unbind(1)
    hidden, times = 0, torch.linspace(0, 1, 41, dtype=torch.float64)
    for time in times:
        opacities = model.slice(CameraTime.at(CAMERA, time)).opacities
        outside = (time < first) | (time > last)
        assert (opacities[outside] < ALPHA_MIN * (1 + 1e-9)).all()
        hidden += int(outside.sum())
        if variant.startswith(EXACT):
            assert (opacities[~outside] > ALPHA_MIN * (1 - 1e-9)).all()
    assert 0 < hidden < len(times) * len(model)


@pytest.mark.parametrize("variant", ["ubs", *(name for name in NAMES if "time" not in registry.find(name).observes)])
def test_models_without_intervals(variant):
    """Catches a model that is sorted by times that it does not have; rows of UBS are not sorted either."""
    assert fresh(variant).visible_intervals() is None


@pytest.mark.parametrize("name", [*TIMED, "ubs"])
def test_lifetimes_are_held(name):
    """Catches a model that forgets lambda, its unit of time or the exponents, or that lengthens what is long enough."""
    model = fresh(name)
    raw = {key: value.data for key, value in model.splats.items()}
    bounded = getattr(model, "bounded_times", False) or name == "dgs"
    raw["times"].fill_(0.0 if bounded else 0.5)  # the sigmoid of 0 is 0.5
    parameter, column, tiny = IN_TIME.get(name) or ("log_diagonal", model.rows["t"][0], -20.0)
    raw[parameter][::2, column] = tiny
    before = {key: value.clone() for key, value in raw.items()}

    def shares() -> torch.Tensor:
        """The opacities LEAST after the mean time, divided by those at the mean time."""
        now, later = (model.slice(CameraTime.at(CAMERA.float(), 0.5 + dt)).opacities for dt in (0.0, LEAST))
        return (later / now)[now > 1e-3]

    assert (shares() < 0.01).any()
    with torch.no_grad():
        model.hold_lifetimes(LEAST)
    assert 0.5 < shares().min() < 0.65  # exp(-1/2) is 0.61, Beta profiles fall faster
    for key, value in raw.items():
        changed = value != before[key]
        assert key == parameter or not changed.any()
        assert not changed[1::2].any()


def test_rows_are_sorted_by_when_they_can_be_visible():
    """Catches rows in another order, moments that stay where they were, rows of equal intervals that swap, and a sort
    that mixes static Gaussians among those that change with time."""
    model, moments = fresh("7dgs", count=300), Moments()
    with torch.no_grad():
        model.splats["log_diagonal"][:, 3] = -4.0  # short in time
        model.splats["log_diagonal"][:50, 3] = 3.0  # visible always
        model.splats["opacities"][-20:] = -9.0  # visible never
    before = model.splats["means"].detach().clone()
    model.effect_sets = object()
    Rows(model, moments).sort_by_time()
    assert not len(moments.rows)
    model.effect_sets = None
    Rows(model, moments).sort_by_time()
    assert torch.equal(model.splats["means"], before[moments.rows])
    assert not moments.fresh.any()
    intervals = model.visible_intervals()
    bins = (intervals[:, 0] * START_BINS).floor()
    assert torch.equal(bins, bins.sort().values)
    for start in bins.unique():
        last = intervals[bins == start, 1]
        assert torch.equal(last, last.sort().values)
    always = moments.rows[(intervals == torch.tensor([0.0, 1.0])).all(1)]
    assert torch.equal(always, always.sort().values)
    assert len(always) >= 50
    assert intervals[-20:].isinf().all()
