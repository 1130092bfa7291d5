"""The recipe's steps at any length of run."""

import pytest

from gsbench.config import DensifyConfig, TrainConfig
from gsbench.schedule import STEPS_BETWEEN_RESETS, Schedule


def schedule(iterations: int, batch_size: int = 4) -> Schedule:
    return Schedule(TrainConfig(iterations=iterations, batch_size=batch_size), sh_degree=3, agr=True)


def test_full_run_is_the_recipe_as_published():
    """Catches an off-by-one in any step of the 30,000-iteration run: 3DGS' and 7DGS' own numbers."""
    published = DensifyConfig(rounds=145)  # as in conf/recipe/paper.yaml
    s = Schedule(TrainConfig(densify=published), sh_degree=3, agr=True)
    densified = [step + 1 for step in range(30_000) if s.densifies(step)]
    assert densified == list(range(600, 15_001, 100))
    assert [step + 1 for step in range(30_000) if s.resets(step)] == [3_000, 6_000, 9_000, 12_000]
    assert [s.active(step).sh_degree for step in (0, 999, 1_000, 2_999, 3_000, 29_999)] == [0, 0, 1, 2, 3, 3]
    assert not s.active(2_999).refine
    assert s.active(3_000).refine
    assert not s.active(14_999).tunes_lambda
    assert s.active(15_000).tunes_lambda


@pytest.mark.parametrize("iterations", [200, 1_000, 7_000, 12_345])
def test_short_run_keeps_the_proportions(iterations):
    """Catches a step that does not scale: each happens at the same part of the run as in the recipe."""
    short = schedule(iterations)
    assert schedule(30).scaled(500) == schedule(60).scaled(500) == 1  # the least
    for recipe in (500, 1_000, 3_000, 15_000):
        assert short.scaled(recipe) == max(1, round(recipe / 30_000 * iterations))
    assert short.active(iterations - 1).sh_degree == 3
    assert short.active(iterations - 1).refine
    assert short.densify_stop == iterations // 2 or iterations % 2


@pytest.mark.parametrize(("iterations", "rounds"), [(1_000, 5), (7_000, 34), (7_400, 36), (15_000, 36), (300_000, 36)])
def test_rounds_of_densification_do_not_grow_with_the_run(iterations, rounds):
    """Catches a long run that densifies as often as its length allows, and a short one that densifies less for it."""
    s = schedule(iterations)
    done = [step + 1 for step in range(iterations) if s.densifies(step)]
    assert abs(len(done) - rounds) <= 1
    assert s.densify_every == 100 or iterations > 7_400


def test_intervals_never_fall_below_what_they_wait_for():
    """Catches clones judged again before they part, and opacity resets faster than Adam can recover from."""
    s = schedule(600, batch_size=2)
    assert [step + 1 for step in range(600) if s.densifies(step)] == [100, 200, 300]
    assert s.reset_every == STEPS_BETWEEN_RESETS
    resets = [step for step in range(600) if s.resets(step)]
    assert all(step + 1 + s.reset_every // 2 <= s.densify_stop for step in resets)


def test_no_resets_at_all():
    """Catches a run without resets that lowers opacities, or that prunes large Gaussians as if it had."""
    s = Schedule(TrainConfig(densify=DensifyConfig(reset_every=None)), sh_degree=3, agr=True)
    assert not s.resets_after
    assert not any(s.resets(step) or s.has_reset(step) for step in (0, 2_999, 6_000, 29_999))


def test_growth_follows_the_resolution():
    """Catches a limit that a quarter of the width fills with Gaussians, and one that full resolution does not have."""
    s = Schedule(TrainConfig(coarse=[[4, 3_000], [2, 14_900]], densify=DensifyConfig()), sh_degree=3, agr=True)
    assert s.most_gaussians(0, 48_000) == 3_000  # 48,000 / 4^2
    assert s.most_gaussians(7_500, 48_000) == 16_971  # 48,000 / 2^1.5
    assert s.most_gaussians(14_999, 48_000) == 48_000
    assert schedule(30_000).most_gaussians(0, 48_000) == 48_000


def test_parts_act_only_where_they_are():
    """Catches a schedule that refines a model without AGR, and an early stop that keeps a static first stage."""
    plain, warmed = (Schedule(TrainConfig(iterations=100, sh_every=1), 0, False, warm_up=share) for share in (0, 0.3))
    assert not any(plain.active(step).refine for step in range(100))
    assert [step for step in range(100) if not warmed.is_complete(step)] == list(range(30))


@pytest.mark.parametrize(("iterations", "points"), [(1_000, 10), (7, 3), (5, 20), (100, 1)])
def test_curve_has_its_points_and_ends_at_the_last_step(iterations, points):
    """Catches a curve that misses the final iteration or has another number of points than asked for."""
    s = Schedule(TrainConfig(iterations=iterations, curve_points=points), sh_degree=3, agr=False)
    steps = [step for step in range(iterations) if s.measures(step)]
    assert steps[-1] == iterations - 1
    assert len(steps) == min(points, iterations)


@pytest.mark.parametrize(
    ("points", "stop", "after"),
    [(20, 15_000, 700), (10, 15_000, 700), (3, 15_000, 1000), (1, 15_000, 1000), (20, 25_000, 850)],
)
def test_models_are_compared_at_a_point_of_the_curve_after_densification(points, stop, after):
    """Catches a comparison before 70 % of the steps, where PSNR is not measured, or of models that still grow."""
    config = TrainConfig(iterations=1000, curve_points=points, densify=DensifyConfig(stop=stop))
    assert Schedule(config, sh_degree=3, agr=True).compares_after == after


def test_gaussians_are_thinned_once_after_densification():
    """Catches thinning that is never done, or while Gaussians still grow."""
    s = Schedule(TrainConfig(iterations=1000, densify=DensifyConfig(thin_to=0.5)), sh_degree=3, agr=False)
    assert [step + 1 for step in range(1000) if s.thins(step)] == [520]  # 15,600 of 30,000
