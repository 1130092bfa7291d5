"""Two folders of records side by side: what agrees, what differs, what is undecided, and why."""

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
from records import frontier, on_demand

from gsbench.measure import record as files
from gsbench.measure.machine import Hardware
from gsbench.measure.record import Record
from gsbench.report.__main__ import main
from gsbench.report.frame import Results, tables
from gsbench.report.reproduction import (
    AGREES,
    DIFFERS,
    LIMITS,
    UNDECIDED,
    Reproduction,
    compare,
    reasons,
    sections,
    summary,
)


def runs(seeds=3, **more: object) -> list[Record]:
    """Runs of five models on two scenes, the seeds 0.1 dB apart by standard deviation."""
    return frontier(seeds=seeds, lengths=(1000,), **more)


def as_tables(records: list[Record]) -> Results:
    return tables([(Path(str(i)), record) for i, record in enumerate(records)], [])


def reproduced(ours: list[Record], theirs: list[Record]) -> Reproduction:
    return compare(as_tables(ours), as_tables(theirs))


def moved(record: Record, psnr: float) -> Record:
    return dataclasses.replace(record, metrics=record.metrics | {"psnr": record.metrics["psnr"] + psnr})


def costing(record: Record, **changes: object) -> Record:
    return dataclasses.replace(record, cost=dataclasses.replace(record.cost, **changes))


def measured_by(record: Record, **changes: object) -> Record:
    return dataclasses.replace(record, provenance=dataclasses.replace(record.provenance, **changes))


LOST = {"status": "failed", "reason": "out of memory", "metrics": None, "missing": {}, "cost": None}


def verdicts(of: Reproduction, quantity: str) -> set[str]:
    return set(of.of(quantity).verdict)


def reason(of: Reproduction, quantity: str, model: str = "3dgs", scene: str = "suzanne") -> str:
    rows = of.of(quantity)
    (text,) = rows.reason[(rows.model == model) & (rows.scene == scene)]
    return text


def counted(of: Reproduction, quantity: str = "psnr_db") -> dict[str, object]:
    """The row of a quantity in the summary."""
    return summary(of).set_index("quantity").loc[quantity].to_dict()


def why(of: Reproduction) -> dict[str, int]:
    """How many models on scenes are not compared or undecided in PSNR, by the reason."""
    rows = reasons(of).set_index("reason")
    return rows["models on scenes"][rows.quantities.str.contains("PSNR|all")].to_dict()


def equal_seeds(of: Reproduction) -> tuple[int, int]:
    """How many runs are bit-equal with the reference run of their seed, and how many have one."""
    return int(of.seeds.bit_equal.sum()), len(of.seeds)


def test_the_same_numbers_agree():
    """Catches a comparison that cannot even tell that nothing differs."""
    of = reproduced(runs(seeds=1), runs())
    assert of.verdict == AGREES
    counts = {"agrees": 10, "differs": 0, "undecided": 0, "bit-equal": 10, "percent": 0.0}
    assert counted(of).items() >= counts.items()
    assert equal_seeds(of) == (10, 10)
    assert why(of) == {}
    assert verdicts(of, "gaussians") == verdicts(of, "model_mb") == {AGREES}


def spread_out(seeds: int) -> list[Record]:
    """Runs of models whose seeds differ by decibels and by a third of the Gaussians."""
    apart = {0: 2.0, 1: -2.0, 2: 1.0}
    return [moved(costing(r, num_gaussians=6000 + 2000 * r.seed), apart[r.seed]) for r in runs(seeds=seeds)]


def test_bits_agree_whatever_the_spread_of_seeds():
    """Catches equal bits that are undecided because seeds differ by decibels, statistics of runs that are equal, and
    equal bits of a few runs that speak for another."""
    of = reproduced(spread_out(1), spread_out(3))
    assert [verdicts(of, quantity) for quantity in ("psnr_db", "gaussians", "model_mb")] == [{AGREES}] * 3
    assert set(of.of("psnr_db").difference) == {0.0}
    assert set(of.seeds.seed) == {0}
    assert of.seeds.bit_equal.all()
    more = reproduced(spread_out(3), spread_out(2))  # seed 2 is in one folder only
    assert more.verdict == AGREES
    assert equal_seeds(more) == (20, 20)
    ours = [moved(r, 0.001) if r.seed == 1 else r for r in spread_out(2)]
    other = reproduced(ours, spread_out(3))
    assert equal_seeds(other) == (10, 20)
    assert other.verdict == UNDECIDED


@pytest.mark.parametrize("changes", [{"num_gaussians": 1}, {"bytes": 1}])
def test_runs_of_equal_psnr_and_other_gaussians_are_not_bit_equal(changes):
    """Catches bits that are told from PSNR alone, and views whose PSNR differs in the last digit."""
    ours = [costing(r, **changes) for r in runs(seeds=1)]
    assert not reproduced(ours, runs()).seeds.bit_equal.any()
    views = [dataclasses.replace(r.per_view[0], psnr=math.nextafter(r.per_view[0].psnr, 99)) for r in runs(seeds=1)]
    ours = [dataclasses.replace(r, per_view=[v, *r.per_view[1:]]) for r, v in zip(runs(seeds=1), views, strict=True)]
    assert not reproduced(ours, runs()).seeds.bit_equal.any()


def test_a_single_run_agrees_where_another_seed_would_lie():
    """Catches one seed that can never agree with three as these are too far apart, and one that always does."""
    noisy = {0: 0.6, 1: -0.7, 2: 0.1}
    theirs = [moved(r, noisy[r.seed]) for r in runs()]
    near, far, beyond = (reproduced([moved(r, psnr) for r in runs(seeds=1)], theirs) for psnr in (0.7, 1.4, -5.0))
    assert (
        (near.table.high - near.table.difference)[near.table.quantity == "psnr_db"].gt(LIMITS.widest["psnr_db"]).all()
    )
    assert near.verdict == AGREES
    assert UNDECIDED in verdicts(far, "psnr_db")
    assert "the interval is too wide: more seeds are needed" in why(far)
    assert beyond.verdict == DIFFERS
    pairs = [moved(r, 0.7 + noisy[r.seed]) for r in runs(seeds=2)]
    assert reproduced(pairs, theirs).verdict == UNDECIDED  # two runs have a mean, whose interval is too wide


def test_other_seeds_agree():
    """Catches a spread over seeds that is called a difference."""
    of = reproduced([r for r in runs() if r.seed == 0], [r for r in runs(seeds=4) if r.seed])
    assert (of.verdict, len(of.of("psnr_db"))) == (AGREES, 10)


@pytest.mark.parametrize("psnr", [-1.5, 1.5])
def test_one_model_that_differs_is_found(psnr):
    """Catches a model that trains to another quality on this machine and passes for the published one."""
    ours = [moved(r, psnr if (r.model, r.scene) == ("7dgs", "suzanne") else 0) for r in runs() if r.seed == 0]
    of = reproduced(ours, runs())
    assert of.verdict == DIFFERS
    assert of.of("psnr_db", DIFFERS)[["model", "scene"]].to_numpy().tolist() == [["7dgs", "suzanne"]]
    assert equal_seeds(of) == (9, 10)
    counts = {"agrees": 9, "differs": 1, "percent": pytest.approx(of.of("psnr_db", DIFFERS).difference.iloc[0])}
    assert counted(of).items() >= (counts | {"on": "7dgs on suzanne"}).items()


@pytest.mark.parametrize("quantity", ["gaussians", "model_mb", "train_s", "frame_ms"])
def test_other_seeds_agree_in_what_is_compared_by_percent(quantity):
    """Catches a spread of 10 to 20 % over seeds that is called a difference, or whose unit is lost: means of thousands
    of Gaussians and of thousandths of a second."""

    def spread(r: Record, *factors: float) -> Record:
        by = factors[r.seed] * (1 + 0.02 * len(r.model))
        times = dataclasses.replace(r.cost.render_ms, p50=by * r.cost.render_ms.p50)
        return costing(r, num_gaussians=round(4000 * by), bytes=round(by * r.cost.bytes), train_s=by * r.cost.train_s,
                       render_ms=times)  # fmt: skip

    ours = [spread(r, 1.0, 1.2, 1.12) for r in runs()]
    of = reproduced(ours, [spread(r, 0.9, 1.02, 0.98) for r in runs()])
    assert verdicts(of, quantity) == {AGREES}
    row = of.of(quantity).iloc[0]
    assert 0.1 < row.difference / row.reference < 0.2
    assert (row.high - row.difference) / row.reference == pytest.approx(0.16, abs=0.02)


def test_one_run_on_each_side_cannot_be_told():
    """Catches a verdict without any knowledge of the spread over seeds; equal numbers need none."""
    ours = [moved(r, 0.3) for r in runs(seeds=1)]
    of = reproduced(ours, runs(seeds=1))
    assert of.verdict == UNDECIDED
    assert why(of)["one run of each model on both sides: no spread over seeds is known"] == 10
    assert reproduced(runs(seeds=1), runs(seeds=1)).verdict == AGREES


def test_a_noisy_model_is_held_against_its_own_spread():
    """Catches a model whose seeds differ by 2 dB and that differs by the calm of the others."""
    noisy = {0: 1.0, 1: -2.0, 2: 1.5}
    theirs = [moved(r, noisy[r.seed]) if (r.model, r.scene) == ("7dgs", "suzanne") else r for r in runs()]
    ours = [moved(r, -3.0) if (r.model, r.scene) == ("7dgs", "suzanne") else r for r in runs(seeds=1)]
    of = reproduced(ours, theirs)
    assert of.of("psnr_db", DIFFERS).empty
    assert reason(of, "psnr_db", "7dgs") == "the interval is too wide: more seeds are needed"


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"config": {"train": {"iterations": 500}}}, "another training: train.iterations 500 instead of 1000"),
        ({"data_hash": "77"}, "other data"),
    ],
)
def test_other_trainings_and_data_are_not_compared(changes, reason):
    """Catches a verdict on numbers that measure something else."""
    of = reproduced([measured_by(r, **changes) for r in runs()], runs())
    assert of.verdict == UNDECIDED
    assert all(verdicts(of, quantity) == {UNDECIDED} for quantity in LIMITS.index)
    assert why(of) == {reason: 10}


def test_another_length_is_said_to_be_one():
    """Catches a shorter training that is "not in both", and one that is not told beside runs that are compared."""
    short = frontier(seeds=1, lengths=(250, 500))
    lengths = {f"another training: train.iterations {n} instead of 1000": 10 for n in (250, 500)}
    assert why(reproduced(short, runs())) == lengths | {"only the reference folder has it": 10}
    assert why(reproduced([*short, *runs(seeds=1)], runs())) == lengths


def test_measured_otherwise_is_not_compared():
    """Catches PSNR of renders through 8 bits beside that of floats."""
    ours = [dataclasses.replace(r, protocol=r.protocol | {"quantise": True}) for r in runs()]
    assert why(reproduced(ours, runs())) == {"measured otherwise: quantise True instead of False": 10}


def test_seconds_are_compared_on_one_machine_alone():
    """Catches a stranger's seconds that differ from ours, and those of a machine that had other work."""
    here = Hardware("Invented CPU", 2, 24, "25", "1", "1", "v3")
    of = reproduced([measured_by(r, hardware=here) for r in runs()], runs())
    assert of.verdict == AGREES
    assert verdicts(of, "train_s") == verdicts(of, "frame_ms") == {UNDECIDED}
    named = "other machines: Invented CPU family 25 model 1 stepping 1, 2 cores, v3, 24 GiB, 2 threads instead of"
    assert named in reason(of, "train_s")
    busy = reproduced([costing(r, load=r.cost.load + 1) for r in runs()], runs())
    assert "the machine had other work: load 4.0 instead of 3.0" in reason(busy, "train_s")
    slow = reproduced([costing(r, train_s=2 * r.cost.train_s) for r in runs()], runs())
    assert verdicts(slow, "train_s") == {DIFFERS}
    assert counted(slow, "train_s")["differs"] == 10
    assert slow.verdict == AGREES  # in PSNR


def test_what_is_not_in_both_is_named():
    """Catches a model that is missing here and is not missed, and folders that have nothing in common."""
    of = reproduced([r for r in runs() if r.model != "4dgs"], [r for r in runs() if r.model != "6dgs"])
    assert of.unmatched[["model", "scene", "reason"]].to_numpy().tolist() == [
        [model, scene, f"only the {side} folder has it"]
        for scene in ("moving-matte", "suzanne")
        for model, side in (("4dgs", "reference"), ("6dgs", "new"))
    ]
    none = reproduced(runs(models=("3dgs",)), runs(models=("7dgs",)))
    assert none.verdict == UNDECIDED
    assert len(none.table) == 0
    assert [section.key for section in sections(none, "published")] == ["against", "undecided", "verdict"]


def test_a_run_that_did_not_finish_is_said():
    """Catches a crash, and a failure here that is not said."""
    ours = [dataclasses.replace(r, **LOST) if r.model == "7dgs" else r for r in runs()]
    of = reproduced(ours, runs())
    assert of.verdict == UNDECIDED
    assert equal_seeds(of) == (24, 24)
    assert (counted(of)["agrees"], counted(of)["undecided"]) == (8, 2)
    assert why(of) == {"no new run finished": 2}


@pytest.mark.parametrize("seed", range(30))
def test_the_numbers_of_any_two_folders_add_up(seed):
    """Catches a crash, a row that is lost, and one that is counted twice."""
    random = np.random.default_rng(seed)
    pool = [
        dataclasses.replace(r, **({"model": "a" * 90 + r.model} if seed % 3 == 0 else {}))
        for r in (*frontier(seeds=3, lengths=(250, 1000)), *on_demand(runs(seeds=2)))
    ]

    def folder() -> list[Record]:
        kept = [pool[i] for i in random.permutation(len(pool))[: random.integers(1, len(pool))]]
        changed = [lambda r: moved(r, random.normal()), lambda r: dataclasses.replace(r, **LOST), lambda r: r,
                   lambda r: costing(r, num_gaussians=9), lambda r: measured_by(r, data_hash="7")]  # fmt: skip
        return [changed[random.integers(len(changed))](r) for r in kept]

    ours, theirs = folder(), folder()
    of = reproduced(ours, theirs)
    shared = {r.path for r in ours} & {r.path for r in theirs}
    assert len(of.seeds) <= len(shared)
    rows = len(of.of("psnr_db"))
    assert (summary(of)[[AGREES, DIFFERS, UNDECIDED]].sum(axis=1) == rows).all()
    assert len(sections(of, "published")[0].table) == rows
    groups = {(r.model, r.variant, r.scene) for r in (*ours, *theirs)}
    assert rows + len(of.unmatched) == len(groups)


def write(records: list[Record], folder: Path) -> Path:
    for r in records:
        files.write(r, folder / r.path.relative_to(r.path.parts[0]) / files.FILE_NAME)
    return folder


def test_the_command(tmp_path, capsys):
    """Catches an exit status, a last line, a JSON and a page that do not say what the comparison came to."""
    ours, theirs = write(runs(seeds=1), tmp_path / "ours"), write(runs(), tmp_path / "published")
    before = {path: path.read_bytes() for path in theirs.rglob("*") if path.is_file()}
    assert main([str(ours), "--against", str(theirs), "--json", str(tmp_path / "a.json")]) == 0
    out = capsys.readouterr().out
    assert out.splitlines()[-1] == f"Report: {ours / 'report.html'}"
    assert f"PSNR agrees, against {theirs}" in out
    written = json.loads((tmp_path / "a.json").read_text())
    assert (written["verdict"], written["summary"][0]["agrees"]) == (AGREES, 10)
    assert [len(written["runs"][side]) for side in ("new", "reference")] == [10, 30]
    assert all(run in written["runs"]["reference"] for run in written["runs"]["new"])
    row = next(r for r in written["rows"] if (r["model"], r["scene"], r["quantity"]) == ("7dgs", "suzanne", "psnr_db"))
    assert (row["bit_equal"], row["difference"], row["low"]) == (True, 0.0, None)
    page = (ours / "report.html").read_text()
    assert f"Against {theirs}" in page
    assert {path: path.read_bytes() for path in theirs.rglob("*") if path.is_file()} == before
    write([moved(r, 2.0) for r in runs(seeds=1)], ours)
    assert main([str(ours), "--against", str(theirs), "--json", str(tmp_path / "a.json")]) == 1
    rows = [row for row in json.loads((tmp_path / "a.json").read_text())["rows"] if row["quantity"] == "psnr_db"]
    assert all(row["low"] < row["difference"] < row["high"] for row in rows)
    assert main([str(ours), "--against", str(tmp_path / "nowhere")]) == 2
    assert "expected a folder of results" in capsys.readouterr().err


def test_text_from_a_record_cannot_break_the_comparison(tmp_path, capsys):
    """Catches a data set's name or a machine's that colours the terminal or writes the line anew."""
    bad = [measured_by(r, device="\x1b[31m\nowned") for r in runs(seeds=1)]
    folder = write([dataclasses.replace(r, dataset="x\x1b\ny") for r in bad], tmp_path / "ours")
    main([str(folder), "--against", str(folder)])
    assert "\x1b" not in capsys.readouterr().out
