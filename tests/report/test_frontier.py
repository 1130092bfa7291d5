"""The frontier, what a budget buys, the time to a quality and its profile, on records with numbers worked by hand."""

import dataclasses
import math

import numpy as np
import pytest
from make_golden import make
from test_compare import group, run

from gsbench.measure.curve import Point
from gsbench.report import frontier
from gsbench.report.frontier import Target


def arm(model, variant, psnr, seconds, seeds=(0,), scene="suzanne"):
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
        *arm("a", "", 20.0, 10.0),
        *arm("a", "iterations=2", 19.0, 20.0),
        *arm("a", "iterations=4", 23.0, 40.0),
        *arm("b", "", 19.5, 15.0),
        *arm("b", "iterations=9", 25.0, 100.0),
    )


def test_the_frontier_rises_and_leaves_out_what_is_dominated():
    """Catches a frontier through dominated points, or one that is not sorted by cost."""
    of = frontier.points(three_lengths(), ["suzanne"])
    a = [p for p in of if p.series == "a"]
    assert [p.cost["seconds"] for p in frontier.frontier(a, "seconds")] == [10.0, 40.0]
    assert {p.arm.name for p in frontier.dominated(of, "seconds")} == {"a, iterations=2", "b"}
    assert frontier.dominated(a[:1], "seconds") == []


def test_equal_points_do_not_dominate_each_other():
    """Catches two equal models that are both called dominated."""
    of = frontier.points(group(*arm("a", "", 20.0, 10.0), *arm("b", "", 20.0, 10.0)), ["suzanne"])
    assert frontier.dominated(of, "seconds") == []
    assert len(frontier.frontier(of, "seconds")) == 1


def test_a_point_is_the_mean_of_its_scenes():
    """Catches an arm that has not finished a scene and is averaged over fewer."""
    runs = group(*arm("a", "", 20.0, 10.0), *arm("a", "", 30.0, 30.0, scene="x"), *arm("b", "", 20.0, 10.0))
    (point,) = frontier.points(runs, ["suzanne", "x"])
    assert (point.series, point.psnr.mean, point.cost["seconds"]) == ("a", 25.0, 20.0)
    assert frontier.points(runs, []) == []


@pytest.mark.parametrize(
    ("budget", "expected"), [(5, None), (10, "a"), (39, "a"), (40, "a, iterations=4"), (1e9, "b, iterations=9")]
)
def test_a_budget_buys_the_best_that_costs_at_most_that(budget, expected):
    """Catches a choice over the budget, and one that exists where nothing is cheap enough."""
    runs = three_lengths()
    choice = frontier.choose(runs, frontier.points(runs, ["suzanne"]), "seconds", budget)
    assert (choice and choice.point.arm.name) == expected


def test_a_choice_names_what_it_cannot_be_told_from():
    """Catches a winner by a hundredth of a dB with no word of the other, and a tie claimed from one seed."""
    near = group(*arm("a", "", 20.0, 10.0, (0, 1, 2)), *arm("b", "", 20.001, 10.0, (0, 1, 2)))
    (seed,) = near.main_arms[0].runs.values()
    noisy = [
        dataclasses.replace(r, per_view=[dataclasses.replace(v, psnr=v.psnr + r.seed) for v in r.per_view])
        for r in seed
    ]
    near = group(*noisy, *arm("b", "", 20.001, 10.0, (0, 1, 2)))
    choice = frontier.choose(near, frontier.points(near, ["suzanne"]), "seconds", 60)
    assert choice.point.series == "b"
    assert [p.series for p in choice.level] == ["a"]
    assert not choice.unknown
    one = three_lengths()
    choice = frontier.choose(one, frontier.points(one, ["suzanne"]), "seconds", 1e9)
    assert choice.unknown
    assert choice.level == []


def test_a_winner_within_the_noise_of_the_seeds_is_not_told_apart():
    """Catches the wrong end of the interval: a is 0.2 dB above b with an interval that holds zero, and far above c."""
    of_seeds = {"a": (25.0, 25.0, 25.0), "b": (24.2, 25.1, 25.1), "c": (20.0, 20.1, 20.2)}
    runs = [run(m, s, (v, v), metrics={**make().metrics, "psnr": v}) for m, each in of_seeds.items()
            for s, v in enumerate(each)]  # fmt: skip
    near = group(*runs)
    choice = frontier.choose(near, frontier.points(near, ["suzanne"]), "seconds", 1e9)
    assert choice.point.series == "a"
    assert [p.series for p in choice.level] == ["b"]


def test_targets_are_set_by_rule_and_never_is_an_answer():
    """Catches an interpolated time, a target on test, and a model that never reaches one but gets a number."""
    found = {t.rule: t for t in frontier.targets(group(*three_lengths().records, *arm("3dgs", "", 19.0, 5.0)))}
    assert list(found) == ["3dgs ends", "strongest ends (b)"]
    assert found["3dgs ends"].psnr == 19.5
    assert found["3dgs ends"].seconds == {"3dgs": 5.0, "a": 10.0, "b": 15.0}
    assert found["strongest ends (b)"].seconds == {"3dgs": math.inf, "a": math.inf, "b": 100.0}


def test_the_papers_number_is_a_target_only_on_its_own_data():
    """Catches the paper's 30.72 dB of trex as a target of a stand-in that has the scene's name."""
    theirs = {**make().protocol, "paper_dataset": "D-NeRF"}
    for dataset, expected in (("D-NeRF", [30.72]), ("mini", [])):
        runs = [
            dataclasses.replace(r, dataset=dataset, protocol=theirs) for r in arm("a", "", 31.0, 10.0, scene="trex")
        ]
        assert [t.psnr for t in frontier.targets(group(*runs)) if "paper" in t.rule] == expected


def test_one_model_is_both_weakest_and_strongest():
    """Catches a target that is shown twice, and a crash where nothing finished."""
    assert [t.rule for t in frontier.targets(group(*arm("a", "", 20.0, 10.0)))] == ["weakest ends (a)"]
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
