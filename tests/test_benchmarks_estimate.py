"""The arithmetic of `python -m benchmarks.estimate`, with made-up times of a step."""

from collections import Counter

import pytest

from benchmarks.estimate import FIRST, Run, StepCost, estimate, span, step_cost, table1_runs, time_step
from benchmarks.timing import Cost
from gsbench.config import DataConfig, TrainConfig
from gsbench.report import paper


def fake(run: Run, gaussians: int, threads: int) -> Cost:
    """100 ms and 1 ms for each 1,000 Gaussians, in CPU time; two threads are 1.6 times as fast."""
    del run
    cpu = 100 + gaussians / 1000
    return Cost(cpu, cpu, cpu, 2 * cpu if threads == 1 else 2 * cpu / 1.6)


def test_all_runs_of_the_table_are_counted() -> None:
    """Catches a scene or model that is left out, heart1 or Technicolor at another size, and another batch."""
    runs = list(table1_runs())
    assert Counter(run.dataset for run in runs) == {"7DGS-PBR": 18, "D-NeRF": 24, "Technicolor": 15}
    assert Counter(run.model for run in runs) == {"4dgs": 19, "7dgs": 19, "7dgs_noagr": 19}
    sizes = Counter((run.dataset, run.size, run.views) for run in runs)
    assert sizes == {("7DGS-PBR", (500, 500), 4): 3, ("7DGS-PBR", (800, 800), 4): 15, ("D-NeRF", (400, 400), 4): 24,
                     ("Technicolor", (2048, 1088), 1): 15}  # fmt: skip
    (suzanne,) = [run for run in runs if run.gaussians == 336713]
    assert (suzanne.dataset, suzanne.model) == ("7DGS-PBR", "7dgs")


def test_a_run_without_a_number_gets_the_average(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a table that cannot be estimated because one cell of the paper is missing."""
    rows = {key: row for key, row in paper.table1().items() if key != ("D-NeRF", "trex", "7dgs")}
    monkeypatch.setattr(paper, "table1", lambda: rows)
    runs = list(table1_runs())
    assert len(runs) == 57
    assert [run.gaussians for run in runs if run.dataset == "D-NeRF" and run.model == "7dgs"].count(47378) == 1


def test_the_start_is_that_of_the_config() -> None:
    """Catches defaults that move away from the assumptions of the estimate."""
    assert DataConfig.initial_points == FIRST
    train = TrainConfig()
    assert 2 * train.densify.stop == train.recipe_iterations


def test_a_step_is_linear_in_gaussians() -> None:
    """Catches a slope of the wrong unit, and a speed-up from CPU time, which two threads do not lower."""
    cost = step_cost(Run("D-NeRF", "7dgs", (400, 400), 4, 1000), fake)
    assert (cost.base, cost.each, cost.speedup) == pytest.approx((100, 1 / 1000, 1.6))


def test_hours_follow_the_number_of_gaussians_over_a_run() -> None:
    """Catches a run at its final number of Gaussians from the start, or at its mean for all of it."""
    cost = StepCost(base=10, each=0.001, speedup=1.5)
    # From 100,000 to 300,000 in 15,000 steps: 200,000 on average, 210 ms; then 15,000 steps of 310 ms.
    assert cost.hours(300_000, 30_000) == pytest.approx(15_000 * (210 + 310) / 3.6e6)
    assert cost.hours(300_000, 5_000) == pytest.approx(cost.hours(300_000, 30_000) / 6)


def test_runs_at_once_begin_with_the_longest() -> None:
    """Catches a total divided by the places, which no schedule reaches, and a long run that begins last."""
    assert span([1, 1, 1, 1, 4], 2) == 4
    assert span([3, 3, 2, 2, 2], 2) == 7
    assert span([5.0], 32) == 5


def test_the_table_adds_up() -> None:
    """Catches runs that are left out of the totals, and steps that are timed again for each scene."""
    timed = []

    def time(run: Run, gaussians: int, threads: int) -> Cost:
        timed.append((run.model, run.size, gaussians, threads))
        return fake(run, gaussians, threads)

    # At 100,000 Gaussians from start to end a step takes 200 ms: 18,000 steps are an hour.
    runs = [Run("A", "7dgs", (4, 4), 1, FIRST), Run("A", "7dgs", (4, 4), 1, FIRST), Run("B", "4dgs", (8, 8), 4, FIRST)]
    lines = list(estimate(runs, 36_000, time))
    assert lines[2:4] == ["| A | 7dgs | 2 | 1.60 | 4.0 |", "| B | 4dgs | 1 | 1.60 | 2.0 |"]
    assert "3 runs of 36,000 steps: 6.0 hours of CPU; 3.8 hours on 2 cores" in lines[-1]
    assert "; 1.2 hours on 64 cores" in lines[-1]
    assert len(timed) == len(set(timed)) == 6


def test_a_step_can_be_timed_for_each_model(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a model or an image that is not square that cannot be stepped."""
    monkeypatch.setattr("benchmarks.estimate.measure", lambda call: call() or Cost(1, 1, 1, 1))
    for name in ("4dgs", "7dgs", "7dgs_noagr"):
        assert time_step(Run("A", name, (48, 32), 2, 0), 50, 2).median == 1
