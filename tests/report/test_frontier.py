"""The frontier, what a budget buys, the time to a quality and its profile, on records with numbers worked by hand."""

import dataclasses
import math

import numpy as np
import pytest
from make_golden import make
from test_compare import group, run

from gsbench.measure.curve import Point
from gsbench.measure.record import Gate, OnDemand, Stop
from gsbench.report import frontier
from gsbench.report.configurations import psnr_val
from gsbench.report.family import Family
from gsbench.report.frontier import Target


def choose(runs, cost, budget):
    points = frontier.points(runs, ["suzanne"])
    wanted = frontier.contest(points, cost, budget)
    weights = [[(1.0, wanted[0].configuration), (-1.0, other.configuration)] for other in wanted[1:]]
    return frontier.choose(points, cost, budget, Family(runs, {"psnr": weights}))


def runs_of(model, variant, psnr, seconds, seeds=(0,), scene="suzanne"):
    """Runs of a model at a variant whose PSNR on val is half a dB above that on test."""
    return [
        run(
            model,
            s,
            (psnr + s / 100, psnr + s / 50),
            scene,
            seconds,
            variant=variant,
            metrics={**make().metrics, "psnr": psnr + s * 0.015},
            curve=[Point(1000, seconds, psnr + 0.5)],
        )
        for s in seeds
    ]


def three_lengths():
    """Model a at 10, 20, 40 s, of which 20 is worse than 10; b at 15 s between them, and at 100 s the best."""
    return group(
        *runs_of("a", "", 20.0, 10.0),
        *runs_of("a", "iterations=2", 19.0, 20.0),
        *runs_of("a", "iterations=4", 23.0, 40.0),
        *runs_of("b", "", 19.5, 15.0),
        *runs_of("b", "iterations=9", 25.0, 100.0),
    )


def test_the_frontier_rises_and_leaves_out_what_is_dominated():
    """Catches a frontier through dominated points, or one that is not sorted by cost."""
    of = frontier.points(three_lengths(), ["suzanne"])
    a = [p for p in of if p.series == "a"]
    assert [p.cost["seconds"] for p in frontier.frontier(a, "seconds")] == [10.0, 40.0]
    assert {p.configuration.name for p in frontier.beaten(of, "seconds")} == {"a, iterations=2", "b"}
    assert frontier.beaten(a[:1], "seconds") == []


def test_equal_points_do_not_dominate_each_other():
    """Catches two equal models that are both called dominated."""
    of = frontier.points(group(*runs_of("a", "", 20.0, 10.0), *runs_of("b", "", 20.0, 10.0)), ["suzanne"])
    assert frontier.beaten(of, "seconds") == []
    assert len(frontier.frontier(of, "seconds")) == 1


def test_a_point_is_the_mean_of_its_scenes():
    """Catches a configuration that has not finished a scene and is averaged over fewer."""
    runs = group(*runs_of("a", "", 20.0, 10.0), *runs_of("a", "", 30.0, 30.0, scene="x"), *runs_of("b", "", 20.0, 10.0))
    (point,) = frontier.points(runs, ["suzanne", "x"])
    assert (point.series, point.psnr.mean, point.cost["seconds"]) == ("a", 25.0, 20.0)
    assert frontier.points(runs, []) == []


@pytest.mark.parametrize(
    ("budget", "expected"), [(5, None), (10, "a"), (39, "a"), (40, "a, iterations=4"), (1e9, "b, iterations=9")]
)
def test_a_budget_buys_the_best_that_costs_at_most_that(budget, expected):
    """Catches a choice over the budget, and one that exists where nothing is cheap enough."""
    runs = three_lengths()
    choice = choose(runs, "seconds", budget)
    assert (choice and choice.point.configuration.name) == expected


def test_a_choice_is_made_on_val_and_shown_on_test():
    """Catches the best of many configurations chosen by the very number that is shown: a has more on test, b on val."""
    a, b = runs_of("a", "", 21.0, 10.0), runs_of("b", "", 20.0, 10.0)
    a = [dataclasses.replace(r, curve=[Point(1000, 10.0, 19.0)]) for r in a]
    choice = choose(group(*a, *b), "seconds", 60)
    assert (choice.point.series, choice.point.psnr.mean, choice.on_val) == ("b", 20.0, True)
    without = [dataclasses.replace(r, curve=[]) for r in b]
    choice = choose(group(*a, *without), "seconds", 60)
    assert (choice.point.series, choice.on_val) == ("a", False)


def test_what_the_gate_at_the_end_cost_on_val_counts():
    """Catches a gated run that is chosen by the PSNR it had before its gate."""
    (run,) = runs_of("auto", "", 20.0, 10.0)
    gate = Gate(0.1, 0.4, 0.3, {}, {}, 2, 1)
    gated = dataclasses.replace(run, on_demand=OnDemand(gates=[dataclasses.replace(gate, step=600), gate]))
    assert psnr_val(run) == 20.5
    assert psnr_val(gated) == pytest.approx(20.2)


def test_a_stopped_training_has_the_psnr_of_the_iteration_it_kept():
    """Catches a run that is chosen by the lower PSNR on val of the iteration at which `train.patience` stopped it."""
    (run,) = runs_of("a", "", 20.0, 10.0)
    curve = [Point(2400, 6.0, 21.0), Point(2800, 7.0, 20.8), Point(3200, 8.0, 20.6)]
    assert psnr_val(dataclasses.replace(run, curve=curve)) == 20.6
    assert psnr_val(dataclasses.replace(run, curve=curve, stop=Stop(3200, 2400))) == 21.0


def test_a_choice_names_what_it_cannot_be_told_from():
    """Catches a winner by a hundredth of a dB with no word of the other, and a tie claimed from one seed."""
    near = group(*runs_of("a", "", 20.0, 10.0, (0, 1, 2)), *runs_of("b", "", 20.001, 10.0, (0, 1, 2)))
    (seed,) = near.main_configurations[0].runs.values()
    noisy = [
        dataclasses.replace(r, per_view=[dataclasses.replace(v, psnr=v.psnr + r.seed) for v in r.per_view])
        for r in seed
    ]
    near = group(*noisy, *runs_of("b", "", 20.001, 10.0, (0, 1, 2)))
    choice = choose(near, "seconds", 60)
    assert choice.point.series == "b"
    assert [p.series for p in choice.level] == ["a"]
    assert not choice.unknown
    one = three_lengths()
    choice = choose(one, "seconds", 1e9)
    assert [p.series for p in choice.unknown] == ["a"]
    assert choice.level == []


def test_a_winner_within_the_noise_of_the_seeds_is_not_told_apart():
    """Catches the wrong end of the interval: a is 0.2 dB above b with an interval that holds zero, and far above c."""
    of_seeds = {"a": (25.0, 25.0, 25.0), "b": (24.2, 25.1, 25.1), "c": (20.0, 20.1, 20.2)}
    runs = [run(m, s, (v, v), metrics={**make().metrics, "psnr": v}) for m, each in of_seeds.items()
            for s, v in enumerate(each)]  # fmt: skip
    choice = choose(group(*runs), "seconds", 1e9)
    assert choice.point.series == "a"
    assert [p.series for p in choice.level] == ["b"]


def test_targets_are_round_numbers_and_never_is_an_answer():
    """Catches an interpolated time, a target on test, and a model that never reaches one but gets a number."""
    found = {t.rule: t for t in frontier.targets(group(*three_lengths().records, *runs_of("3dgs", "", 19.0, 5.0)))}
    assert list(found) == ["20 dB", "22 dB", "24 dB"]
    assert found["20 dB"].psnr == 20.0
    assert found["20 dB"].seconds == {"3dgs": math.inf, "a": 10.0, "b": 15.0}
    assert found["24 dB"].seconds == {"3dgs": math.inf, "a": math.inf, "b": 100.0}


def test_the_time_to_a_target_is_read_from_the_curve():
    """Catches the seconds of a whole training in every row of a scene, a target that one seed has and the mean has not,
    and a target that a curve had before it fell."""
    at = {"rises": (18.0, 21.0, 22.4, 24.6), "falls": (20.5, 22.5, 21.5, 19.0)}
    runs = [
        dataclasses.replace(r, curve=[Point(100 * i, 10.0 * i, p + noise) for i, p in enumerate(curve, 1)])
        for name, curve in at.items()
        for seed, noise in ((0, 0.5), (1, -0.7))
        for r in runs_of(name, "", curve[-1], 40.0, (seed,))
    ]
    found = {t.psnr: t.seconds for t in frontier.targets(group(*runs))}
    assert found == {
        20.0: {"rises": 20.0, "falls": 10.0},
        22.0: {"rises": 30.0, "falls": 20.0},
        24.0: {"rises": 40.0, "falls": math.inf},
    }


def test_no_target_is_the_winners_own_mean():
    """Catches targets that only the winner can reach, as they are what its own seeds ended with."""
    runs = group(
        *runs_of("a", "", 19.23, 10.0), *runs_of("a", "iterations=4", 23.37, 40.0), *runs_of("b", "", 25.11, 100.0)
    )
    own = {float(runs.sample(a, "suzanne", "psnr_val").mean()) for a in runs.configurations}
    targets = frontier.targets(runs)
    assert [t.psnr for t in targets] == [20.0, 22.0, 24.0]
    assert not {t.psnr for t in targets} & own


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (19.2, 26.1, [20, 22, 24, 26]),
        (20.0, 23.0, [21, 22, 23]),
        (24.1, 25.3, [24.2, 24.4, 24.6, 24.8, 25.0, 25.2]),
        (24.11, 24.19, []),
        (-0.1, 0.05, [0]),
        (0.0, 1e60, list(range(2, 101, 2))),
    ],
)
def test_targets_are_as_far_apart_as_gives_three(low, high, expected):
    """Catches a target at or below the lowest run, one above the highest, a dozen where three will do, and 1e60."""
    assert frontier.round_numbers(low, high) == expected


def test_the_papers_number_is_a_target_only_on_its_own_images():
    """Catches the paper's 30.72 dB of trex as a target of a stand-in of that name, and of images of another size."""
    for dataset, size, expected in (("D-NeRF", "400x400", [30.72]), ("mini", "400x400", []), ("D-NeRF", "80x80", [])):
        of_paper = {"paper_dataset": "D-NeRF", "background": "black", "resolution": size}
        protocol = {**make().protocol, **of_paper}
        runs = [
            dataclasses.replace(r, dataset=dataset, protocol=protocol)
            for r in runs_of("a", "", 31.0, 10.0, scene="trex")
        ]
        assert [t.psnr for t in frontier.targets(group(*runs)) if "paper" in t.rule] == expected


def test_one_run_has_no_target():
    """Catches a target that its own run set, and a crash where nothing finished."""
    assert frontier.targets(group(*runs_of("a", "", 20.0, 10.0))) == []
    lost = run("a", status="failed", reason="no", metrics=None, missing={}, cost=None, per_view=[], curve=[])
    assert frontier.targets(group(lost)) == []


def test_the_profile_by_hand():
    """Catches ratios to the wrong model: a is fastest on one target of two, within a factor of 3 on both."""
    of = [Target("x", "r", 1.0, {"a": 10.0, "b": 20.0}), Target("y", "r", 1.0, {"a": 30.0, "b": 10.0, "c": math.inf})]
    found = frontier.profile(of)
    assert found["a"].tolist() == [1.0, 3.0]
    assert found["b"].tolist() == [1.0, 2.0]
    assert np.isinf(found["c"]).all()
    assert frontier.profile([]) == {}
