"""Runs as tables: fixed columns, duplicates, times of one machine, settings that name models, PSNR on val."""

import dataclasses
from pathlib import Path

import pytest
from make_golden import make
from many_records import gates

from gsbench.errors import InputError
from gsbench.measure import record as files
from gsbench.measure.curve import Point
from gsbench.measure.record import OnDemand, Record, Stop
from gsbench.report import frame
from gsbench.report.frame import RUNS, TIMES, covered, labelled, load, of_one_machine, tables


def failed(**changes: object) -> Record:
    return make(status="failed", reason="out of memory", metrics=None, missing={}, cost=None, **changes)


def as_tables(*records: Record) -> frame.Results:
    return tables([(Path(str(i)), record) for i, record in enumerate(records)], [])


@pytest.mark.parametrize("records", [[], [failed()], [make(), failed(seed=1)]], ids=["none", "failed", "both"])
def test_tables_always_have_their_columns(records: list[Record]):
    """Would catch a column that vanishes with the runs that have it, or a count that becomes text."""
    results = as_tables(*records)
    assert [column.name for column in RUNS] == list(results.runs)[: len(RUNS)]
    kinds = {column.name: column.kind for column in RUNS}
    assert all(results.runs[name].dtype == kind for name, kind in kinds.items() if kind in (int, float, bool))
    assert list(results.views)[:3] == ["run", "view", "psnr_db"]
    assert next(iter(results.curves)) == "run"
    assert len(results.finished.runs) == sum(record.status == "ok" for record in records)


def test_every_metric_and_cost_has_a_column_in_its_unit():
    """Would catch a metric without a column, or bytes that are called MB."""
    places = {column.place.removeprefix("metrics.") for column in RUNS if column.place.startswith("metrics.")}
    assert places == set(files.METRICS)
    record = make()
    assert record.cost is not None
    run = as_tables(record).runs.iloc[0]
    assert run.model_mb == record.cost.bytes / 1e6
    assert run.train_min == record.cost.train_s / 60
    assert run.frame_ms == record.cost.render_ms.p50
    assert run.gaussians == record.cost.num_gaussians


def test_a_run_counts_once(tmp_path: Path):
    """Would catch a copied record that counts as another seed."""
    for folder in ("a", "b"):
        files.write(make(), tmp_path / folder / files.FILE_NAME)
    results = load(tmp_path)
    assert len(results.runs) == 1
    assert [str(tmp_path / "b") in fault and "the same run" in fault for fault in results.faults] == [True]
    with pytest.raises(InputError, match=r"expected results, found no record\.json"):
        load(Path(__file__).parent)


def test_times_are_of_the_machine_of_most_finished_runs():
    """Would catch times of two machines in one mean, or the machine of failed runs."""
    elsewhere = dataclasses.replace(make().provenance, device="another")
    runs = as_tables(make(seed=0), make(seed=1), make(seed=2, provenance=elsewhere),
                     *(failed(seed=seed, provenance=elsewhere) for seed in (3, 4, 5))).runs  # fmt: skip
    timed = of_one_machine(runs)
    assert timed[TIMES].notna().all(axis=1).tolist() == [True, True, False, False, False, False]
    assert timed.psnr_db.notna().sum() == 3
    assert set(timed.timed_on) == {make().provenance.machine}


def test_settings_that_most_models_share_name_the_comparison():
    """Would catch an ablation that stands for its model, or an average over a scene that a model lacks."""
    runs = as_tables(
        make("3dgs"), make("4dgs"), make("4dgs", variant="ablation=a"), make("7dgs", variant="iterations=9"),
        make("3dgs", "cloud"), failed(model="4dgs", scene="cloud"),
    ).runs  # fmt: skip
    named = labelled(runs)
    assert set(named.label) == {"3dgs", "4dgs", "4dgs ablation=a", "7dgs iterations=9"}
    assert set(named.label[named.main]) == {"3dgs", "4dgs"}
    assert set(named.label[named.compared]) == {"3dgs", "4dgs", "4dgs ablation=a"}
    assert covered(named[named.main]) == ["suzanne"]


def test_psnr_on_val_is_of_the_gaussians_that_were_kept():
    """Would catch a choice on val by a training that was not kept, or by Gaussians before effects were removed."""
    curve = [Point(100, 1.0, 20.0), Point(200, 2.0, 21.0), Point(300, 3.0, 19.0)]
    lost = sum(gate.measured_db for gate in gates() if gate.step is None)
    cases = {20.5: make(psnr=20.5, protocol=make().protocol | {"eval_split": "val"}), 19.0: make(curve=curve),
             21.0: make(curve=curve, stop=Stop(300, 200)),
             19.0 - lost: make(curve=curve, on_demand=OnDemand(gates=gates()))}  # fmt: skip
    assert lost
    assert {frame.psnr_val(record): record for record in cases.values()} == cases
