"""Runs as tables: fixed columns, duplicates, times of one machine, settings that name models, PSNR on val."""

import dataclasses
from pathlib import Path

import pytest
from records import but, gates, lost, make, results

from gsbench.errors import InputError
from gsbench.measure import record as files
from gsbench.measure.curve import Point
from gsbench.measure.record import OnDemand, Stop
from gsbench.report import frame
from gsbench.report.frame import RUNS, TIMES, covered, labelled, load, of_one_machine


@pytest.mark.parametrize("records", [[], [lost(make())], [make(), lost(make(seed=1))]], ids=["none", "failed", "both"])
def test_tables_always_have_their_columns(records):
    """Would catch a column that vanishes with the runs that have it, or a count that becomes text."""
    tables = results(*records)
    assert [column.name for column in RUNS] == list(tables.runs)[: len(RUNS)]
    assert all(tables.runs[of.name].dtype == of.kind for of in RUNS if of.kind in ("int", "float", "bool"))
    assert list(tables.views)[:3] == ["run", "view", "psnr_db"]
    assert next(iter(tables.curves)) == "run"
    others = {name for name in tables.runs if not name.startswith(("protocol_", "stage_"))}
    assert others == {*(column.name for column in RUNS), "path", "record"}
    assert len(tables.finished.runs) == sum(record.status == "ok" for record in records)


def test_every_metric_and_cost_has_a_column_in_its_unit():
    """Would catch a metric without a column, or bytes that are called MB."""
    places = {column.place.removeprefix("metrics.") for column in RUNS if column.place.startswith("metrics.")}
    assert places == set(files.METRICS)
    run, cost = results(make()).runs.iloc[0], make().cost
    assert (run.model_mb, run.train_min) == (cost.bytes / 1e6, cost.train_s / 60)
    assert (run.frame_ms, run.gaussians) == (cost.render_ms.p50, cost.num_gaussians)


def test_a_run_counts_once(tmp_path):
    """Would catch a copied record that counts as another seed."""
    for folder in ("a", "b"):
        files.write(make(), tmp_path / folder / files.FILE_NAME)
    tables = load(tmp_path)
    assert len(tables.runs) == 1
    assert [str(tmp_path / "b") in fault and "the same run" in fault for fault in tables.faults] == [True]
    with pytest.raises(InputError, match=r"expected results, found no record\.json"):
        load(Path(__file__).parent)


def test_times_are_of_the_machine_of_most_finished_runs():
    """Would catch times of two machines in one mean, or the machine of failed runs."""
    elsewhere = [but(make(seed=seed), provenance={"device": "another"}) for seed in range(2, 6)]
    timed = of_one_machine(results(make(seed=0), make(seed=1), elsewhere[0], *map(lost, elsewhere[1:])).runs)
    assert timed[TIMES].notna().all(axis=1).tolist() == [True, True, False, False, False, False]
    assert timed.psnr_db.notna().sum() == 3
    assert set(timed.timed_on) == {make().provenance.machine}


def test_runs_that_share_a_gpu_have_no_times():
    """Would catch frames a second of 18 trainings on one GPU, of which the last has it for itself."""
    conditions = enumerate([("cpu", 17.0), ("cuda:0", 1.2), ("cuda:0", 17.0)])
    runs = [but(make(seed=s), cost={"load": load}, provenance={"config": {"device": d}}) for s, (d, load) in conditions]
    assert of_one_machine(results(*runs).runs).frame_ms.notna().tolist() == [True, True, False]


def test_settings_that_most_models_share_name_the_comparison():
    """Would catch an ablation that stands for its model, or an average over a scene that a model lacks."""
    variants = make("4dgs", variant="ablation=a"), make("7dgs", variant="iterations=9")
    runs = results(make("3dgs"), make("4dgs"), *variants, make("3dgs", "cloud"), lost(make("4dgs", "cloud"))).runs
    named = labelled(runs)
    assert set(named.label) == {"3dgs", "4dgs", "4dgs ablation=a", "7dgs iterations=9"}
    assert set(named.label[named.main]) == {"3dgs", "4dgs"}
    assert set(named.label[named.compared]) == {"3dgs", "4dgs", "4dgs ablation=a"}
    assert covered(named[named.main]) == ["suzanne"]


def test_psnr_on_val_is_of_the_gaussians_that_were_kept():
    """Would catch a choice on val by a training that was not kept, or by Gaussians before effects were removed."""
    whole = make(curve=[Point(100, 1.0, 20.0), Point(200, 2.0, 21.0), Point(300, 3.0, 19.0)])
    removed = sum(gate.measured_db for gate in gates() if gate.step is None)
    assert removed
    assert frame.psnr_val(but(make(psnr=20.5), protocol={"eval_split": "val"})) == 20.5
    assert frame.psnr_val(whole) == 19.0
    assert frame.psnr_val(dataclasses.replace(whole, stop=Stop(300, 200))) == 21.0
    assert frame.psnr_val(dataclasses.replace(whole, on_demand=OnDemand(gates=gates()))) == 19.0 - removed
