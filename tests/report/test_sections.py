"""The numbers of a report's sections, on records with numbers worked by hand."""

import dataclasses
import math

import numpy as np
import pandas as pd
import pytest
from chapters import EIGHT, chapter, lost, run, runs_of, sections, three_lengths, with_effects
from make_golden import make, records
from many_records import frontier, on_demand

from gsbench.measure.curve import Point
from gsbench.measure.record import LengthChoice
from gsbench.measure.speed import RenderTimes
from gsbench.report import sections as of_report
from gsbench.report import stats
from gsbench.report.sections.budgets import basis, contests, is_beside_others, points
from gsbench.report.sections.curves import events, mean_curves, profiles, round_numbers, targets
from gsbench.report.sections.experiment import table
from gsbench.report.sections.lengths import by_length

BY_HAND = pytest.mark.parametrize


def pairs(*runs):
    section = sections(*runs).get("pairs")
    return [] if section is None else section.table.to_dict("records")


# ---- pairs


def test_a_pair_is_compared_on_common_seeds_and_views():
    """Catches a mean over views that only one model has, and a seed without a partner: (2 + 0.5) / 2 = 1.25 dB."""
    (pair,) = pairs(run("a", 0, (20.0, 30.0, 99.0)), run("a", 5, (90.0, 90.0)), run("b", 0, (22.0, 30.5)))
    assert (pair["pair"], pair["significant"]) == ("b − a", "unknown")
    assert pair["dB"] == pytest.approx(1.25)
    assert math.isnan(pair["low"])
    assert math.isnan(pair["p_holm"])


def test_a_run_that_failed_in_a_view_has_no_pair():
    """Catches a model whose PSNR is not a number in a view, compared without this view although its mean is empty."""
    broken = run("a", 0, (20.0, 30.0))
    scores = [dataclasses.replace(broken.per_view[0], psnr=None), broken.per_view[1]]
    broken = dataclasses.replace(broken, per_view=scores, metrics={"psnr": None}, missing={"psnr": "no number"})
    assert pairs(broken, run("b", 0, (22.0, 29.0))) == []


def test_only_the_settings_of_most_models_are_compared():
    """Catches a short run of one model that meets a long run of another."""
    runs = [run(m, s, (v, v + s / 10)) for m, v in (("a", 20.0), ("b", 21.0)) for s in range(3)]
    (pair,) = pairs(*runs, run("a", 0, (99.0, 99.0), variant="iterations=9000"))
    assert (pair["pair"], pair["significant"]) == ("b − a", "yes")
    assert pair["dB"] == pytest.approx(1.0)


def test_ablations_are_compared_with_the_whole_model_alone():
    """Catches ablations that are compared with none, or all with one another, and Holm over those pairs."""
    values = {"none": 25.0, "no_agr": 24.0, "schur": 23.0, "cholesky": 22.0}
    runs = [
        run("7dgs_noagr" if name == "no_agr" else "7dgs", s, (v, v + s / 10), variant=f"ablation={name}")
        for name, v in values.items()
        for s in range(3)
    ]
    table = pairs(*runs, run("7dgs", 0, (99.0, 99.0), variant="ablation=schur,iterations=9000"))
    assert {row["pair"]: row["dB"] for row in table} == {
        "7dgs − 7dgs (ablation=cholesky)": pytest.approx(3.0),
        "7dgs − 7dgs (ablation=schur)": pytest.approx(2.0),
        "7dgs − 7dgs_noagr (ablation=no_agr)": pytest.approx(1.0),
    }


def test_models_that_share_no_scene_are_no_pair_and_a_tie_has_no_winner():
    """Catches a comparison of different scenes, and a winner that is called by the order of names."""
    assert pairs(run("a", scene="x"), run("b", scene="y"), lost(run("c"))) == []
    (tie,) = pairs(*(run(m, s, (20.0 + s, 21.0 + s)) for m in ("a", "b") for s in range(3)))
    assert (tie["dB"], tie["p_holm"], tie["ahead"], tie["significant"]) == (0.0, 1.0, 50.0, "no")


def test_the_probability_of_improvement_by_hand():
    """Catches pairing by seed alone: runs of a (1, 3) and b (2, 0) on a view: 1 > 0, 3 > 2, 3 > 0 of four are 0.75."""
    arrays = stats.grids(chapter(run("a", 0, (1.0,)), run("a", 1, (3.0,)), run("b", 0, (2.0,)), run("b", 1, (0.0,))))
    assert stats.improvement(arrays, ("a", ""), ("b", "")) == 0.75
    assert stats.improvement(arrays, ("b", ""), ("a", "")) == 0.25
    assert math.isnan(stats.improvement(arrays, ("a", ""), ("c", "")))


def test_all_comparisons_of_a_report_are_corrected_together():
    """Catches sections that correct for their own comparisons: the best model in a budget is ahead, the pair is not.

    A difference that two sections ask for, with either sign, counts once.
    """
    near = {"a": 0.0, "b": -0.25, "c": -0.5, "d": -0.75, "e": -1.0}
    random = np.random.default_rng(3)
    runs = []
    for of in frontier(("7dgs",), ("suzanne",), 3, (1000,)):
        for model, less in near.items():
            views = [dataclasses.replace(v, psnr=25 + less + 0.3 * random.normal()) for v in of.per_view]
            psnr = float(np.mean([v.psnr for v in views]))
            changed = {"per_view": views, "metrics": {**of.metrics, "psnr": psnr}, "curve": [Point(1000, 9.0, psnr)]}
            runs.append(dataclasses.replace(of, model=model, **changed))
    tests = of_report.tested(chapter(*runs))
    of_psnr = tests[tests.quantity == "psnr_db"]
    assert (of_psnr.comparisons == 10).all(), "ten pairs of five models; budgets ask for some of them again"
    table = {row["pair"]: row for row in sections(*runs)["pairs"].table.to_dict("records")}
    ahead = {name for name, row in table.items() if name.startswith("a") and row["significant"] == "yes"}
    assert ahead < {name for name, row in table.items() if name.startswith("a") and row["low"] > 0}
    assert sections(*runs)["budgets"].table["better than"].iloc[1] == len(ahead)


# ---- effects


def test_the_price_of_effects_by_hand():
    """Catches a wrong sign or cell: time alone 4, with direction 6, so x direction 2; with AGR 3."""
    table = sections(*with_effects(*EIGHT))["effects"].table.set_index("effect")
    assert len(table) == 12 + 3 + 6 + 1
    expected = {"time alone": 4.0, "time, with direction": 6.0, "AGR, with time and direction": 2.0,
                "time, mean over the others": (4 + 6 + 4.5 + 7.5) / 4, "time × direction": 2.0,
                "time × direction, with AGR": 3.0, "time × direction × AGR": 1.0}  # fmt: skip
    assert {name: table.dB[name] for name in expected} == {name: pytest.approx(v) for name, v in expected.items()}
    assert table["training s"]["time alone"] == pytest.approx(40.0)
    assert table["computed from"]["time × direction"] == "3dgs + 7dgs_noagr − 4dgs − 6dgs"


def test_missing_cells_are_not_guessed_and_a_second_model_is_left_out():
    """Catches an effect that is priced from models nobody ran, or from another model than the published one."""
    extra = [dataclasses.replace(r, model="3dgs_new") for r in with_effects("3dgs")]
    section = sections(*with_effects("3dgs", "4dgs", "6dgs", "7dgs_noagr", "7dgs"), *extra)["effects"]
    assert list(section.table.effect) == ["time alone", "time, with direction", "direction alone",
        "direction, with time", "AGR, with time and direction", "time × direction"]  # fmt: skip
    assert section.table["computed from"][0] == "4dgs − 3dgs"
    assert any("3 of 8 combinations" in note for note in section.notes)
    assert any("3dgs_new" in note for note in section.notes)


def test_effects_are_priced_within_one_parametrisation_too():
    """Catches a nested price computed across parametrisations, or one that replaces the published price."""
    less = [
        dataclasses.replace(
            r, model="7dgs_nodir", per_view=[dataclasses.replace(v, psnr=v.psnr + 2) for v in r.per_view]
        )
        for r in with_effects("4dgs")
    ]
    published = with_effects("3dgs", "4dgs", "6dgs", "7dgs_noagr", "7dgs")
    table = sections(*published, *less)["effects"].table
    nested = table[table.effect.str.endswith("nested")].set_index("computed from").dB.to_dict()
    assert nested == {"7dgs_nodir − 3dgs": pytest.approx(6.0), "7dgs_noagr − 7dgs_nodir": pytest.approx(1.0)}
    alone = sections(*published)["effects"].table
    pd.testing.assert_series_equal(table.dB[: len(alone)], alone.dB)


# ---- budgets and the frontier


def test_the_frontier_rises_and_leaves_out_what_is_dominated():
    """Catches a frontier through dominated points, one that is not sorted by cost, and equals that dominate."""
    of = points(chapter(*three_lengths()), ["suzanne"])
    a = of[of.series == "a"]
    assert a.train_s[stats.is_on_frontier(a, "train_s")].tolist() == [10.0, 40.0]
    assert set(of.variant[stats.is_dominated(of, "train_s")]) == {"iterations=2", ""}
    assert of.series[stats.is_dominated(of, "train_s")].tolist() == ["a", "b"]
    equal = points(chapter(*runs_of("a", "", 20.0, 10.0), *runs_of("b", "", 20.0, 10.0)), ["suzanne"])
    assert not stats.is_dominated(equal, "train_s").any()
    assert stats.is_on_frontier(equal, "train_s").sum() == 1


def test_a_point_is_the_mean_of_its_scenes():
    """Catches a configuration that has not finished a scene and is averaged over fewer."""
    of = chapter(*runs_of("a", "", 20.0, 10.0), *runs_of("a", "", 30.0, 30.0, scene="x"), *runs_of("b", "", 20.0, 10.0))
    (point,) = points(of, ["suzanne", "x"]).to_dict("records")
    assert (point["series"], point["psnr_db"], point["train_s"]) == ("a", 25.0, 20.0)
    assert basis(of) == ["suzanne"]


def test_a_budget_buys_the_best_that_costs_at_most_that():
    """Catches a choice over the budget, and one that exists where nothing is cheap enough."""
    table = sections(*three_lengths())["budgets"].table.set_index("budget")
    assert table.model.tolist()[:3] == ["a", "a", "b"]
    assert table.variant.tolist()[:3] == ["", "iterations=4", "iterations=9"]
    assert pd.isna(table.model["60 frames a second"]), "a frame takes 50 ms"


def test_a_choice_is_made_on_val_and_shown_on_test():
    """Catches the best of many configurations chosen by the very number that is shown: a has more on test, b on val."""
    a, b = runs_of("a", "", 21.0, 10.0), runs_of("b", "", 20.0, 10.0)
    a = [dataclasses.replace(r, curve=[Point(1000, 10.0, 19.0)]) for r in a]
    first = contests(chapter(*a, *b))["1 min of training"].iloc[0]
    assert (first.series, first.psnr_db) == ("b", 20.0)
    without = [dataclasses.replace(r, curve=[]) for r in b]
    assert contests(chapter(*a, *without))["1 min of training"].series.iloc[0] == "a"


def test_a_choice_counts_what_is_undecided():
    """Catches a winner within the noise of the seeds that is called significant: the interval of a - b holds zero."""
    of_seeds = {"a": (25.0, 25.0, 25.0), "b": (24.2, 25.1, 25.1), "c": (20.0, 20.1, 20.2)}
    runs = [
        run(m, s, (v, v), metrics={**make().metrics, "psnr": v}, curve=[])
        for m, values in of_seeds.items()
        for s, v in enumerate(values)
    ]
    row = sections(*runs)["budgets"].table.iloc[2]
    assert (row.model, row["better than"], row.undecided, row.untested) == ("a", 1, 1, 0)
    row = sections(*three_lengths())["budgets"].table.iloc[2]
    assert (row.model, row["better than"], row.undecided, row.untested) == ("b", 0, 0, 1)


def test_a_gated_run_has_a_curve_of_its_own():
    """Catches a run with another gate that is taken for the model's default."""
    plain = dataclasses.replace(frontier(("7dgs",), lengths=(2000,))[0], variant="")
    config = {**plain.provenance.config, "effects": {"gate": "both"}}
    provenance = dataclasses.replace(plain.provenance, config=config)
    gated = dataclasses.replace(plain, variant="gate=both,iterations=2000", provenance=provenance, per_view=[])
    assert set(points(chapter(plain, gated), ["suzanne"]).series) == {"7dgs", "7dgs, gate=both"}


def test_a_run_beside_other_work_is_counted():
    """Catches a load that is compared without the CPU-seconds of the run itself."""
    cost = run().cost
    quiet, busy = (run(seed=s, cost=dataclasses.replace(cost, load=load, train_s=100.0, train_cpu_s=150.0))
                   for s, load in ((0, 1.9), (1, 2.1)))  # fmt: skip
    assert is_beside_others(chapter(quiet, busy).runs).tolist() == [False, True]


def test_seconds_of_another_machine_are_nowhere():
    """Catches one table that still averages over two machines: those of seed 2 are a thousand times as slow."""
    runs = frontier(("3dgs", "7dgs"), ("suzanne",), 3, (1000,))
    runs += on_demand([r for r in runs if r.model == "7dgs"])

    def elsewhere(r):
        slow = {"train_s": 77777.0, "stage_s": {"slice": 77777.0}, "render_ms": RenderTimes(7777.0, 7777.0, 7777.0)}
        cost = dataclasses.replace(r.cost, train_cpu_s=77777.0, load=777.0, **slow)
        chosen = r.on_demand
        if chosen:
            gates = [dataclasses.replace(g, frame_ms_before=7777.0, frame_ms=7777.0) for g in chosen.gates]
            chosen = dataclasses.replace(chosen, gates=gates, screen=dataclasses.replace(chosen.screen, seconds=7777.0))
        curve = [Point(p.iteration, 77777.0, p.psnr_val) for p in r.curve]
        other = dataclasses.replace(r.provenance, device="another CPU")
        return dataclasses.replace(r, provenance=other, cost=cost, curve=curve, on_demand=chosen)

    for section in of_report.built(chapter(*(elsewhere(r) if r.seed == 2 else r for r in runs))):
        numbers = section.table.select_dtypes("number")
        numbers = numbers.drop(columns=["gaussians", "gaussians ±", "before"], errors="ignore").to_numpy(float)
        assert not (numbers[np.isfinite(numbers)] > 2000).any(), section.key
        assert "777" not in " ".join(section.notes)


# ---- curves and targets


def test_targets_are_round_numbers_and_never_is_an_answer():
    """Catches an interpolated time, a target on test, and a model that never reaches it but gets a number."""
    table = targets(chapter(*three_lengths(), *runs_of("3dgs", "", 19.0, 5.0))).set_index("target")
    assert table.dB.tolist() == [20.0, 22.0, 24.0]
    assert table.loc["20 dB", ["3dgs", "a", "b"]].tolist() == [math.inf, 10.0, 15.0]
    assert table.loc["24 dB", ["3dgs", "a", "b"]].tolist() == [math.inf, math.inf, 100.0]


def test_the_time_to_a_target_is_read_from_the_curve():
    """Catches the seconds of a whole training in every row, a target that one seed has and the mean has not, and one
    that a curve had before it fell."""
    at = {"rises": (18.0, 21.0, 22.4, 24.6), "falls": (20.5, 22.5, 21.5, 19.0)}
    runs = [
        dataclasses.replace(r, curve=[Point(100 * i, 10.0 * i, p + noise) for i, p in enumerate(curve, 1)])
        for name, curve in at.items()
        for seed, noise in ((0, 0.5), (1, -0.7))
        for r in runs_of(name, "", curve[-1], 40.0, (seed,))
    ]
    table = targets(chapter(*runs)).set_index("dB")
    assert table.rises.to_dict() == {20.0: 20.0, 22.0: 30.0, 24.0: 40.0}
    assert table.falls.to_dict() == {20.0: 10.0, 22.0: 20.0, 24.0: math.inf}
    kept = [dataclasses.replace(r, length_choice=LengthChoice(1000 * (r.seed + 1), [])) for r in runs]
    assert mean_curves(chapter(*kept)).empty, "seeds of several lengths have no mean curve"


@BY_HAND(
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
    assert round_numbers(low, high) == expected


@BY_HAND(("dataset", "size", "expected"), [("D-NeRF", "400x400", [30.72]), ("mini", "400x400", []),
                                           ("D-NeRF", "80x80", [])])  # fmt: skip
def test_the_papers_number_is_a_target_only_on_its_own_images(dataset, size, expected):
    """Catches the paper's 30.72 dB of trex as a target of a stand-in of that name, and of images of another size."""
    protocol = {**make().protocol, "paper_dataset": "D-NeRF", "background": "black", "resolution": size}
    runs = [
        dataclasses.replace(r, dataset=dataset, protocol=protocol) for r in runs_of("a", "", 31.0, 10.0, (0,), "trex")
    ]
    table = targets(chapter(*runs))
    assert table.dB[table.target.str.contains("paper")].tolist() == expected


def test_the_profile_by_hand():
    """Catches ratios to the wrong model: a is fastest on one target of two, within a factor of 3 on both."""
    of = profiles(pd.DataFrame({"a": [10.0, 30.0], "b": [20.0, 10.0], "c": [math.nan, math.inf]}))
    shares = {name: dict(zip(rows.factor, rows.share, strict=True)) for name, rows in of.groupby("series")}
    assert (shares["a"][1.0], shares["a"][3.0]) == (50.0, 100.0)
    assert (shares["b"][1.0], shares["b"][2.0]) == (50.0, 100.0)
    assert set(shares["c"].values()) == {0.0}
    assert profiles(pd.DataFrame({"a": [math.inf]})).empty


def test_events_have_the_steps_of_the_schedule():
    """Catches events of the schedule's default length, AGR's start for a model without it, and a crash at old keys."""
    train = {"iterations": 1000, "recipe_iterations": 1000, "refine_from": 250, "lambda_from": 750}
    train |= {"densify": {"start": 100, "stop": 500}}
    config = {"train": train, "model": {"lr": {"lambda": {"start": 0.1}}}}
    record = dataclasses.replace(make(), provenance=dataclasses.replace(make().provenance, config=config))
    steps = {letter: step for step, letters in events(record) for letter in letters}
    assert {"A", "D", "L"} <= steps.keys()
    assert steps["A"] == 250
    assert "A" not in "".join(letters for _, letters in events(dataclasses.replace(record, effects=EFFECTLESS)))
    old = dataclasses.replace(record.provenance, config={"train": {"no_such_key": 1}})
    assert events(dataclasses.replace(record, provenance=old)) == []


EFFECTLESS = make("3dgs").effects


# ---- other sections


def test_the_kept_length_is_the_one_before_val_falls():
    """Catches the length that is best on test, or the last one tried."""
    psnr = {500: (20.0, 20.0), 1000: (21.0, 22.0), 2000: (23.0, 21.0), 4000: (24.0, 30.0)}  # test, val
    runs = [
        run("a", 0, (test,), variant="" if n == 1000 else f"iterations={n}", curve=[Point(n, 9.0, val)],
            provenance=dataclasses.replace(run().provenance, config={"train": {"iterations": n}}))
        for n, (test, val) in psnr.items()
    ]  # fmt: skip
    (row,) = by_length(chapter(*runs).runs).to_dict("records")
    assert (row["kept"], row["tried"]) == (21.0, 3500)
    assert sections(*runs)["lengths"].table["4,000 rank"].tolist() == [1]


def test_gaussians_by_effect_set_are_means_over_seeds():
    """Catches a gate in training that is counted twice, a change with the wrong sign, and time kept by the screen."""
    plain = frontier(("7dgs",), ("suzanne",), 3, (1000,))
    (row,) = sections(*plain, *on_demand(plain))["on_demand"].table.to_dict("records")
    assert (row["seeds"], row["gated"], row["screen"]) == (3, 3, "on 3")
    assert (row["refined"], row["removed"], row["degree 3"]) == (310, 290, 210)
    assert row["before"] == 310 + 150 + 40 + 10 + 200 + 290
    assert row["dB"] == pytest.approx(-0.03)
    assert row["ms"] == pytest.approx(-1.0)
    assert "on_demand" not in sections(*plain)


def test_stages_add_up_to_the_training():
    """Catches a rest that is lost, and a stage of a model that another one lacks."""
    runs = frontier(("3dgs", "7dgs"), ("suzanne",), 2, (1000,))
    more = [dataclasses.replace(r, cost=dataclasses.replace(r.cost, train_s=r.cost.train_s + 1.0)) for r in runs]
    table = sections(*more)["stages"].table
    assert table.other.tolist() == pytest.approx([1.0, 1.0])
    assert table.drop(columns=["model", "total"]).sum(axis=1).tolist() == pytest.approx(table.total.tolist())


def test_settings_that_differ_within_a_scene_are_a_warning():
    """Catches rows of two protocols side by side without a word, and a warning where only scenes differ."""
    a, b = run("a"), run("b")
    table = sections(a, dataclasses.replace(b, protocol={**b.protocol, "downscale": 2}))["protocol"].table
    assert table.setting[table.note == "WARNING"].tolist() == ["downscale", "downscale"]
    assert "WARNING" not in sections(a, b)["protocol"].text
    by_scene = [run("a"), run("a", scene="x", protocol={**b.protocol, "downscale": 2})]
    assert not (sections(*by_scene)["protocol"].table.note == "WARNING").any()
    dirty = dataclasses.replace(a.provenance, git_commit="0123-dirty")
    assert any("dirty" in note for note in sections(dataclasses.replace(a, provenance=dirty))["protocol"].notes)


def test_every_run_is_listed_with_its_command():
    """Catches a point that cannot be repeated, and words that a shell would take apart."""
    odd = run("a", overrides=["scene.name=a b;rm", "seed=0"])
    table = sections(odd, lost(run("b")))["runs"].table
    assert table.run.tolist() == ["mini/suzanne/b/seed0", "mini/suzanne/a/seed0"]
    assert table.command[1] == "python -m gsbench 'scene.name=a b;rm' seed=0"
    assert table.reason[0] == "out of memory"


# ---- the result table


def test_averages_are_over_the_scenes_that_all_models_finished():
    """Catches a mean of other scenes than those of the model beside it."""
    runs = [run("a", scene="x", views=(20.0,)), run("a", scene="y", views=(30.0,)), run("b", scene="x", views=(21.0,)),
            lost(run("b", scene="y"))]  # fmt: skip
    rows = table(chapter(*runs), []).table
    average = rows[rows.scene == "average over 1 of 2 scenes"]
    assert average.psnr_db.tolist() == [20.0, 21.0]
    assert "b seed 0: failed" in rows.model.tolist()


def test_a_missing_metric_makes_the_mean_missing():
    """Catches a mean over the seeds that have a number, beside models whose seeds all have one."""
    gone = run("a", 1, metrics={**make().metrics, "ssim": None}, missing={"ssim": "too small"})
    section = table(chapter(run("a", 0), gone), [])
    assert section.shown()["SSIM"].tolist() == ["–"]
    assert any("SSIM: too small" in note for note in section.notes)


@BY_HAND(
    ("values", "places"),
    [
        ([(20.0,), (22.0,), (21.0,)], [0, 1, 2]),
        ([(22.001,), (22.004,), (21.0,)], [1, 1, 2]),  # they look equal
        ([(20.0, 20.1, 20.2), (20.1, 20.0, 20.3), (18.0, 18.1, 18.2)], [1, 1, 2]),
        ([(20.0, 22.0, 24.0), (20.1, 22.1, 24.1)], [2, 1]),  # paired: always ahead by 0.1
        ([(21.0, 21.0), (math.nan, 30.0)], [1, 0]),
        ([(math.nan,)], [0]),
    ],
)
def test_ties_are_decided_by_the_interval_of_the_paired_difference(values, places):
    """Catches ranks by the mean alone, by overlapping intervals, and a row that is best though a seed has no number."""
    rows = [(f"m{i}", "x", seed, v) for i, of in enumerate(values) for seed, v in enumerate(of)]
    runs = pd.DataFrame(rows, columns=["label", "scene", "seed", "q"])
    assert list(stats.ranks(runs, "label", "q", True, "{:.2f}".format).values()) == places
    low = stats.ranks(runs.assign(q=-runs.q), "label", "q", False, "{:.2f}".format)
    assert list(low.values()) == places


def test_the_papers_rows_stand_below_their_models():
    """Catches the paper's row below another model, without "other data" where the scene is a stand-in, or ranked."""
    rows = table(chapter(*records()), []).table
    at = rows.index[rows.model.str.startswith("paper")]
    assert rows.model[at].tolist() == ["paper, other data"] * 2
    assert rows.model[at - 1].tolist() == ["4dgs", "7dgs"]
    assert not rows["psnr_db rank"][at].fillna(0).any()
