"""Tables 1 and 2 and the successors: nothing beside a published row that was measured otherwise, and whole means."""

import dataclasses
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from make_golden import make
from paper_records import at_paper, records

from gsbench.measure import record as files
from gsbench.measure.record import Record
from gsbench.report import frame, paper
from gsbench.report.__main__ import main
from gsbench.report.paper_protocol import departure
from gsbench.report.paper_tables import (
    FILES,
    MODELS,
    SOURCES,
    SUCCESSOR_SCENES,
    missing,
    of_the_paper,
    published,
    sections,
    successors,
    table1,
    table2,
    write,
)
from gsbench.report.render import text


def as_tables(*runs: Record) -> frame.Results:
    return frame.tables([(Path(str(i)), run) for i, run in enumerate(runs)], [])


def first_table(*runs: Record) -> pd.DataFrame:
    return table1(of_the_paper(as_tables(*runs)))


def shown(*runs: Record, name: str = "table1") -> str:
    return text.markdown(sections(as_tables(*runs))[name])


def test_the_difference_is_of_like_with_like():
    """Would catch a delta of the wrong sign, of another row, or one of seconds on two machines.

    Seeds of 30 and 31 dB have mean 30.5 and, by t with one degree of freedom, half an interval of 12.706 x 0.5.
    """
    runs = [at_paper(seed=0, psnr=30.0), at_paper(seed=1, psnr=31.0)]
    line = first_table(*runs).iloc[0]
    assert line["psnr_db"] == 30.5
    assert line["psnr_db ±"] == pytest.approx(12.7062 * 0.5, abs=1e-3)
    assert line["psnr_db paper"] == 30.72
    assert line["psnr_db difference"] == pytest.approx(-0.22)
    assert line["psnr_best_on_test_db difference"] == pytest.approx(31.0 - 30.72)  # 0.5 above the final one
    assert line["train_min paper"] == 63.4
    assert pd.isna(line["train_min difference"])
    assert "| difference | -0.22 | 0.28 |" in shown(*runs)


def test_seconds_of_two_machines_are_never_averaged():
    """Would catch minutes of a seed from another machine, or of a scene from another, in one mean."""
    runs = [at_paper(seed=0, psnr=30.0), at_paper(seed=1, psnr=31.0), at_paper(seed=2, psnr=32.0)]
    other = dataclasses.replace(runs[2].provenance, device="another CPU")
    cost = dataclasses.replace(runs[2].cost, train_s=6.0)
    runs[2] = dataclasses.replace(runs[2], provenance=other, cost=cost)
    line = first_table(*runs).iloc[0]
    assert line["psnr_db"] == 31.0
    assert line["train_min"] == pytest.approx((runs[0].cost.train_s + runs[1].cost.train_s) / 120)
    assert "another CPU, 2 threads (1 run)" in shown(*runs)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"resolution": "200x200"}, "size"),
        ({"iterations": 7000}, "iterations"),
        ({"batch_size": 1}, "batch size"),
        ({"eval_split": "val"}, "split"),
        ({"background": "white"}, "background"),
        ({"quantise": True}, "quantisation"),
        ({"resize": "pillow"}, "filter"),
        ({"frames": [0, 49]}, "frames"),
        ({"dataset": "mini"}, "data"),
        ({"scene": "invented"}, "scene"),
    ],
)
def test_no_other_protocol_beside_the_papers_row(change, named):
    """Would catch 200x200 or a stand-in shown as if it were what the paper measured."""
    run = at_paper(**change)
    assert departure(run) == named
    assert first_table(run)["psnr_db paper"].isna().all()
    page = shown(run)
    assert ("# OTHER DATA, mini" if named == "data" else "# OTHER PROTOCOL, D-NeRF") in page
    assert "Missing: all 8 scenes" in page
    assert not table2(of_the_paper(as_tables(run))).source.str.startswith("measured").any()


def test_each_data_set_has_its_own_protocol():
    """Would catch half resolution asked of Technicolor, 800x800 of heart1, test of lego, batches of 4 everywhere."""
    right = [
        at_paper(dataset="7DGS-PBR", scene="heart1", resolution="500x500"),
        at_paper(dataset="7DGS-PBR", scene="heart2", resolution="800x800"),
        at_paper(scene="lego", eval_split="val"),
        at_paper(dataset="Technicolor", scene="Train", resolution="2048x1088", batch_size=1, frames=[151, 200]),
    ]
    assert [departure(run) for run in right] == [""] * 4
    wrong = at_paper(dataset="Technicolor", scene="Train", resolution="2048x1088", batch_size=1, frames=[151, 199])
    assert departure(wrong) == "frames"


def test_the_scenes_are_those_of_the_papers_table():
    """Would catch a scene that is asked for and never found, or an average over fewer scenes than the paper's."""
    for dataset, protocol in paper.PROTOCOLS.items():
        theirs = {s for d, s, _ in paper.table1() if d == dataset} - {paper.AVERAGE}
        assert {s.lower() for s in protocol.scenes} == theirs


def test_what_is_missing_is_said_in_one_line():
    """Would catch a gap that looks like a result."""
    runs = [at_paper(model=m, seed=s) for m in ("4dgs", "7dgs") for s in range(3)] + [at_paper(model="3dgs")]
    line = missing("D-NeRF", of_the_paper(as_tables(*runs)))
    assert "all models of bouncingballs, hellwarrior" in line
    assert "trex: 6dgs, 7dgs_noagr" in line
    assert "seeds, of 3: trex 3dgs has 1." in line
    assert "\n" not in line
    whole = [at_paper(model=m, scene=s, seed=k) for m in MODELS for s in paper.PROTOCOLS["D-NeRF"].scenes
             for k in range(3)]  # fmt: skip
    assert missing("D-NeRF", of_the_paper(as_tables(*whole))).startswith("Complete")


def test_another_recipe_has_its_own_row():
    """Would catch the paper's learning rates averaged with gsbench's, and one training counted as two seeds."""
    runs = [at_paper(psnr=30.0), at_paper(psnr=20.0, variant="recipe=paper"),
            at_paper(psnr=30.0, variant="best_on_test=true")]  # fmt: skip
    lines = first_table(*runs)
    assert lines[["recipe", "seeds", "psnr_db"]].values.tolist() == [["", 1, 30.0], ["recipe=paper", 1, 20.0]]


def test_the_protocol_of_dgs_shares_no_mean_with_gsbenchs():
    """Would catch runs on images of another filter as more seeds of one row, or in one table without a word."""
    own = {"name": "dgs2026", "resize": "pillow", "quantise": True, "variant": "protocol=dgs2026"}
    runs = [at_paper(seed=0), at_paper(seed=1, **own), at_paper(seed=2, batch_size=1)]
    runs.append(at_paper(seed=3, batch_size=1, variant="protocol=published"))
    assert first_table(*runs)[["table", "seeds"]].values.tolist() == [["paper", 1], ["other protocol", 2]]
    assert (
        "Left out, at another protocol than the paper's: 1 run of D-NeRF: experiment dnerf, 400x400 by pillow"
        in shown(*runs)
    )


def test_only_the_pool_nearest_to_the_paper_is_shown():
    """Would catch pages of trials, and runs that vanish without a word."""
    runs = [at_paper(iterations=n, resolution="100x100", experiment=f"e{n}") for n in (500, 7000, 1000)]
    page = shown(*runs)
    assert "# OTHER PROTOCOL, D-NeRF: experiment e7000, 100x100, 7,000 iterations" in page
    assert page.count("# OTHER PROTOCOL") == 1
    assert ("1 run of D-NeRF: experiment e1000, 100x100, 1,000 iterations; "
            "1 run of D-NeRF: experiment e500, 100x100, 500 iterations.") in page  # fmt: skip


def test_scenes_of_two_sizes_share_a_table():
    """Would catch 7DGS-PBR split in two: its heart1 is smaller than its other scenes."""
    sizes = {"heart1": "250x250", "dust": "400x400"}
    runs = [at_paper(dataset="7DGS-PBR", scene=s, resolution=size, downscale=4) for s, size in sizes.items()]
    assert "7DGS-PBR: experiment dnerf, 250x250, 400x400, 30,000 iterations" in shown(*runs)


@pytest.mark.parametrize("odd", [["D-NeRF"], {"a": 1}, None, 3, "9" * 5000 + "x1"])
def test_odd_values_in_a_record_stop_nothing(odd):
    """Would catch a stack trace for a record whose protocol is valid JSON and nonsense."""
    runs = [at_paper(paper_dataset=odd), at_paper(resolution=odd, seed=1), at_paper(frames=odd, seed=2)]
    assert "OTHER PROTOCOL" in shown(*runs)


def test_an_average_stands_in_table_2_only_if_it_is_whole():
    """Would catch an average of seven scenes beside those of eight."""
    scenes = paper.PROTOCOLS["D-NeRF"].scenes
    whole = [
        at_paper(scene=s, psnr=30.0 + i, eval_split="val" if s == "lego" else "test") for i, s in enumerate(scenes)
    ]
    for runs, expected in ((whole, [33.5]), (whole[1:], [])):
        rows = table2(of_the_paper(as_tables(*runs)))
        assert rows.psnr_db[rows.source.str.startswith("measured")].tolist() == expected


def test_hostile_names_stay_text(tmp_path):
    """Would catch a heading, a cell, a link or a formula made by a record."""
    hostile = "=1+1|x\n# head <script>alert(1)</script> [a](http://b)"
    run = make(dataset=hostile, protocol=at_paper().protocol)
    broken = dataclasses.replace(at_paper(), status="failed", reason="| \n# out", metrics=None, missing={}, cost=None)
    write(as_tables(run, broken), tmp_path)
    page = (tmp_path / "table1.md").read_text()
    assert not any(line.startswith(("# head", "# out")) for line in page.splitlines())
    assert "&lt;script>" in page
    assert "\\[a\\](" in page
    assert all("|" not in line.replace("\\|", "") for line in page.splitlines() if "head" in line)
    cells = pd.read_csv(tmp_path / "table1.csv")["dataset"].tolist()
    assert cells == ["'=1+1|x\\n# head <script>alert(1)</script> [a](http://b)"]


def test_the_command_writes_its_files(tmp_path, capsys):
    """Would catch files elsewhere than said, a page written over, and an exit code of 0 without records."""
    for run in records():
        folder = files.run_path(tmp_path, run.experiment, run.scene, run.model, run.seed, variant=run.variant)
        files.write(run, folder / files.FILE_NAME)
    assert main([str(tmp_path), "--tables"]) == 0
    assert sorted(path.name for path in tmp_path.iterdir() if path.is_file()) == sorted(FILES)
    assert "Missing:" in capsys.readouterr().out
    (tmp_path / "empty").mkdir()
    assert main([str(tmp_path / "empty"), "--tables"]) == 2


@pytest.mark.parametrize("dataset", SUCCESSOR_SCENES)
def test_published_means_are_those_of_the_published_scenes(dataset):
    """Would catch a number that is typed wrongly, a scene that is left out, and a mean over scenes it does not say."""
    rows = published(dataset)
    assert set(rows.source) <= set(SOURCES)
    means = rows[(rows.scene == paper.AVERAGE) & ~rows.method.str.contains("MCMC")]
    assert len(means) == {"D-NeRF": 6, "7DGS-PBR": 4}[dataset]
    for mean in means.itertuples():
        of = rows[(rows.method == mean.method) & (rows.scene != paper.AVERAGE)]
        assert set(of.scene) == set(SUCCESSOR_SCENES[dataset])
        assert mean.scenes == len(of)
        assert of.psnr_db.mean() == pytest.approx(mean.psnr_db, abs=0.0125)  # the authors round before they average


def test_the_mean_without_lego_is_beside_the_rows_that_lack_lego():
    """Would catch seven scenes compared with eight: without lego dGS' standard run is 0.8 dB better."""
    rows = successors(as_tables(at_paper()))
    rows = rows[(rows.scene == "avg") & (rows.dataset == "D-NeRF")].set_index(["method", "scenes"])
    means = rows.psnr_best_on_test_db
    assert means["dGS", 8] == 33.59
    assert means["dGS", 7] == pytest.approx(34.387, abs=1e-3)
    assert means["N-DGS", 7] == pytest.approx(33.813, abs=1e-3)
    assert means["dGS MCMC 150K", 7] == 34.64
    assert ("dGS MCMC 150K", 8) not in means


def test_a_row_has_one_protocol_and_names_it():
    """Would catch runs of two protocols averaged as seeds, one without its protocol, and a trial on val as a result."""
    by_dgs: dict[str, Any] = {"name": "dgs2026", "resize": "pillow", "quantise": True, "variant": "protocol=dgs2026"}
    rows = successors(as_tables(
        at_paper("dgs", seed=0, psnr=30.0),
        at_paper("dgs", seed=1, psnr=31.0, **by_dgs),
        at_paper("dgs", seed=2, psnr=32.0, quantise=True),
        at_paper("dgs", seed=3, psnr=33.0, batch_size=1, variant="recipe=mcmc,batch_size=1"),
        at_paper("dgs", seed=4, psnr=34.0, downscale=8, iterations=500),
        at_paper("dgs", seed=5, psnr=35.0, eval_split="val"),
        at_paper("3dgs", psnr=20.0),
        at_paper("dgs", psnr=21.0, dataset="mini"),
    ))  # fmt: skip
    measured = rows[rows.row == "measured"].sort_values("psnr_db")
    assert measured[["recipe", "protocol", "seeds", "psnr_db"]].values.tolist() == [
        ["", "gsbench, 2, 30,000 x 4", 1, 30.0],
        ["", "dgs2026, 2, 30,000 x 4", 1, 31.0],
        ["", "gsbench, 2, 30,000 x 4, quantise True", 1, 32.0],
        ["recipe=mcmc", "gsbench, 2, 30,000 x 1", 1, 33.0],
        ["", "gsbench, 8, 500 x 4", 1, 34.0],
    ]


def test_a_measured_mean_is_over_all_scenes_of_its_section():
    """Would catch a mean over the scenes that happen to be finished beside a published mean over seven or eight."""
    runs = [at_paper("dgs", scene, psnr=30.0 + i, eval_split="val" if scene == "lego" else "test")
            for i, scene in enumerate(SUCCESSOR_SCENES["D-NeRF"])]  # fmt: skip
    for lacking, expected in ((None, {8: 33.5, 7: 33.5 - 0.5 / 7}), ("lego", {7: 33.5 - 0.5 / 7}), ("hook", {})):
        results = as_tables(*(run for run in runs if run.scene != lacking))
        rows = successors(results)
        rows = rows[(rows.row == "measured") & (rows.scene == "avg")]
        assert dict(zip(rows.scenes, rows.psnr_db, strict=True)) == pytest.approx(expected)
        assert "No finished run here of ubs, dbs" in text.markdown(sections(results)["table_successors"])
