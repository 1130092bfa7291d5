"""The numbers of a report's sections, on records with numbers worked by hand."""

import dataclasses
import math

import numpy as np
import pandas as pd
import pytest
from records import (
    EFFECTS,
    but,
    chapter,
    elsewhere,
    every_row,
    frontier,
    lost,
    make,
    on_demand,
    run,
    runs_of,
    sections,
    three_lengths,
    write_all,
)

from gsbench.measure.curve import Point
from gsbench.measure.images import write_png
from gsbench.measure.record import Candidate, LengthChoice, ModelComparison, OnDemand, Record, Region
from gsbench.measure.speed import RenderTimes
from gsbench.report import frame, stats
from gsbench.report import sections as of_report
from gsbench.report.sections.budgets import basis, contests, is_beside_others, points
from gsbench.report.sections.curves import mean_curves, round_numbers, targets
from gsbench.report.sections.experiment import table
from gsbench.report.sections.lengths import by_length

DB = {"3dgs": 20.0, "4dgs": 24.0, "6dgs": 21.0, "7dgs_noagr": 27.0, "7dgs": 29.0}


def with_effects(*names):
    """Three seeds of models of DB with their effects."""
    return [
        but(run(name, seed, (DB[name] + seed / 100, DB[name] + 1)), effects=EFFECTS[name])
        for name in names
        for seed in range(3)
    ]


def at(model, *, views=1, **changes):
    """Three seeds of a model with views of a PSNR, the seeds apart by their number / 10 in the second view."""
    return [run(model, s, (views, views + s / 10), **changes) for s in range(3)]


def pairs(*runs):
    section = sections(*runs).get("pairs")
    return [] if section is None else section.table.to_dict("records")


# ---- pairs


def test_a_pair_is_compared_on_common_seeds_and_views():
    """Catches a mean over views that only one model has, a seed without a partner: (2 + 0.5) / 2 = 1.25 dB, and a run
    that failed in a view, compared without this view although its mean is empty."""
    (pair,) = pairs(run("a", 0, (20.0, 30.0, 99.0)), run("a", 5, (90.0, 90.0)), run("b", 0, (22.0, 30.5)))
    assert (pair["pair"], pair["significant"], pair["dB"]) == ("b − a", "unknown", pytest.approx(1.25))
    assert all(math.isnan(pair[name]) for name in ("low", "p_holm"))
    whole = run("a", 0, (20.0, 30.0))
    views = [dataclasses.replace(whole.per_view[0], psnr=None), whole.per_view[1]]
    broken = but(whole, per_view=views, metrics={"psnr": None}, missing={"psnr": "no number"})
    assert pairs(broken, run("b", 0, (22.0, 29.0))) == []


def test_only_the_settings_of_most_models_are_compared():
    """Catches a short run of one model that meets a long one of another, and ablations that are compared with none, or
    all with one another, so that Holm counts those pairs too."""
    (pair,) = pairs(*at("a", views=20.0), *at("b", views=21.0), run("a", 0, (99.0, 99.0), variant="iterations=9000"))
    assert (pair["pair"], pair["significant"], pair["dB"]) == ("b − a", "yes", pytest.approx(1.0))
    values = {"none": 25.0, "no_agr": 24.0, "schur": 23.0, "cholesky": 22.0}
    runs = [
        of
        for name, psnr in values.items()
        for of in at("7dgs_noagr" if name == "no_agr" else "7dgs", views=psnr, variant=f"ablation={name}")
    ]
    rows = pairs(*runs, run("7dgs", 0, (99.0, 99.0), variant="ablation=schur,iterations=9000"))
    assert {row["pair"]: row["dB"] for row in rows} == {
        "7dgs − 7dgs (ablation=cholesky)": pytest.approx(3.0),
        "7dgs − 7dgs (ablation=schur)": pytest.approx(2.0),
        "7dgs − 7dgs_noagr (ablation=no_agr)": pytest.approx(1.0),
    }


def test_models_that_share_no_scene_are_no_pair_and_a_tie_has_no_winner():
    """Catches a comparison of different scenes, and a winner that is called by the order of names."""
    assert pairs(run("a", scene="x"), run("b", scene="y"), lost(run("c"))) == []
    (tie,) = pairs(*(run(m, s, (20.0 + s, 21.0 + s)) for m in ("a", "b") for s in range(3)))
    assert (tie["dB"], tie["p_holm"], tie["ahead"], tie["significant"]) == (0.0, 1.0, 50.0, "no")


def test_all_comparisons_of_a_report_are_corrected_together():
    """Catches sections that correct for their own comparisons: the best model in a budget is ahead, the pair is not. A
    difference that two sections ask for, with either sign, counts once."""
    random = np.random.default_rng(3)
    runs = []
    for of in frontier(("7dgs",), ("suzanne",), 3, (1000,)):
        for model, less in {"a": 0.0, "b": -0.25, "c": -0.5, "d": -0.75, "e": -1.0}.items():
            views = [25 + less + 0.3 * random.normal() for _ in of.per_view]
            curve = [Point(1000, 9.0, float(np.mean(views)))]
            runs.append(run(model, of.seed, views, cost=of.cost, curve=curve))
    tests = of_report.tested(chapter(*runs))
    of_psnr = tests[tests.quantity == "psnr_db"]
    assert (of_psnr.comparisons == 10).all(), "ten pairs of five models; budgets ask for some of them again"
    rows = [row for row in pairs(*runs) if row["pair"].startswith("a")]
    ahead = {row["pair"] for row in rows if row["significant"] == "yes"}
    assert ahead < {row["pair"] for row in rows if row["low"] > 0}
    assert sections(*runs)["budgets"].table["better than"].iloc[1] == len(ahead)


# ---- effects


def test_an_effect_is_priced_from_published_models():
    """Catches an effect priced from models nobody ran or others than published, and one called nested that is not."""
    published = with_effects("3dgs", "4dgs", "6dgs", "7dgs_noagr", "7dgs")
    section = sections(*published, *(but(r, model="3dgs_new") for r in with_effects("3dgs")))["effects"]
    priced = dict(zip(section.table.effect, section.table.dB, strict=True))
    expected = {"time alone": 4.0, "time, with direction": 6.0, "direction alone": 1.0, "direction, with time": 3.0}
    expected |= {"AGR, with time and direction": 2.0, "time × direction": 2.0}
    assert priced == pytest.approx(expected)
    assert section.table["computed from"].iloc[-1] == "3dgs + 7dgs_noagr − 4dgs − 6dgs"
    table = sections(*published, *(but(r, model="7dgs_nodir") for r in with_effects("4dgs")))["effects"].table
    nested = table["computed from"][table.effect.str.endswith(", nested")]
    assert nested.tolist() == ["7dgs_nodir − 3dgs", "7dgs_noagr − 7dgs_nodir"]
    for part in ("3 of 8 combinations", "3dgs_new"):
        assert any(part in note for note in section.notes)


# ---- budgets and the frontier


def test_a_point_is_the_mean_of_its_scenes():
    """Catches a configuration that has not finished a scene and is averaged over fewer."""
    of = chapter(*runs_of("a", "", 20.0, 10.0), *runs_of("a", "", 30.0, 30.0, scene="x"), *runs_of("b", "", 20.0, 10.0))
    (point,) = points(of, ["suzanne", "x"]).to_dict("records")
    assert (point["series"], point["psnr_db"], point["train_s"]) == ("a", 25.0, 20.0)
    assert basis(of) == ["suzanne"]


def test_of_two_equals_neither_is_dominated_and_one_is_on_the_frontier():
    """Catches equals that dominate each other, and a frontier that has both."""
    equal = points(chapter(*runs_of("a", "", 20.0, 10.0), *runs_of("b", "", 20.0, 10.0)), ["suzanne"])
    assert not stats.is_dominated(equal, "train_s").any()
    assert stats.is_on_frontier(equal, "train_s").sum() == 1


def test_a_budget_buys_the_best_on_val():
    """Catches the best of many configurations chosen by the very number that is shown: a has more on test, b on val."""
    a, b = runs_of("a", "", 21.0, 10.0), runs_of("b", "", 20.0, 10.0)
    a = [dataclasses.replace(r, curve=[Point(1000, 10.0, 19.0)]) for r in a]
    without = [dataclasses.replace(r, curve=[]) for r in b]
    first, of_test = (contests(chapter(*a, *of))["1 min of training"].iloc[0] for of in (b, without))
    assert (first.series, first.psnr_db, of_test.series) == ("b", 20.0, "a")
    assert pd.isna(sections(*a)["budgets"].table.model.iloc[-1]), "a frame takes 50 ms"


def test_a_choice_counts_what_is_undecided():
    """Catches a winner within the noise of the seeds that is called significant: the interval of a - b holds zero."""
    of_seeds = {"a": (25.0, 25.0, 25.0), "b": (24.2, 25.1, 25.1), "c": (20.0, 20.1, 20.2)}
    runs = [run(m, s, (v, v), curve=[]) for m, values in of_seeds.items() for s, v in enumerate(values)]
    for records, expected in ((runs, ("a", 1, 1, 0)), (three_lengths(), ("b", 0, 0, 1))):
        row = sections(*records)["budgets"].table.iloc[2]
        assert (row.model, row["better than"], row.undecided, row.untested) == expected


def test_a_run_beside_other_work_is_counted():
    """Catches a load that is compared without the CPU-seconds of the run itself."""
    runs = [
        but(run(seed=s), cost={"load": load, "train_s": 100.0, "train_cpu_s": 150.0})
        for s, load in ((0, 1.9), (1, 2.1))
    ]
    assert is_beside_others(chapter(*runs).runs).tolist() == [False, True]


def test_seconds_of_another_machine_are_nowhere():
    """Catches one table that still averages over two machines: those of seed 2 are a thousand times as slow."""
    runs = frontier(("3dgs", "7dgs"), ("suzanne",), 3, (1000,))
    runs += on_demand([r for r in runs if r.model == "7dgs"])

    def elsewhere(r):
        chosen = r.on_demand and dataclasses.replace(
            r.on_demand,
            gates=[dataclasses.replace(g, frame_ms_before=7777.0, frame_ms=7777.0) for g in r.on_demand.gates],
            screen=dataclasses.replace(r.on_demand.screen, seconds=7777.0),
        )
        slow = {"train_s": 77777.0, "stage_s": {"slice": 77777.0}, "train_cpu_s": 77777.0, "load": 777.0}
        slow |= {"render_ms": RenderTimes(7777.0, 7777.0, 7777.0)}
        curve = [Point(p.iteration, 77777.0, p.psnr_val) for p in r.curve]
        return but(r, provenance={"device": "another CPU"}, cost=slow, curve=curve, on_demand=chosen)

    for section in of_report.built(chapter(*(elsewhere(r) if r.seed == 2 else r for r in runs))):
        numbers = section.table.select_dtypes("number")
        numbers = numbers.drop(columns=["gaussians", "gaussians ±", "before"], errors="ignore").to_numpy(float)
        assert not (numbers[np.isfinite(numbers)] > 2000).any(), section.key
        assert "777" not in " ".join(section.notes)


def test_runs_that_keep_all_effects_have_no_table_of_removed_ones():
    """Catches an empty table on the page of an experiment."""
    assert "on_demand" not in sections(run("7dgs"))


def test_the_candidates_of_a_choice_on_val_have_their_prices():
    """Catches a price of another candidate or machine, and a field that is more accurate at hidden costs."""
    choices = {
        0: [Candidate("7dgs", 30.0, 10.0, None, 1.0), Candidate("hexplane", 31.0, 90.0, None, 10.0)],
        1: [Candidate("7dgs", 30.4, 12.0, None, 3.0), Candidate("hexplane", 31.4, 90.0, "too slow", 12.0)],
        2: [Candidate("7dgs", 30.2, 777.0, None, 777.0), Candidate("hexplane", None, 777.0, "diverged")],
    }
    of = {
        seed: OnDemand(comparison=ModelComparison(700, "7dgs" if seed == 1 else "hexplane", tried))
        for seed, tried in choices.items()
    }
    runs = [but(run("auto", seed), on_demand=of[seed], provenance={"device": f"CPU {seed // 2}"}) for seed in of]
    table = sections(*runs, run("4dgs"))["candidates"].table.set_index("candidate")
    expected = {"7dgs": [30.2, 11.0, 2.0, 1, 3], "hexplane": [31.2, 90.0, 11.0, 2, 3]}
    for name, row in table[["psnr_val_db", "train_s", "frame_ms", "chosen", "seeds"]].iterrows():
        assert row.tolist() == pytest.approx(expected[name]), name
    assert table.why.dropna().to_dict() == {"hexplane": "too slow"}
    assert "candidates" not in sections(run("4dgs"))


# ---- curves and targets


def test_a_target_is_reached_by_the_mean_curve():
    """Catches an interpolated time, a target that one seed has and the mean has not, and one that was lost."""
    curves = {"rises": (18.0, 21.0, 22.4, 24.6), "falls": (20.5, 22.5, 21.5, 19.0)}
    runs = [
        dataclasses.replace(r, curve=[Point(100 * i, 10.0 * i, p + noise) for i, p in enumerate(curve, 1)])
        for name, curve in curves.items()
        for seed, noise in ((0, 0.5), (1, -0.7))
        for r in runs_of(name, "", curve[-1], 40.0, (seed,))
    ]
    rows = targets(chapter(*runs)).set_index("dB")
    assert rows.rises.to_dict() == {20.0: 20.0, 22.0: 30.0, 24.0: 40.0}
    assert rows.falls.to_dict() == {20.0: 10.0, 22.0: 20.0, 24.0: math.inf}
    kept = [dataclasses.replace(r, length_choice=LengthChoice(1000 * (r.seed + 1), [])) for r in runs]
    assert mean_curves(chapter(*kept)).empty, "seeds of several lengths have no mean curve"


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (20.0, 23.0, [21, 22, 23]),
        (24.1, 25.3, [24.2, 24.4, 24.6, 24.8, 25.0, 25.2]),
        (-0.1, 0.05, [0]),
        (0.0, 1e60, list(range(2, 101, 2))),
    ],
)
def test_targets_are_as_far_apart_as_gives_three(low, high, expected):
    """Catches a target at or below the lowest run, one above the highest, a dozen where three will do, and 1e60."""
    assert round_numbers(low, high) == expected


# ---- other sections


def test_the_kept_length_is_the_one_before_val_falls():
    """Catches the length that is best on test, or the last one tried."""
    psnr = {500: (20.0, 20.0), 1000: (21.0, 22.0), 2000: (23.0, 21.0), 4000: (24.0, 30.0)}  # test, val
    runs = [
        but(
            run("a", 0, (test,)),
            variant="" if n == 1000 else f"iterations={n}",
            curve=[Point(n, 9.0, val)],
            provenance={"config": {"train": {"iterations": n}}},
        )
        for n, (test, val) in psnr.items()
    ]
    (row,) = by_length(chapter(*runs).runs).to_dict("records")
    assert (row["kept"], row["tried"]) == (21.0, 3500)
    assert sections(*runs)["lengths"].table["4,000 rank"].tolist() == [1]


def test_settings_that_differ_within_a_scene_are_a_warning():
    """Catches rows of two protocols side by side without a word, a warning where only scenes differ, and a scene of the
    tuning that is shown as any other."""
    half = {"downscale": 2}
    rows = sections(run("a"), but(run("b"), protocol=half))["protocol"].table
    assert rows.setting[rows.note == "WARNING"].tolist() == ["downscale", "downscale"]
    assert "WARNING" not in sections(run("a"), run("b"))["protocol"].text
    by_scene = sections(run("a"), but(run("a", scene="x"), protocol=half))["protocol"].table
    assert not (by_scene.note == "WARNING").any()
    notes = [sections(run("a", scene=scene))["protocol"].notes for scene in ("hook", "x")]
    assert ["gsbench's own settings were tuned on hook (docs/tuning.md)." in of_scene for of_scene in notes] == [
        True,
        False,
    ]
    dirty = sections(but(run("a"), provenance={"git_commit": f"{run().provenance.git_commit}-dirty"}))
    assert any("dirty" in note for note in dirty["protocol"].notes)
    assert dirty["runs"].table.commit.tolist() == ["0123456789ab-dirty"]


def test_every_run_is_listed_with_its_command():
    """Catches a point that cannot be repeated, and words that a shell would take apart."""
    rows = sections(run("a", overrides=["scene.name=a b;rm", "seed=0"]), lost(run("b")))["runs"].table
    assert rows.run.tolist() == ["mini/suzanne/b/seed0", "mini/suzanne/a/seed0"]
    assert rows.command[1] == "python -m gsbench 'scene.name=a b;rm' seed=0"
    assert rows.reason[0] == "out of memory"


# ---- the result table


def test_averages_are_over_the_scenes_that_all_models_finished():
    """Catches a mean of other scenes than those of the model beside it."""
    runs = [
        run("a", scene="x", views=(20.0,)),
        run("a", scene="y", views=(30.0,)),
        run("b", scene="x", views=(21.0,)),
        lost(run("b", scene="y")),
    ]
    rows = table(chapter(*runs), []).table
    average = rows[rows.scene == "average over 1 of 2 scenes"]
    assert average.psnr_db.tolist() == [20.0, 21.0]
    assert "b seed 0: failed" in rows.model.tolist()


def test_a_missing_metric_makes_the_mean_missing():
    """Catches a mean over the seeds that have a number, beside models whose seeds all have one."""
    gone = but(run("a", 1), metrics={"ssim": None}, missing={"ssim": "too small"})
    section = table(chapter(run("a", 0), gone), [])
    assert section.shown()["SSIM"].tolist() == ["–"]
    assert any("SSIM: too small" in note for note in section.notes)


@pytest.mark.parametrize(
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
    for sign in (1, -1):
        ranks = stats.ranks(runs.assign(q=sign * runs.q), "label", "q", sign > 0, "{:.2f}".format)
        assert list(ranks.values()) == places


def test_the_papers_rows_stand_below_their_models():
    """Catches the paper's row below another model, without "other data" where the scene is a stand-in, or ranked."""
    rows = table(chapter(*every_row()), []).table
    places = rows.index[rows.model.str.startswith("paper")]
    assert rows.model[places].tolist() == ["paper, other data"] * 2
    assert rows.model[places - 1].tolist() == ["4dgs", "7dgs"]
    assert not rows["psnr_db rank"][places].fillna(0).any()


def test_the_papers_rows_are_explained_where_they_are():
    """Catches words on rows that a table does not have, as in a report on a capture of the user's own."""
    explained = sections(make("4dgs"))["experiment"].text
    assert "“paper, other data”" in explained
    assert "“paper”" not in explained
    assert "paper" not in sections(make("4dgs", "mine"))["experiment"].text


# ---- renders of other programs


def test_renders_of_another_program_are_compared_and_choose_nothing():
    """Catches renders without PSNR on val that make all models be chosen on test, that stand for a combination of
    effects or have stages, a warning of what no other program has, and a cell that is zero where nothing is known."""
    trained = [r for name in ("3dgs", "4dgs") for r in runs_of(name, "iterations=9", DB[name], 10.0, seeds=(0, 1))]
    trained = [but(r, effects=EFFECTS[r.model], cost={"stage_s": {"raster": 10.0}}) for r in trained]
    others = [elsewhere(r, "other", train_s=5.0, fps=50.0) for r in trained[:2]]
    before, shown = sections(*trained), sections(*trained, *others)
    row = shown["experiment"].table.set_index("model").loc["other"]
    assert (row.psnr_db, row.train_min, row.fps) == (pytest.approx(20.0075), 5 / 60, 50.0)
    assert math.isnan(row.gaussians)
    assert any("other: rendered elsewhere; 8-bit PNG, matched to" in note for note in shown["experiment"].notes)
    assert set(shown["pairs"].table.pair) == {"4dgs − 3dgs", "4dgs − other", "3dgs − other"}
    assert shown["budgets"].table.psnr_db.equals(before["budgets"].table.psnr_db)
    assert shown["effects"].table["computed from"].tolist() == before["effects"].table["computed from"].tolist()
    assert shown["stages"].table.model.tolist() == ["3dgs", "4dgs"]
    assert shown["frontier"].table.set_index("model").frame_ms["other"] == 20.0
    protocol = shown["protocol"].table
    assert set(protocol.setting[protocol.note == "WARNING"]) == {"images"}
    assert set(protocol.value[protocol.setting == "iterations"]) == {"1,000", "rendered elsewhere"}


def test_what_flickers_is_a_table_with_a_picture_of_each_model(tmp_path):
    """Catches a section without a film, another seed's picture, and a column that scenes without a film share."""

    def filmed(model: str, seed: int, value: float) -> Record:
        numbers = {"flicker": value, "static_drift": 1.0, "flicker_truth": 0.5}
        region = Region("images of one camera", 6, 0.25, "5e" * 32)
        return but(run(model, seed), metrics=numbers, regions={"static": region})

    others = [but(run("a", scene="x"), missing={"flicker": "needs a film"}, metrics={"flicker": None})]
    records = [filmed("a", 0, 2.0), filmed("a", 1, 3.0), filmed("b", 0, 4.0), *others]
    folder = write_all(records, tmp_path)
    for name, value in (("a/seed0", 1), ("a/seed1", 2), ("b/seed0", 3)):
        write_png(np.full((9, 9, 3), 80 * value, np.uint8), folder / "suzanne" / name / "flicker.png")
    (of_all,) = frame.load(folder).chapters()
    section = {of.key: of for of in of_report.built(of_all)}["flicker"]
    assert section.table[["model", "flicker", "seeds"]].to_numpy().tolist() == [["a", 2.5, 2], ["b", 4.0, 1]]
    assert [image.caption for image in section.images] == ["suzanne, a", "suzanne, b"]
    shown = sections(*records)["experiment"]
    assert shown.table.set_index(["scene", "model"]).flicker["suzanne", "b"] == 4.0
    assert "flicker: needs a film (x)" in shown.notes
    assert "suzanne: flicker is over 25.0 % of the pixels of 6 views, from images of one camera" in shown.notes
    assert "flicker" not in sections(run("a"))
