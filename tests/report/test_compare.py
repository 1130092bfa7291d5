"""Pairs, the probability of improvement and the price of effects, on records with numbers worked by hand."""

import dataclasses
import math

import pytest
from make_golden import make

from gsbench.measure.record import Effects, ViewScore
from gsbench.measure.speed import RenderTimes
from gsbench.report import compare
from gsbench.report.comparisons import comparisons
from gsbench.report.configurations import groups


def run(model="7dgs", seed=0, views=(25.0, 26.0), scene="suzanne", seconds=90.0, **changes):
    """A run with the PSNR of its views, and its mean as the metric."""
    base = make("7dgs", scene, seed, sum(views) / len(views))
    scores = [ViewScore(f"test/r_{i:03}", value) for i, value in enumerate(views)]
    cost = dataclasses.replace(base.cost, train_s=seconds)
    return dataclasses.replace(base, **{"model": model, "per_view": scores, "cost": cost} | changes)


def group(*runs):
    (only,) = groups(list(runs))
    return only


def pairs(of):
    return compare.pairs(of, comparisons(of))


def cube(of):
    return compare.cube(of, comparisons(of))


def test_a_pair_is_compared_on_common_seeds_and_views():
    """Catches a mean over views that only one model has, and a seed without a partner: (2 + 0.5) / 2 = 1.25 dB."""
    found = pairs(
        group(
            run("a", 0, (20.0, 30.0, 99.0)),
            run("a", 5, (90.0, 90.0)),
            run("b", 0, (22.0, 30.5)),
        )
    )
    (pair,) = found
    assert (pair.better.model, pair.other.model) == ("b", "a")
    assert pair.difference.mean == pytest.approx(1.25)
    assert math.isnan(pair.difference.low)
    assert math.isnan(pair.p_holm)
    assert not pair.differs


def test_a_run_that_failed_in_a_view_has_no_pair():
    """Catches a model whose PSNR is not a number in a view, compared without this view although its mean is empty."""
    broken = run("a", 0, (20.0, 30.0))
    scores = [dataclasses.replace(broken.per_view[0], psnr=None), broken.per_view[1]]
    broken = dataclasses.replace(
        broken, per_view=scores, metrics={"psnr": None}, missing={"psnr": "not a number in test/r_000"}
    )
    assert pairs(group(broken, run("b", 0, (22.0, 29.0)))) == []


def test_only_the_common_variant_is_compared():
    """Catches a short run of one model that meets a long run of another."""
    runs = [run(m, s, (v, v + s / 10)) for m, v in (("a", 20.0), ("b", 21.0)) for s in range(3)]
    found = pairs(group(*runs, run("a", 0, (99.0, 99.0), variant="iterations=9000")))
    assert [(p.better.name, p.other.name) for p in found] == [("b", "a")]
    assert found[0].difference.mean == pytest.approx(1.0)
    assert found[0].differs


def test_ablations_are_compared_with_the_whole_model_alone():
    """Catches a page of ablations that compares none of them, or all with one another, and Holm over those pairs."""
    values = {"none": 25.0, "no_agr": 24.0, "schur": 23.0, "cholesky": 22.0}
    one = group(
        *(
            run("7dgs_noagr" if name == "no_agr" else "7dgs", s, (v, v + s / 10), variant=f"ablation={name}")
            for name, v in values.items()
            for s in range(3)
        ),
        run("7dgs", 0, (99.0, 99.0), variant="ablation=schur,iterations=9000"),
    )
    assert one.variant == "ablation=none"
    found = pairs(one)
    assert [one.label(p.better) for p in found] == ["7dgs"] * 3
    assert [one.label(p.other) for p in found] == [
        "7dgs (ablation=cholesky)",
        "7dgs (ablation=schur)",
        "7dgs_noagr (ablation=no_agr)",
    ]
    assert [p.difference.mean for p in found] == pytest.approx([3.0, 2.0, 1.0])


def test_models_that_share_no_scene_are_no_pair():
    """Catches a comparison of different scenes, and a crash where a model finished nothing."""
    failed = run("c", status="failed", reason="out of memory", metrics=None, missing={}, cost=None, per_view=[])
    assert pairs(group(run("a", scene="x"), run("b", scene="y"), failed)) == []


def test_models_that_tie_have_no_difference():
    """Catches a winner that is called by the order of names."""
    runs = [run(m, s, (20.0 + s, 21.0 + s)) for m in ("a", "b") for s in range(3)]
    (pair,) = pairs(group(*runs))
    assert (pair.difference.mean, pair.difference.p, pair.improvement) == (0.0, 1.0, 0.5)
    assert not pair.differs


def test_the_probability_of_improvement_by_hand():
    """Catches pairing by seed alone: runs of a (1, 3) and b (2, 0) on a view: 1 > 0, 3 > 2, 3 > 0 of four are 0.75."""
    pair = group(run("a", 0, (1.0,)), run("a", 1, (3.0,)), run("b", 0, (2.0,)), run("b", 1, (0.0,)))
    a, b = pair.main_configurations
    assert compare.improvement(pair, a, b) == 0.75
    assert compare.improvement(pair, b, a) == 0.25


EIGHT = {  # name: effects (time, direction, AGR), dB
    "3dgs": ((0, 0, 0), 20.0),
    "4dgs": ((1, 0, 0), 24.0),
    "6dgs": ((0, 1, 0), 21.0),
    "7dgs_noagr": ((1, 1, 0), 27.0),
    "3dgs_agr": ((0, 0, 1), 20.5),
    "4dgs_agr": ((1, 0, 1), 25.0),
    "6dgs_agr": ((0, 1, 1), 21.5),
    "7dgs": ((1, 1, 1), 29.0),
}


def cells(*names, seeds=range(3)):
    return [
        run(
            name,
            seed,
            (EIGHT[name][1] + seed / 100, EIGHT[name][1] + 1),
            seconds=10 * EIGHT[name][1] + seed,
            effects=Effects(*map(bool, EIGHT[name][0])),
        )
        for name in names
        for seed in seeds
    ]


def test_the_price_of_effects_by_hand():
    """Catches a wrong sign or cell: time alone 4, with direction 6, so x direction 2; with AGR 3."""
    full = cube(group(*cells(*EIGHT)))
    psnr = {price.name: price.costs["psnr"].mean for price in full.prices}
    assert len(psnr) == 12 + 3 + 6 + 1
    assert not full.missing
    assert psnr["time alone"] == pytest.approx(4.0)
    assert psnr["time, with direction"] == pytest.approx(6.0)
    assert psnr["AGR, with time and direction"] == pytest.approx(2.0)
    assert psnr["time, mean over the others"] == pytest.approx((4 + 6 + 4.5 + 7.5) / 4)
    assert psnr["time × direction"] == pytest.approx(2.0)
    assert psnr["time × direction, with AGR"] == pytest.approx(3.0)
    assert psnr["time × direction × AGR"] == pytest.approx(1.0)
    seconds = {price.name: price.costs["seconds"].mean for price in full.prices}
    assert seconds["time alone"] == pytest.approx(40.0)


def test_missing_cells_are_said_and_not_guessed():
    """Catches an effect that is priced from cells nobody ran: the five published models fill five of eight."""
    found = cube(group(*cells("3dgs", "4dgs", "6dgs", "7dgs_noagr", "7dgs")))
    assert found.missing == ["AGR", "direction + AGR", "time + AGR"]
    assert [price.name for price in found.prices] == [
        "time alone",
        "time, with direction",
        "direction alone",
        "direction, with time",
        "AGR, with time and direction",
        "time × direction",
    ]
    assert found.prices[0].models == "4dgs − 3dgs"
    assert found.prices[-1].models == "3dgs + 7dgs_noagr − 4dgs − 6dgs"


def test_a_second_model_with_the_same_effects_is_left_out_and_named():
    """Catches a cell that is silently another model than the published one."""
    extra = [dataclasses.replace(r, model="3dgs_new") for r in cells("3dgs")]
    found = cube(group(*extra, *cells("3dgs", "4dgs")))
    assert found.left_out == ["3dgs_new"]
    assert found.prices[0].models == "4dgs − 3dgs"


def test_effects_are_priced_within_one_parametrisation_too():
    """Catches a nested price computed across parametrisations, or one that replaces the published price."""
    less = [
        dataclasses.replace(
            r, model="7dgs_nodir", per_view=[dataclasses.replace(v, psnr=v.psnr + 2) for v in r.per_view]
        )
        for r in cells("4dgs")
    ]
    published = cells("3dgs", "4dgs", "6dgs", "7dgs_noagr", "7dgs")
    found = cube(group(*published, *less))
    assert found.prices == cube(group(*published)).prices
    assert {p.models: p.costs["psnr"].mean for p in found.nested} == {
        "7dgs_nodir − 3dgs": pytest.approx(6.0),
        "7dgs_noagr − 7dgs_nodir": pytest.approx(1.0),
    }
    assert found.left_out == []
    alone = cube(group(*[r for r in published if r.model != "4dgs"], *less))
    assert alone.nested == []
    assert "7dgs_noagr − 7dgs_nodir" in {p.models for p in alone.prices}


def test_seconds_of_another_machine_do_not_count():
    """Catches seconds of two machines in one difference."""
    runs = cells("3dgs", "4dgs")
    other = dataclasses.replace(runs[-1].provenance, device="another CPU")
    moved = [*runs[:-1], dataclasses.replace(runs[-1], provenance=other)]
    found = group(*moved)
    (price,) = cube(found).prices
    assert found.elsewhere == 1
    assert price.costs["seconds"].seeds == 2
    assert price.costs["psnr"].seeds == 3


def test_bytes_and_milliseconds_are_read():
    """Catches a unit that is off: a million bytes is 1 MB, the median of the render times is the ms of a frame."""
    one = run(cost=dataclasses.replace(run().cost, bytes=2_500_000, render_ms=RenderTimes(1.0, 2.0, 3.0)))
    found = group(one)
    assert (found.value(one, "mb"), found.value(one, "ms")) == (2.5, 2.0)
