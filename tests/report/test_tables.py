"""The table: a golden page, the rules of averaging and of the paper's rows, warnings, the command."""

import base64
import dataclasses
import subprocess
import sys

import hydra
import pandas as pd
import pytest
from make_golden import GOLDEN, GOLDEN_TERMINAL, NO_REGIONS, make, moving, records

from gsbench.config import CONF, register_schema
from gsbench.measure import record as files
from gsbench.report import conditions, layout, tables
from gsbench.report.__main__ import main
from gsbench.report.page.content import Column, DataTable


def page(*of: files.Record) -> str:
    return layout.markdown(tables.build(list(of)))


def section(text: str, title: str) -> str:
    """The part of a page under the heading that begins with `title`."""
    return text.split(f"## {title}", 1)[1].split("\n## ")[0].split("\n(1)")[0]


def failed(**changes: object) -> files.Record:
    return make(
        **{"status": "failed", "reason": "out of memory", "metrics": None, "missing": {}, "cost": None} | changes
    )


def test_the_golden_page():
    """Would catch any change of the page nobody meant. If it is meant: run make_golden.py and read the difference."""
    assert page(*records()) == GOLDEN.read_text()
    assert layout.terminal(tables.build(records())) == GOLDEN_TERMINAL.read_text()


def test_settings_of_every_run_are_said_once():
    """Would catch a table whose runs are all shorter, or without a part, and that reads as the experiment's own."""
    every = page(make("3dgs", variant="iterations=500"), make("7dgs", variant="iterations=500"))
    assert "- All runs differ from the experiment in iterations=500." in every
    assert "| 7dgs | " in every
    some = page(make("3dgs"), make("7dgs", variant="iterations=500"))
    assert "All runs differ" not in some
    assert "| 7dgs iterations=500 | " in some


def test_a_table_names_the_scenes_that_settings_were_chosen_on():
    """Would catch a page that reports as a finding what was chosen on its own scene."""
    text = page(make(scene="suzanne"), make(scene="nobodys"))
    assert "settings were tuned on suzanne; not on nobodys" in text
    assert "were chosen on" not in page(make(scene="nobodys"))


def test_every_scene_of_the_trials_counts_as_tuned():
    """Would catch a scene that is added to the trials and then reported as if nothing had been chosen on it."""
    register_schema()
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        assert set(hydra.compose("config", ["+exp=tuning", "scene=suzanne"]).data.scenes) <= conditions.TUNED


def test_no_run_is_dropped():
    """Would catch failed and diverged runs, or seeds, that vanish from the page or the CSV."""
    text = page(*records())
    assert "| 7dgs seed 2 | diverged |" in text
    assert "7dgs seed 2 diverged: step 431" in text
    assert "| 7dgs_noagr seed 0 | failed |" in text
    frame = tables.tidy(records())
    assert len(frame) == len(records())
    assert frame["status"].value_counts().to_dict() == {"ok": 7, "diverged": 1, "failed": 1}
    assert frame.loc[frame["status"] == "failed", "reason"].tolist() == ["out of memory"]


def test_seeds_become_mean_and_interval():
    """Would catch another spread than the page's, or a failed seed that counts: 24, 25, 26 are 25 ± 4.30 / sqrt(3)."""
    runs = [make(seed=seed, psnr=psnr) for seed, psnr in enumerate((24.0, 25.0, 26.0))]
    text = section(page(*runs, failed(seed=3)), "suzanne")
    assert "| 7dgs | **25.00 ± 2.48** |" in text
    assert "| 3 |" in text
    assert "| 7dgs seed 3 | failed |" in text


def test_a_seed_without_a_number_empties_the_cell():
    """Would catch a mean over fewer seeds than the row claims."""
    metrics = {**make().metrics, "ssim": None}
    other = make(seed=1, metrics=metrics, missing={"ssim": "too small", "lpips_vgg": "none"})
    text = page(make(), other)
    assert "| – (1) |" in section(text, "suzanne")
    assert "(1) SSIM is empty: too small" in text


def test_the_average_is_over_scenes_that_every_model_finished():
    """Would catch an average in which one model is spared a hard scene."""
    runs = [
        make("4dgs", "suzanne", psnr=20.0),
        make("7dgs", "suzanne", psnr=22.0),
        make("4dgs", "moving-matte", psnr=30.0),
        failed(model="7dgs", scene="moving-matte"),
    ]
    text = section(page(*runs), "average")
    assert text.startswith(" over 1 of 2 scenes: suzanne\n")
    assert "| 4dgs | 20.00 |" in text
    assert "| 7dgs | **22.00** |" in text


def test_an_average_over_no_scene_says_so():
    """Would catch a division by zero, and an average that quietly disappears."""
    text = section(page(make("4dgs", "suzanne"), make("7dgs", "moving-matte")), "average")
    assert "over 0 of 2 scenes" in text
    assert "no scene that every model has finished" in text
    assert "over 0 of 2 scenes" in page(failed(), failed(scene="moving-matte"))


def trex(dataset: str = "D-NeRF", model: str = "7dgs", scene: str = "trex", **changes: object) -> files.Record:
    protocol = {**make().protocol, "paper_dataset": "D-NeRF"}
    return make(model, scene, **{"dataset": dataset, "protocol": protocol} | changes)


def test_the_papers_row_stands_beside_its_own_scene():
    """Would catch the paper's numbers in wrong columns or units: trex is 30.72 dB, 63.4 min, 67994 Gaussians."""
    text = page(trex(), make(scene="invented", dataset="D-NeRF"))
    assert "| paper (1) | 30.72 | 0.980 | 0.018 (2) | 63.4 | 156.5 | 67994 |" in text
    assert "other data" not in text


def test_a_stand_in_is_called_other_data():
    """Would catch the paper's suzanne shown as if this project's suzanne could be compared with it."""
    text = page(trex(dataset="mini"))
    assert "| paper, other data (1) | 30.72 |" in text
    assert "stand-in" in text


def test_no_paper_row_where_the_paper_has_none():
    """Would catch a row matched by scene name alone, by a model's name alone, or for a model of other effects."""
    for run in (
        make(protocol={**make().protocol, "paper_dataset": None}),
        make(protocol={"name": "gsbench"}),
        trex(scene="suzanne"),
        trex(model="3dgs"),
        trex(effects=make("7dgs_noagr").effects),
    ):
        assert "paper" not in page(run).lower()


def test_the_papers_average_is_over_the_same_scenes():
    """Would catch the paper's average over eight scenes beside ours over two: (30.72 + 32.96) / 2 = 31.84."""
    text = section(page(trex(), trex(scene="hellwarrior")), "average")
    assert "| paper (1) | 31.84 |" in text
    assert "paper" not in section(page(trex(), trex(scene="hellwarrior"), trex(scene="invented")), "average")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"device": "another CPU"}, "the rows differ in machine"),
        ({"threads": 64}, "the rows differ in machine"),
        ({"git_commit": "fedcba"}, "the rows differ in commit"),
        ({"git_commit": None}, "the rows differ in commit"),
        ({"versions": {"torch": "2.6"}}, "the rows differ in versions"),
        ({"data_hash": "77"}, "the rows differ in mini"),
        ({"config": {"train": {"iterations": 7}}}, "the rows differ in iterations"),
    ],
)
def test_rows_made_under_other_conditions_are_warned_of(changes, words):
    """Would catch two numbers compared that were measured on different machines, code, data or lengths of training."""
    one = make("4dgs")
    other = dataclasses.replace(make("7dgs"), provenance=dataclasses.replace(one.provenance, **changes))
    assert f"WARNING: {words}" in page(one, other)
    assert "WARNING" not in page(one, make("7dgs"))


def test_a_protocol_may_go_with_the_scene_but_not_within_it():
    """Would catch a warning about lego on val, which is meant, or none about two rows of one scene on two splits."""
    val = {**make().protocol, "eval_split": "val"}
    text = page(trex(), trex(scene="lego", protocol={**trex().protocol, "eval_split": "val"}))
    assert "eval_split test (trex), val (lego)" in text
    assert "lego is measured on val" in text
    assert "WARNING" not in text
    assert "WARNING: the rows differ in eval_split: test (suzanne/4dgs/seed0); val" in page(
        make("4dgs"), make(protocol=val)
    )


def test_a_run_that_failed_warns_of_nothing_it_never_reached():
    """Would catch "the rows differ" by a run that stopped before its backend was resolved and its data were read."""
    early = failed(seed=7, protocol={**make().protocol, "backend": "auto", "resolution": "not loaded"})
    early = dataclasses.replace(
        early, provenance=dataclasses.replace(make().provenance, data_hash="not loaded", git_commit="fedcba-dirty")
    )
    known = make(protocol={**make().protocol, "backend": "cpu"})
    text = page(known, early)
    assert "WARNING" not in text
    assert "backend cpu" in text
    assert "not load" not in text
    alone = page(early, failed(seed=8))
    assert "WARNING" not in alone
    assert "not loaded" in alone


def test_what_a_variant_names_may_differ():
    """Would catch a warning on every frontier, whose rows name their lengths, or none where no row names it."""
    lengths = {"": 1000, "iterations=250": 250, "iterations=4000": 4000}
    runs = [of_length("4dgs", length, variant) for variant, length in lengths.items()]
    assert "iterations 250, 1000, 4000\n" in page(*runs)
    assert "WARNING" not in page(*runs)
    text = page(*runs, of_length("7dgs", 500, "sh_degree=0"))
    assert "WARNING: the rows differ in iterations: 1000 (suzanne/4dgs/seed0); 500 (suzanne/7dgs" in text
    foreign = of_length("4dgs", "²", "iterations=x")  # a digit that is no number
    assert "iterations ², 1000" in page(runs[0], foreign)


def of_length(model, iterations, variant=""):
    """A run of a length that its variant names or does not."""
    run = make(model, variant=variant)
    config = {**run.provenance.config, "train": {"iterations": iterations}}
    return dataclasses.replace(run, provenance=dataclasses.replace(run.provenance, config=config))


def elsewhere(record, seconds):
    """The same run on another machine, which took so long."""
    provenance = dataclasses.replace(record.provenance, device="another CPU")
    return dataclasses.replace(
        record, provenance=provenance, cost=dataclasses.replace(record.cost, train_s=seconds, fps=1000.0)
    )


def test_seconds_of_two_machines_are_never_averaged():
    """Would catch a stranger's 0.4 +- 0.5 min, half of them ours, and a row ranked by another machine's seconds.

    One seed of 7dgs and the only one of 4dgs were measured elsewhere; PSNR is the mean of all.
    """
    runs = [make("3dgs", psnr=20.0), make(psnr=25.0), make(seed=1, psnr=26.0), elsewhere(make(seed=2, psnr=27.0), 6.0)]
    runs.append(elsewhere(make("4dgs", psnr=23.0), 6.0))
    (table,) = tables.build(runs)
    cells = {row.label: row.cells for row in table.sections[0].rows if row.seeds}
    assert cells["7dgs"]["psnr"] == "26.00 ± 2.48"
    assert cells["7dgs"]["train_min"] == "1.51 ± 0.11"  # of 90 and 91 s
    assert cells["7dgs"]["fps"] == "20.0 ± 0.0"
    assert cells["4dgs"]["train_min"] == cells["4dgs"]["fps"] == "–"
    assert (
        "train min and FPS are of one machine, Invented CPU, 2 threads. Those of other machines are left out: "
        "another CPU, 2 threads (2 runs). All other columns are means over all runs."
    ) in table.footnotes
    assert "are left out" not in page(*runs[:3])
    (other,) = tables.build(runs, machine="another CPU, 2 threads")
    assert other.sections[0].rows[0].cells["train_min"] == "–"


def test_an_average_over_scenes_is_of_one_machine():
    """Would catch an average over two scenes whose minutes are of two machines."""
    text = page(make("3dgs"), make("4dgs"), elsewhere(make("3dgs", "moving-matte"), 6.0), make("4dgs", "moving-matte"))
    average = text[text.index("average over 2 of 2") :]
    assert "| 3dgs | **25.00** | 0.900 | 0.100 | – | – | 5000 |" in average
    assert "| 4dgs | **25.00** | 0.900 | 0.100 | 1.50 | 20.0 | 5000 |" in average
    assert "–: not measured on every scene" in average


def test_the_load_is_told_as_far_as_it_is_known():
    """Would catch a load of some runs that passes for that of all, and records that are silent about it taken for 0."""
    busy, silent = make(seed=1), make("4dgs")
    silent = dataclasses.replace(silent, cost=dataclasses.replace(silent.cost, load=None, train_cpu_s=None))
    assert "with the run itself: 3.0" in page(busy)
    assert "with the run itself: 3.0; 1 of 2 runs do not say" in page(busy, silent, failed(seed=2))
    assert "load" not in page(silent)
    assert list(tables.tidy([busy, silent]).load.isna()) == [False, True]


def test_the_change_by_float32_is_told_as_far_as_it_is_known():
    """Catches the smallest change instead of the largest, and runs without it that pass for measured ones."""
    known = [make(seed=k, metrics={**make().metrics, "psnr_float32": change}) for k, change in enumerate((2e-6, 3e-7))]
    assert "- Rounding to float32 changes PSNR of a view by at most 2.0e-06 dB (three views of each run).\n" in page(
        *known
    )
    assert "by at most 2.0e-06 dB (three views of each run; 1 of 3 runs do not say).\n" in page(*known, make("4dgs"))
    assert "float32" not in page(make())


def test_runs_measured_before_their_last_iteration_are_told():
    """Catches a number of an earlier iteration that stands as that of the last one."""
    ran = [
        make(seed=0, stop=files.Stop(4000, 4000)),
        make(seed=1, stop=files.Stop(3000, 2200)),
        make(seed=2, stop=files.Stop(2800, 2000)),
    ]
    said = (
        "- 2 of 3 runs were measured at the iteration with the best PSNR on val, 2,000 to 2,200, and ended at iteration"
    )
    assert f"{said} 2,800 to 3,000 (train.patience).\n" in page(*ran)
    assert "patience" not in page(*ran[:1], make(seed=3))


def test_runs_of_several_lengths_are_told():
    """Catches a length chosen on val that stands as the one of the settings, and seconds that seem to be of one."""
    said = "- 2 of 3 runs were trained at several lengths, of which the best on val was kept, 1,000 to 2,000"
    chosen = [files.LengthChoice(kept, [files.Candidate("iterations=1000", 20.0, 1.0)]) for kept in (1000, 2000)]
    text = page(make(seed=0), *(make(seed=1 + i, length_choice=one) for i, one in enumerate(chosen)))
    assert f"{said} iterations. Their seconds of training are those of all lengths (train.lengths).\n" in text
    assert "train.lengths" not in page(make(seed=0), make(seed=1))


def test_views_at_the_cap_are_told():
    """Catches a mean with a view at the cap that a reader takes for one without, and a name read as Markdown."""
    text = page(make(seed=0), make(seed=1, exact=["b", "a|"]), make(seed=2, exact=["b"]))
    assert (
        "- PSNR of a\\|, b is infinite or nearly so and counts as 100 dB (docs/protocol.md#exact-views), in 2 of 3"
        in text
    )
    assert "counts as" not in page(make(seed=0), make(seed=1))


def test_runs_that_end_with_averaged_parameters_are_told():
    """Catches parameters chosen on val that stand as those of the last iteration."""
    said = "- 2 of 3 runs ended with parameters averaged over the last 490 to 500 iterations, because PSNR on val was"
    text = page(make(seed=0), make(seed=1, averaged=490), make(seed=2, averaged=500))
    assert f"{said} higher (train.average_from).\n" in text
    assert "averaged over the last" not in page(make(seed=0), make(seed=1))


def test_columns_that_leak_or_are_rare_say_so():
    """Would catch the best-on-test column without its warning, or an LPIPS-VGG that was measured and is not shown."""
    metrics = {**make().metrics, "lpips_vgg": 0.25, "psnr_best_on_test": 26.5}
    text = page(make(metrics=metrics, missing={}))
    assert "LPIPS-VGG | psnr_best_on_test (leaks) |" in text
    assert "| 0.250 | 26.50 |" in text
    assert "LPIPS-VGG needs weights: \\`python -m gsbench.fetch lpips-vgg\\`." in page(make())


def test_regions_are_beside_psnr_with_their_share_or_the_reason():
    """Catches a PSNR of moving pixels that stands apart, without its pixels, and one that is missing mutely."""
    text = page(moving(make(), 21.5), dataclasses.replace(make(scene="other"), missing=NO_REGIONS))
    assert "| model | PSNR | PSNR moving | SSIM |" in text
    assert "| 25.00 | 21.50 | 0.900 |" in text.replace("**", "")
    assert "- PSNR moving is measured on 12.3% of the image, in 1 of 1 views, by images of one camera." in text
    assert "PSNR moving needs 3 evaluated views with the same camera" in text  # of the other scene
    assert text.count("PSNR object needs masks, or images with alpha.") == 2
    alone = page(dataclasses.replace(make(), missing=NO_REGIONS))
    assert "- PSNR moving needs 3 evaluated views with the same camera. PSNR object needs masks" in alone
    assert "PSNR moving" not in page(make())  # a record of before


def test_training_views_are_shown_on_request():
    """Catches a gap to the training views that cannot be seen, or that nobody asked for; an older record says why."""
    seen = [dataclasses.replace(r, metrics=r.metrics and r.metrics | {"psnr_train": 33.25}) for r in records()]
    assert "PSNR train" not in page(*seen)
    assert "33.25" in layout.markdown(tables.build(seen, train=True))
    assert "PSNR train is empty: not measured" in layout.markdown(tables.build(records(), train=True))


def test_text_from_a_record_cannot_break_the_page_or_the_terminal():
    """Would catch a reason with a pipe, a newline or an escape code that breaks the table or colours the terminal."""
    run = failed(reason="a | b\nc <script> \x1b[31m *d*", dataset="x|y\x07<b>&lt;")
    text = page(run)
    assert "data x\\|y\\\\x07&lt;b>&amp;lt;" in text
    assert "<" not in text
    assert r"a \| b\\nc &lt;script> \\x1b\[31m \*d\*" in text
    assert not set(layout.terminal(tables.build([run]))) & {"\x1b", "\x07"}


ESCAPE = "\x1b[31m\x9b\x07\u202e"


def spoilt(record):
    """The run with an escape code in every free text and every key that it may have."""
    provenance = dataclasses.replace(
        record.provenance, git_commit=ESCAPE, versions={ESCAPE: ESCAPE}, device=ESCAPE, data_hash=ESCAPE, time=ESCAPE
    )
    changes = {"dataset": ESCAPE, "protocol": {**record.protocol, f"{ESCAPE}a": ESCAPE}, "provenance": provenance}
    missing = dict.fromkeys(record.missing, ESCAPE)
    return dataclasses.replace(record, missing=missing, reason=record.reason and ESCAPE, **changes)


def test_no_control_character_of_a_record_is_written(tmp_path, capsys):
    """Would catch an escape code in a key, a note or a cell, which a terminal obeys: in every file and in the print."""
    for i, record in enumerate([make(), make(seed=1), failed(seed=2)]):
        path = tmp_path / f"run{i}" / "record.json"
        changed = spoilt(record) if i else dataclasses.replace(spoilt(record), protocol=make().protocol)
        files.write(changed, path)
    assert main([str(tmp_path)]) == 0
    assert main([str(tmp_path), "--tables"]) == 0
    printed = capsys.readouterr().out
    for text in (printed, *(p.read_text() for p in tmp_path.iterdir() if p.suffix in (".md", ".csv", ".html"))):
        assert not {c for c in text if not c.isprintable()} - {"\n"}


def test_a_cell_of_csv_is_no_formula(tmp_path):
    """Would catch a text that a spreadsheet computes, and a negative number that is made a text."""
    run = dataclasses.replace(failed(reason="=1+1"), protocol={**make().protocol, "name": "@SUM(A1)", "frames": "-2+3"})
    psnr = dataclasses.replace(make(), metrics={**make().metrics, "psnr": -1.5})
    tables.write([run, psnr], tmp_path, tables.build([run, psnr]))
    frame = pd.read_csv(tmp_path / "table.csv")
    lost, kept = frame[frame.status == "failed"].iloc[0], frame[frame.status == "ok"].iloc[0]
    assert (lost.reason, lost.protocol_name, lost.protocol_frames) == ("'=1+1", "'@SUM(A1)", "'-2+3")
    assert kept.psnr == -1.5
    linked = DataTable("t.csv", [Column("=a"), Column("b", 1)], [["+cmd|' /C calc'!A0", -1.5]])
    assert base64.b64decode(linked.href.partition(",")[2]).decode() == "'=a,b\n'+cmd|' /C calc'!A0,-1.5\n"


@pytest.mark.parametrize("width", [120, 80, 40])
def test_the_terminal_form_fits(width):
    """Would catch a line that wraps, also with several seeds, every column and a long model name."""
    metrics = {**make().metrics, "lpips_vgg": 0.25, "psnr_best_on_test": 26.5}
    runs = [*records(), make(seed=3, metrics=metrics, missing={})]
    runs += [dataclasses.replace(make(seed=seed), model="a_model_with_a_name_of_forty_letters_____") for seed in (0, 1)]
    text = layout.terminal(tables.build(runs), width)
    assert max(map(len, text.splitlines())) <= width
    assert "columns left out, for lack of width" in text
    assert "7dgs seed 2" in text


def test_the_csv_reads_back(tmp_path):
    """Would catch a CSV that rounds, or whose cells move: one row a run, numbers to the last digit."""
    tables.write(records(), tmp_path, tables.build(records()))
    frame = pd.read_csv(tmp_path / "table.csv", dtype={"psnr": str})
    assert [float(psnr) for psnr in frame["psnr"].dropna()] == [r.metrics["psnr"] for r in records() if r.metrics]
    assert frame["seed"].tolist() == [r.seed for r in records()]
    assert frame["protocol_eval_split"].unique().tolist() == ["test"]
    assert (tmp_path / "table.md").read_text() == GOLDEN.read_text()


def test_the_command_prints_and_writes(tmp_path, capsys):
    """Would catch a command that needs anything but a folder: records at any depth, several experiments."""
    for run in (*records(), make(experiment="other", psnr=11.5)):
        folder = files.run_path(tmp_path, run.experiment, run.scene, run.model, run.seed)
        files.write(run, folder / files.FILE_NAME)
    assert main([str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert "experiment mini, data mini" in printed
    assert "experiment other, data mini" in printed
    assert "11.50*" in printed
    assert max(map(len, printed.splitlines()[:-1])) <= 120
    assert GOLDEN.read_text() in (tmp_path / "table.md").read_text()
    assert len(pd.read_csv(tmp_path / "table.csv")) == len(records()) + 1


def test_the_command_is_clear_where_there_is_nothing_to_show(tmp_path, capsys):
    """Would catch a stack trace, or an exit code of 0, for an empty folder, a missing one, or a damaged record."""
    for folder in (tmp_path, tmp_path / "missing"):
        assert main([str(folder)]) == 2
        assert "found no" in capsys.readouterr().err
    (tmp_path / "record.json").write_text("{")
    assert main([str(tmp_path)]) == 1
    assert f"left out: {tmp_path}/record.json: expected JSON" in capsys.readouterr().err
    assert not (tmp_path / "table.md").exists()


def test_a_damaged_record_is_named_and_the_rest_is_reported(tmp_path, capsys):
    """Would catch one damaged file that hides a whole sweep, and a table that leaves a run out without a word."""
    files.write(make(), tmp_path / "a" / files.FILE_NAME)
    for name, damage in (("b", b"\xff"), ("c", b"{}")):
        (tmp_path / name).mkdir()
        (tmp_path / name / files.FILE_NAME).write_bytes(damage)
    (tmp_path / "d").mkdir()
    (tmp_path / "d" / files.FILE_NAME).symlink_to("nowhere")
    assert main([str(tmp_path)]) == 1
    printed = capsys.readouterr()
    assert "25.00*" in printed.out
    assert len(pd.read_csv(tmp_path / "table.csv")) == 1
    left_out = printed.err.splitlines()
    assert [line.split(":")[2] for line in left_out] == [f" {tmp_path}/{name}/record.json" for name in "bcd"]
    assert main([str(tmp_path / "a")]) == 0


def test_a_folder_that_cannot_be_written_is_one_line(tmp_path, capsys):
    """Would catch a stack trace at the end of a report: here table.md is a folder."""
    files.write(make(), tmp_path / files.FILE_NAME)
    (tmp_path / "table.md").mkdir()
    assert main([str(tmp_path)]) == 2
    assert "table.md" in capsys.readouterr().err


def test_the_same_run_twice_counts_once(tmp_path):
    """Would catch a copied folder that counts as a second seed and halves the spread."""
    for name in ("a", "b"):
        files.write(make(), tmp_path / name / "record.json")
    kept, faults = tables.load(tmp_path)
    assert len(kept) == 1
    assert [fault.split(":")[1] for fault in faults] == [f" the same run as {tmp_path}/a/record.json; keep one of them"]


def test_python_dash_m_runs():
    """Would catch a package that cannot be run, and one that imports torch to say so."""
    done = subprocess.run(
        [sys.executable, "-X", "importtime", "-m", "gsbench.report", "--help"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert "RESULTS_DIR" in done.stdout
    assert "| torch\n" not in done.stderr
