"""Intervals: numbers worked by hand, agreement with scipy, coverage on simulated data of known truth, Holm."""

import math

import numpy as np
import pytest
from scipy import stats
from simulate_coverage import SHAPES, SPREADS, coverage

from gsbench.report.intervals import Estimate, estimate, holm

T1, T2 = 12.7062, 4.30265  # Student's t at 97.5 % with one and two degrees of freedom


def p_by_search(of: Estimate) -> float:
    """The p-value by trying levels."""
    levels = np.linspace(0, 1, 200_001)[:-1]
    half = np.hypot(*(np.sqrt(s.variance) * stats.t.ppf((1 + levels) / 2, s.freedom) for s in of.levels))
    return 1 - levels[np.searchsorted(half, abs(of.mean))]


def test_scenes_or_the_seeds_of_one_scene_are_a_sample():
    """Catches a normal quantile, a population variance, and eight scenes that count seeds or views as if scenes."""
    seeds = estimate([np.array([[24.0], [25.0], [26.0]])])
    random = np.random.default_rng(0)
    arrays = [random.normal(mean, 0.1, (3, 10)) for mean in (0.2, 0.5, 1.1, -0.3)]
    scenes = estimate(arrays)
    for of, sample in ((seeds, [24.0, 25.0, 26.0]), (scenes, [array.mean() for array in arrays])):
        expected = stats.ttest_1samp(sample, 0)
        interval = expected.confidence_interval()
        assert (of.low, of.high, of.p) == pytest.approx((interval.low, interval.high, expected.pvalue), rel=1e-6)
    assert (seeds.over, seeds.seeds, seeds.scenes, scenes.over) == ("seeds", 3, 1, "scenes")
    of_these = estimate(arrays, generalise=False)
    assert of_these.over == "seeds and views"
    assert of_these.half < scenes.half


@pytest.mark.parametrize(
    ("values", "half"),
    [
        # Rows 1 and 3 and columns 0, 2, 4 about a mean of 2: seeds have variance 2 / 2, views 4 / 3, no rest.
        ([[-1.0, 1.0, 3.0], [1.0, 3.0, 5.0]], math.sqrt(T1**2 + T2**2 * 4 / 3)),
        # Seeds differ by 5, views by 3, each cell by 1 beside that: of the seeds' 25 the rest is 4 / 4; views 18 / 2.
        ([[-9.0, -1.0], [3.0, 7.0]], T1 * math.sqrt(24 + 9)),
        # Two seeds that differ, of views that do not: the interval is not narrower than that of the seeds alone.
        ([[0.0, 0.0], [2.0, 2.0]], T1),
    ],
)
def test_seeds_and_views_add_in_squares(values, half):
    """Catches a level that is forgotten or counted twice, and a rest of the two-way ANOVA divided by too little."""
    of = estimate([np.array(values)])
    assert of.mean == np.mean(values)
    assert of.half == pytest.approx(half, rel=1e-5)
    if of.half > of.floor.half_width(0.95):
        assert of.p == pytest.approx(p_by_search(of), abs=1e-5)


def test_one_seed_has_no_interval():
    """Catches views or scenes that stand in for seeds: of one seed no spread is known."""
    for scenes in ([np.ones((1, 20))], [np.ones((3, 20)), np.ones((1, 20))], [np.full((1, 5), i) for i in range(8)]):
        of = estimate(scenes)
        assert math.isfinite(of.mean)
        assert all(map(math.isnan, (of.low, of.high, of.p)))
        assert of.over == ""
    assert math.isnan(estimate([]).mean)


def test_no_spread_at_all_is_certain():
    """Catches a division by zero where every seed and view has the same difference."""
    for value, p in ((0.0, 1.0), (1.0, 0.0)):
        of = estimate([np.full((3, 4), value)])
        assert (of.low, of.high, of.p) == (value, value, p)


def test_a_p_value_goes_with_its_interval():
    """Catches a p-value below 5 % whose interval holds zero, or the reverse."""
    random = np.random.default_rng(2)
    significant = 0
    for _ in range(60):
        of = estimate([random.normal(0.3, 0.3, (3, 1)) + random.normal(0, 0.5, (3, 10)) for _ in range(2)])
        assert (of.p < 0.05) == (of.low > 0 or of.high < 0)
        significant += of.p < 0.05
    assert 6 < significant < 54


def test_half_width_over_scenes_is_students_t_of_their_means():
    """Catches an interval of two scenes that reads as if it held for others, and one narrower than for these scenes."""
    two, alike = (
        estimate([np.full((3, 4), 1.0), np.full((3, 4), 2.0)]),
        estimate([np.arange(3.0)[:, None] + [0, 0]] * 2),
    )
    assert (two.each, two.gaining) == ((1.0, 2.0), 2)
    assert two.half_over_scenes == pytest.approx(T1 * 0.5, rel=1e-4)  # of a standard deviation 0.7071 / sqrt(2)
    assert alike.half_over_scenes == alike.half > 0
    assert math.isnan(estimate([np.full((3, 4), 1.0)]).half_over_scenes)
    three = estimate([np.full((3, 4), mean) for mean in (1.0, 2.0, 4.0)])
    assert three.half_over_scenes == pytest.approx(three.half)


def test_holm_by_hand():
    """Catches Bonferroni, and adjusted values that fall: 0.01, 0.04, 0.03 become 0.03, 0.06, 0.06 (Holm 1979)."""
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    assert holm([0.5, math.nan, 0.9]) == pytest.approx([1.0, math.nan, 1.0], nan_ok=True)
    assert holm([]) == []


@pytest.mark.parametrize("shape", [(1, 3, 20), (3, 3, 10)])
def test_the_interval_holds_its_coverage_on_few_simulations(shape):
    """Catches a quantile or a variance that is wrong by a third, quickly; the slow test is narrower."""
    assert 0.92 <= coverage(shape, SPREADS["as measured"], 400) <= 0.98


@pytest.mark.slow
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("spread", SPREADS)
def test_the_interval_holds_its_coverage(shape, spread):
    """Catches an interval that is not one of 95 %, of zero too: 2,000 draws; of two seeds up to 99 %."""
    held = coverage(shape, SPREADS[spread], 2000)
    assert 0.93 <= held <= (0.97 if spread == "as measured" and shape[1] > 2 else 1)
    assert coverage(shape, SPREADS["as measured"], 2000, truth=0.0, seed=1) >= 0.94
