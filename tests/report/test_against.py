"""Two folders of records side by side: what agrees, what differs, what cannot be told, and why."""

import dataclasses
import json
from pathlib import Path
from statistics import fmean

import pytest
from make_golden import make
from many_records import frontier

from gsbench.errors import InputError
from gsbench.measure import record as files
from gsbench.measure.machine import Hardware
from gsbench.measure.record import Record
from gsbench.report.__main__ import main
from gsbench.report.against import AGREES, DIFFERS, LIMITS, UNTOLD, Comparison, compare
from gsbench.report.publish import publish


def runs(seeds=3, **more: object) -> list[Record]:
    """Runs of five models on two scenes, the seeds 0.1 dB apart by standard deviation."""
    return frontier(seeds=seeds, lengths=(1000,), **more)


def held(ours: list[Record], theirs: list[Record]) -> Comparison:
    return compare(ours, theirs, ("mine", "published"))


def moved(record: Record, psnr: float) -> Record:
    return dataclasses.replace(record, metrics=record.metrics | {"psnr": record.metrics["psnr"] + psnr})


def costing(record: Record, **changes: object) -> Record:
    return dataclasses.replace(record, cost=dataclasses.replace(record.cost, **changes))


def told(record: Record, **changes: object) -> Record:
    return dataclasses.replace(record, provenance=dataclasses.replace(record.provenance, **changes))


def verdicts(of: Comparison, quantity: str) -> set[str]:
    return {row.judged[quantity].verdict for row in of.rows}


def test_the_same_numbers_agree():
    """Catches a comparison that cannot even tell that nothing differs."""
    of = held(runs(seeds=1), runs())
    assert of.verdict == AGREES
    assert "PSNR agrees in 10 of 10 models on scenes" in of.line
    assert "of 10 equal seeds 10 end within 0.01 dB" in of.line
    assert verdicts(of, "gaussians") == verdicts(of, "mb") == {AGREES}


def test_other_seeds_agree():
    """Catches a spread over seeds that is called a difference."""
    of = held([r for r in runs() if r.seed == 0], [r for r in runs(seeds=4) if r.seed])
    assert (of.verdict, len(of.rows)) == (AGREES, 10)


@pytest.mark.parametrize("psnr", [-1.5, 1.5])
def test_one_model_that_differs_is_found(psnr):
    """Catches a model that trains to another quality on this machine and passes for the published one."""
    ours = [moved(r, psnr if (r.model, r.scene) == ("7dgs", "suzanne") else 0) for r in runs() if r.seed == 0]
    of = held(ours, runs())
    assert of.verdict == DIFFERS
    assert [(row.model, row.scene) for row in of.of("psnr", DIFFERS)] == [("7dgs", "suzanne")]
    assert "PSNR differs: 7dgs on suzanne" in of.line


@pytest.mark.parametrize("quantity", ["gaussians", "mb", "seconds", "ms"])
def test_other_seeds_agree_in_what_is_compared_by_percent(quantity):
    """Catches a spread of 10 to 20 % over seeds that is called a difference, or whose unit is lost: means of thousands
    of Gaussians and of thousandths of a second."""

    def spread(r: Record, *factors: float) -> Record:
        by = factors[r.seed] * (1 + 0.02 * len(r.model))
        times = dataclasses.replace(r.cost.render_ms, p50=by * r.cost.render_ms.p50)
        return costing(r, num_gaussians=round(4000 * by), bytes=round(by * r.cost.bytes), train_s=by * r.cost.train_s,
                       render_ms=times)  # fmt: skip

    ours = [spread(r, 1.0, 1.2, 1.12) for r in runs()]
    of = held(ours, [spread(r, 0.9, 1.02, 0.98) for r in runs()])
    assert verdicts(of, quantity) == {AGREES}
    row = of.rows[0].judged[quantity]
    assert 0.1 < row.difference.mean / fmean(row.theirs) < 0.2
    assert row.difference.half / fmean(row.theirs) == pytest.approx(0.13, abs=0.03)


def test_one_run_on_each_side_cannot_be_told():
    """Catches a verdict without any knowledge of the spread over seeds; equal numbers need none."""
    ours = [moved(r, 0.3) for r in runs(seeds=1)]
    of = held(ours, runs(seeds=1))
    assert of.verdict == UNTOLD
    assert "no spread over seeds is known" in of.line
    assert held(runs(seeds=1), runs(seeds=1)).verdict == AGREES


def test_a_noisy_model_is_held_against_its_own_spread():
    """Catches a model whose seeds differ by 2 dB and that is told apart by the calm of the others."""
    noisy = {0: 1.0, 1: -2.0, 2: 1.5}
    theirs = [moved(r, noisy[r.seed]) if (r.model, r.scene) == ("7dgs", "suzanne") else r for r in runs()]
    ours = [moved(r, -3.0) if (r.model, r.scene) == ("7dgs", "suzanne") else r for r in runs(seeds=1)]
    of = held(ours, theirs)
    assert of.of("psnr", DIFFERS) == []
    (row,) = [row for row in of.rows if (row.model, row.scene) == ("7dgs", "suzanne")]
    assert row.judged["psnr"].reason == "the interval is too wide: more seeds are needed"


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"config": {"train": {"iterations": 500}}}, "another training: train.iterations: 1000 there, 500 now"),
        ({"data_hash": "77"}, "other data"),
    ],
)
def test_other_trainings_and_data_are_not_compared(changes, why):
    """Catches a verdict on numbers that measure something else."""
    of = held([told(r, **changes) for r in runs()], runs())
    assert of.verdict == UNTOLD
    assert all(verdicts(of, quantity) == {UNTOLD} for quantity in LIMITS)
    assert why in of.line


def test_measured_otherwise_is_not_compared():
    """Catches PSNR of renders through 8 bits beside that of floats."""
    ours = [dataclasses.replace(r, protocol=r.protocol | {"quantise": True}) for r in runs()]
    assert "measured otherwise: quantise False there, True" in held(ours, runs()).line


def test_seconds_are_compared_on_one_machine_alone():
    """Catches a stranger's seconds told apart from ours, and those of a machine that had other work."""
    here = Hardware("Invented CPU", 2, 24, "25", "1", "1", "v3")
    of = held([told(r, hardware=here) for r in runs()], runs())
    assert of.verdict == AGREES
    assert verdicts(of, "seconds") == verdicts(of, "ms") == {UNTOLD}
    assert "other machines: Invented CPU family 25 model 1 stepping 1, 2 cores, v3, 24 GiB, 2 threads here" in of.line
    busy = held([costing(r, load=r.cost.load + 1) for r in runs()], runs())
    assert "the machine had other work: load 4.0 here, 3.0 there" in busy.line
    slow = held([costing(r, train_s=2 * r.cost.train_s) for r in runs()], runs())
    assert verdicts(slow, "seconds") == {DIFFERS}
    assert "seconds differ: " in slow.line
    assert slow.verdict == AGREES  # in PSNR


def test_what_is_not_in_both_is_named():
    """Catches a model that is missing here and is not missed, and folders that have nothing in common."""
    of = held([r for r in runs() if r.model != "4dgs"], [r for r in runs() if r.model != "6dgs"])
    assert of.only_theirs == ["4dgs on moving-matte", "4dgs on suzanne"]
    assert of.only_ours == ["6dgs on moving-matte", "6dgs on suzanne"]
    none = held(runs(models=("3dgs",)), runs(models=("7dgs",)))
    assert none.verdict == UNTOLD
    assert none.line == "mine against published: cannot be told. No model and scene is in both."


def test_a_run_that_did_not_finish_is_said():
    """Catches a crash, and a failure here that is not said."""
    lost = {"status": "failed", "reason": "out of memory", "metrics": None, "missing": {}, "cost": None}
    ours = [dataclasses.replace(r, **lost) if r.model == "7dgs" else r for r in runs()]
    of = held(ours, runs())
    assert of.verdict == UNTOLD
    assert "PSNR cannot be told: 7dgs on moving-matte, 7dgs on suzanne (no run finished here)" in of.line


def write(records: list[Record], folder: Path) -> Path:
    for r in records:
        files.write(r, folder / r.path.relative_to(r.path.parts[0]) / files.FILE_NAME)
    return folder


def test_the_command(tmp_path, capsys):
    """Catches an exit status, a last line, a JSON and a page that do not say what the comparison came to."""
    ours, theirs = write(runs(seeds=1), tmp_path / "mine"), write(runs(), tmp_path / "published")
    before = {path: path.read_bytes() for path in theirs.rglob("*") if path.is_file()}
    assert main([str(ours), "--against", str(theirs), "--json", str(tmp_path / "a.json")]) == 0
    out = capsys.readouterr().out
    assert out.splitlines()[-1].startswith(f"{ours} against {theirs}: agrees. PSNR agrees in 10 of 10")
    assert "7dgs seed 2" in out
    told = json.loads((tmp_path / "a.json").read_text())
    assert told["verdict"] == AGREES
    row = next(r for r in told["rows"] if (r["model"], r["scene"]) == ("7dgs", "suzanne"))
    assert row["runs"][2]["ours"] is None
    assert row["runs"][0]["ours"] == row["runs"][0]["theirs"]
    assert row["judged"]["psnr"]["low"] < row["judged"]["psnr"]["difference"] < row["judged"]["psnr"]["high"]
    page = (ours / "report.html").read_text()
    assert f"Against {theirs}" in page
    assert "PSNR agrees in 10, differs in 0, cannot be told in 0 of 10 rows here." in page
    assert {path: path.read_bytes() for path in theirs.rglob("*") if path.is_file()} == before
    write([moved(r, 2.0) for r in runs(seeds=1)], ours)
    assert main([str(ours), "--against", str(theirs)]) == 1
    assert main([str(ours), "--against", str(tmp_path / "nowhere")]) == 2
    assert "expected a folder of results" in capsys.readouterr().err


def test_text_from_a_record_cannot_break_the_comparison(tmp_path, capsys):
    """Catches a data set's name or a machine's that colours the terminal or writes the line anew."""
    bad = [told(r, device="\x1b[31m\nowned") for r in runs(seeds=1)]
    folder = write([dataclasses.replace(r, dataset="x\x1b\ny") for r in bad], tmp_path / "mine")
    main([str(folder), "--against", str(folder)])
    assert "\x1b" not in capsys.readouterr().out


def test_published_is_what_was_measured_and_nothing_doubtful(tmp_path):
    """Catches a failed or dirty run among published records, and a table there that does not hold all of them."""
    to = tmp_path / "published/mini"
    assert "10 records" in publish(write(runs(seeds=1), tmp_path / "mini"), to)
    more = write([r for r in runs(seeds=2) if r.seed], tmp_path / "more")
    assert "10 records in" in publish(more, to)
    assert len(files.find(to)) == 20
    assert len((to / "table.csv").read_text().splitlines()) == 21
    (path,) = [p for p in files.find(more) if "suzanne/7dgs/" in str(p)]
    for bad in (
        told(make(seed=1), git_commit="0123-dirty"),
        told(make(seed=1), git_commit=None),
        make(seed=1, status="failed", reason="x", metrics=None, missing={}, cost=None),
    ):
        files.write(bad, path)
        with pytest.raises(InputError, match="expected finished runs of clean commits"):
            publish(more, to)
    assert len(files.find(to)) == 20
