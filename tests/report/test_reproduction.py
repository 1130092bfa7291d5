"""Two folders of records side by side: what agrees, what differs, what is undecided, and why."""

import dataclasses
import json
import math

import numpy as np
import pandas as pd
import pytest
from records import but, frontier, lost, on_demand, results, write_all

from gsbench.measure.machine import Hardware
from gsbench.report import reproduction
from gsbench.report.__main__ import main
from gsbench.report.reproduction import AGREES, DIFFERS, LIMITS, TITLES, UNDECIDED, compare, reasons, sections, summary

SEEDS = (0, 1, 2)
WIDE = "the interval is too wide: more seeds are needed"
SINGLE = "one run of each model on both sides: no spread over seeds is known"
REFERENCE_ONLY = "only the reference folder has it"


def runs(*seeds, change=lambda r: r, **more):
    """Runs of five models on two scenes, the seeds 0.1 dB apart by standard deviation; each is changed."""
    of = frontier(seeds=1 + max(seeds), **{"lengths": (1000,)} | more)
    return [change(r) for r in of if r.seed in seeds]


def moved(r, psnr):
    views = [dataclasses.replace(view, psnr=view.psnr + psnr) for view in r.per_view]
    return but(r, metrics={"psnr": r.metrics["psnr"] + psnr}, per_view=views)


def by(psnr, *more):
    """Move the PSNR of each run, by its seed if there are several numbers."""
    return lambda r: moved(r, (psnr, *more)[r.seed] if more else psnr)


def apart(r):
    """Move a run so that seeds differ by decibels and by a third of the Gaussians."""
    return moved(but(r, cost={"num_gaussians": 6000 + 2000 * r.seed}), (2.0, -2.0, 1.0)[r.seed])


def of_one(change):
    """Change the runs of one model on one scene alone."""
    return lambda r: change(r) if (r.model, r.scene) == ("7dgs", "suzanne") else r


def reproduced(new, reference):
    return compare(results(*new), results(*reference))


def reason(of, quantity):
    rows = of.of(quantity)
    (text,) = rows.reason[(rows.model == "3dgs") & (rows.scene == "suzanne")]
    return text


def late(r):
    return moved(apart(r), 0.001 * r.seed)


def better(r):
    return moved(NOISY(r), 0.7)


NOISY = by(0.6, -0.7, 0.1)
THREE = runs(*SEEDS)
ONE_NOISY = runs(*SEEDS, change=of_one(by(1.0, -2.0, 1.5)))
ONE_LOST = runs(*SEEDS, change=lambda r: lost(r) if r.model == "7dgs" else r)
SHORTER = runs(*SEEDS, change=lambda r: but(r, provenance={"config": {"train": {"iterations": 5}}}))
OTHER_DATA = runs(*SEEDS, change=lambda r: but(r, provenance={"data_hash": "77"}))
ROUNDED = runs(*SEEDS, change=lambda r: but(r, protocol={"quantise": True}))
OTHERWISE = "measured otherwise: quantise True instead of False"
OTHER_LENGTH = "another training: train.iterations"
OTHER_LENGTHS = {REFERENCE_ONLY: 10} | {f"{OTHER_LENGTH} {n} instead of 1000": 10 for n in (250, 500)}
APART = {REFERENCE_ONLY: 2, "only the new folder has it": 2}
NOISY_THREE = runs(*SEEDS, change=NOISY)
# New runs, reference runs; verdict on PSNR, runs that are bit-equal, of how many; why undecided.
CASES = {
    "equal": (runs(0), THREE, AGREES, (10, 10), {}),
    "equal bits whatever the spread": (runs(0, change=apart), runs(*SEEDS, change=apart), AGREES, (10, 10), {}),
    "a seed on one side": (runs(*SEEDS, change=apart), runs(0, 1, change=apart), AGREES, (20, 20), {}),
    "equal bits of a few runs": (runs(0, 1, change=late), runs(*SEEDS, change=apart), UNDECIDED, (10, 20), {WIDE: 10}),
    "other seeds": (runs(0), runs(1, 2, 3), AGREES, (0, 0), {}),
    "a run where another seed would lie": (runs(0, change=by(0.7)), NOISY_THREE, AGREES, (0, 10), {}),
    "a run far off": (runs(0, change=by(-5.0)), NOISY_THREE, DIFFERS, (0, 10), {}),
    "a mean of two, whose interval is wide": (runs(0, 1, change=better), NOISY_THREE, UNDECIDED, (0, 20), {WIDE: 10}),
    "one run on each side": (runs(0, change=by(0.3)), runs(0), UNDECIDED, (0, 10), {SINGLE: 10}),
    "one equal run on each side": (runs(0), runs(0), AGREES, (10, 10), {}),
    "one model better": (runs(0, change=of_one(by(1.5))), THREE, DIFFERS, (9, 10), {}),
    "one model worse": (runs(0, change=of_one(by(-1.5))), THREE, DIFFERS, (9, 10), {}),
    "a noisy model by its spread": (runs(0, change=of_one(by(-3.0))), ONE_NOISY, UNDECIDED, (9, 10), {WIDE: 1}),
    "another training": (SHORTER, THREE, UNDECIDED, (0, 0), {f"{OTHER_LENGTH} 5 instead of 1000": 10}),
    "other data": (OTHER_DATA, THREE, UNDECIDED, (0, 0), {"other data": 10}),
    "renders through 8 bits": (ROUNDED, THREE, UNDECIDED, (0, 0), {OTHERWISE: 10}),
    "other lengths": (runs(0, lengths=(250, 500)), THREE, UNDECIDED, (0, 0), OTHER_LENGTHS),
    "not finished": (ONE_LOST, THREE, UNDECIDED, (24, 24), {"no new run finished": 2}),
    "nothing in common": (runs(0, models=("3dgs",)), runs(0, models=("7dgs",)), UNDECIDED, (0, 0), APART),
}


@pytest.mark.parametrize(("new", "reference", "verdict", "bit_equal", "why"), CASES.values(), ids=CASES)
def test_verdicts(new, reference, verdict, bit_equal, why):
    """Catches equal bits that are undecided or that speak for other runs, a spread over seeds that is called a
    difference, a difference that passes, and a verdict on numbers that measure something else."""
    of = reproduced(new, reference)
    assert (of.verdict, (of.seeds.bit_equal.sum(), len(of.seeds))) == (verdict, bit_equal)
    rows = reasons(of).set_index("reason")
    assert rows["models on scenes"][rows.quantities.str.contains("PSNR|all")].to_dict() == why


def test_the_model_that_differs_is_named():
    """Catches a model that trains to another quality on this machine and passes for the published one."""
    of = reproduced(runs(0, change=of_one(by(1.5))), runs(*SEEDS))
    (row,) = of.of("psnr_db", DIFFERS).to_dict("records")
    assert (row["model"], row["scene"]) == ("7dgs", "suzanne")
    assert list(summary(of).quantity) == list(TITLES)
    counted = summary(of).set_index("quantity").loc["psnr_db"].to_dict()
    expected = {"agrees": 9, "differs": 1, "largest": pytest.approx(row["difference"]), "on": "7dgs on suzanne"}
    assert counted.items() >= expected.items()


@pytest.mark.parametrize("changes", [{"num_gaussians": 1}, {"bytes": 1}, None])
def test_runs_of_equal_psnr_and_other_gaussians_are_not_bit_equal(changes):
    """Catches bits that are told from PSNR alone, and views whose PSNR differs in the last digit."""

    def changed(r):
        views = [dataclasses.replace(view, psnr=math.nextafter(view.psnr, 99)) for view in r.per_view[:1]]
        return but(r, cost=changes) if changes else but(r, per_view=[*views, *r.per_view[1:]])

    assert not reproduced(runs(0, change=changed), runs(*SEEDS)).seeds.bit_equal.any()


@pytest.mark.parametrize("quantity", ["gaussians", "model_mb", "train_s", "frame_ms"])
def test_other_seeds_agree_in_what_is_compared_by_percent(quantity):
    """Catches a spread of 10 to 20 % over seeds that is called a difference, or whose unit is lost."""

    def spread(*factors):
        def change(r):
            by = factors[r.seed] * (1 + 0.02 * len(r.model))
            times = dataclasses.replace(r.cost.render_ms, p50=by * r.cost.render_ms.p50)
            cost = {"num_gaussians": round(4000 * by), "bytes": round(by * r.cost.bytes)}
            return but(r, cost=cost | {"train_s": by * r.cost.train_s, "render_ms": times})

        return runs(*SEEDS, change=change)

    of = reproduced(spread(1.0, 1.2, 1.12), spread(0.9, 1.02, 0.98))
    assert set(of.of(quantity).verdict) == {AGREES}
    row = of.of(quantity).iloc[0]
    assert 0.1 < row.difference / row.reference < 0.2
    assert (row.high - row.difference) / row.reference == pytest.approx(0.16, abs=0.02)


def test_seconds_are_compared_on_one_machine_alone():
    """Catches a stranger's seconds that differ from ours, those of a machine that had other work, and bits of another
    machine that are not compared, and machines in an order that changes from call to call."""
    machine = {"hardware": Hardware("Invented CPU", 2, 24, "25", "1", "1", "v3")}
    of = reproduced(runs(*SEEDS, change=lambda r: but(r, provenance=machine)), runs(*SEEDS))
    assert (of.verdict, of.seeds.bit_equal.sum()) == (AGREES, 30)
    assert {verdict for name in ("train_s", "frame_ms") for verdict in of.of(name).verdict} == {UNDECIDED}
    named = "other machines: Invented CPU family 25 model 1 stepping 1, 2 cores, v3, 24 GiB, 2 threads instead of"
    assert named in reason(of, "train_s")
    several = pd.DataFrame({"machine": [*"gdbaecf"]})
    named = "other machines: x instead of a; b; c; d; e; f; g"
    assert reproduction._other_machine(pd.DataFrame({"machine": ["x"]}), several) == named
    busy = reproduced(runs(*SEEDS, change=lambda r: but(r, cost={"load": r.cost.load + 1})), runs(*SEEDS))
    assert "the machine had other work: load 4.0 instead of 3.0" in reason(busy, "train_s")
    slow = reproduced(runs(*SEEDS, change=lambda r: but(r, cost={"train_s": 2 * r.cost.train_s})), runs(*SEEDS))
    assert (len(slow.of("train_s", DIFFERS)), slow.verdict) == (10, AGREES)


@pytest.mark.parametrize("seed", range(12))
def test_the_numbers_of_any_two_folders_add_up(seed):
    """Catches a crash, a row that is lost, and one that is counted twice."""
    random = np.random.default_rng(seed)
    prefix = "a" * 90 if seed % 3 == 0 else ""
    runs_of_both = (*frontier(seeds=3, lengths=(250, 1000)), *on_demand(runs(0, 1)))
    pool = [but(r, model=prefix + r.model) for r in runs_of_both]

    def folder():
        kept = [pool[i] for i in random.permutation(len(pool))[: random.integers(1, len(pool))]]
        changed = [
            lambda r: moved(r, random.normal()),
            lost,
            lambda r: r,
            lambda r: but(r, cost={"num_gaussians": 9}),
            lambda r: but(r, provenance={"data_hash": "7"}),
        ]
        return [changed[random.integers(len(changed))](r) for r in kept]

    new, reference = folder(), folder()
    of = reproduced(new, reference)
    assert len(of.seeds) <= len({r.path for r in new} & {r.path for r in reference})
    rows = len(of.of("psnr_db"))
    assert (summary(of)[[AGREES, DIFFERS, UNDECIDED]].sum(axis=1) == rows).all()
    assert len(sections(of, "published")[0].table) == rows
    groups = {(r.model, r.variant, r.scene) for r in (*new, *reference)}
    assert rows + len(of.unmatched) == len(groups)
    assert len(of.table) == rows * len(LIMITS)


def test_the_command(tmp_path, capsys):
    """Catches an exit status, a last line, a JSON and a page that do not say what the comparison came to, and a name of
    a data set or a machine that colours the terminal or writes the line anew."""
    new, reference = write_all(runs(0), tmp_path / "ours"), write_all(runs(*SEEDS), tmp_path / "published")
    before = {path: path.read_bytes() for path in reference.rglob("*") if path.is_file()}
    words = [str(new), "--against", str(reference), "--json", str(tmp_path / "a.json")]
    assert main(words) == 0
    out = capsys.readouterr().out
    assert out.splitlines()[-1] == f"Report: {new / 'report.html'}"
    assert f"PSNR agrees, against {reference}" in out
    written = json.loads((tmp_path / "a.json").read_text())
    assert (written["verdict"], written["summary"][0]["agrees"]) == (AGREES, 10)
    assert [len(written["runs"][side]) for side in ("new", "reference")] == [10, 30]
    assert all(run in written["runs"]["reference"] for run in written["runs"]["new"])
    row = next(r for r in written["rows"] if (r["model"], r["scene"], r["quantity"]) == ("7dgs", "suzanne", "psnr_db"))
    assert (row["bit_equal"], row["difference"], row["low"]) == (True, 0.0, None)
    assert f"Against {reference}" in (new / "report.html").read_text()
    assert {path: path.read_bytes() for path in reference.rglob("*") if path.is_file()} == before
    hostile = {"provenance": {"device": "\x1b[31m\nowned"}, "dataset": "x\x1b\ny"}
    for name in ("ours", "same"):
        write_all(runs(0, change=lambda r: but(moved(r, 2.0), **hostile)), tmp_path / name)
    assert main([str(new), "--against", str(tmp_path / "same")]) == 0
    assert "\x1b" not in capsys.readouterr().out
    for folder in (new, tmp_path / "ours"):
        assert main([str(new), "--against", str(folder)]) == 2
        assert "expected other runs than those of" in capsys.readouterr().err
    write_all(runs(0, change=by(2.0)), tmp_path / "ours")
    assert main(words) == 1
    rows = [row for row in json.loads((tmp_path / "a.json").read_text())["rows"] if row["quantity"] == "psnr_db"]
    assert all(row["low"] < row["difference"] < row["high"] for row in rows)
    assert main([str(new), "--against", str(tmp_path / "nowhere")]) == 2
    assert "expected a folder of results" in capsys.readouterr().err
