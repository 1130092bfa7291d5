"""When Gaussians can be visible, by which a training sorts their rows."""

import pytest
import torch
from small import assert_culled_outside_its_intervals, fresh, lively
from torch import nn

from gsbench.train.rows import START_BINS, Rows

TIMED = ["4dgs", "7dgs", "7dgs_nodir", "7dgs_paper", "7dgs_raw"]


@pytest.mark.parametrize("variant", TIMED)
def test_outside_its_interval_a_gaussian_is_culled(variant: str) -> None:
    """Catches a duration in other units, a lambda or an opacity that is left out, and an interval that is too short."""
    # 7DGS without direction has nothing else that dims it: it is visible in the whole of its interval.
    exact = variant == "7dgs_nodir"
    assert_culled_outside_its_intervals(
        lively(variant, count=200), torch.linspace(0, 1, 41, dtype=torch.float64), exact
    )


def test_a_model_without_time_has_no_intervals() -> None:
    """Catches a model that is sorted by times that it does not have."""
    assert fresh("3dgs").visible_intervals() is None
    assert fresh("6dgs").visible_intervals() is None


class Moments:
    """Moments that note which rows they were told to follow."""

    def __init__(self) -> None:
        self.rows = torch.empty(0)

    def reindex(self, rows: torch.Tensor, fresh: torch.Tensor) -> None:
        assert not fresh.any()
        self.rows = rows

    def forget(self, parameter: nn.Parameter) -> None:
        raise AssertionError(parameter)


def test_rows_are_sorted_by_when_they_can_be_visible() -> None:
    """Catches rows in another order, moments that stay where they were, and rows of equal intervals that swap."""
    model, moments = fresh("7dgs", count=300), Moments()
    with torch.no_grad():
        model.splats["log_diagonal"][:, 3] = -4.0  # short in time
        model.splats["log_diagonal"][:50, 3] = 3.0  # visible always
        model.splats["opacities"][-20:] = -9.0  # visible never
    before = model.splats["means"].detach().clone()
    Rows(model, moments).sort_by_time()
    assert torch.equal(model.splats["means"], before[moments.rows])
    intervals = model.visible_intervals()
    assert intervals is not None
    bins = (intervals[:, 0] * START_BINS).floor()
    assert torch.equal(bins, bins.sort().values)
    for start in bins.unique():
        last = intervals[bins == start, 1]
        assert torch.equal(last, last.sort().values)
    always = moments.rows[(intervals == torch.tensor([0.0, 1.0])).all(1)]
    assert torch.equal(always, always.sort().values)
    assert len(always) >= 50
    assert intervals[-20:].isinf().all()


def test_rows_of_effect_sets_keep_their_order() -> None:
    """Catches a sort that mixes static Gaussians among those that change with time."""
    model, moments = fresh("7dgs"), Moments()
    model.effect_sets = object()  # type: ignore[assignment]
    Rows(model, moments).sort_by_time()
    assert not len(moments.rows)
