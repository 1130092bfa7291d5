"""Tables 1 and 2 beside the paper's: golden pages, and nothing beside the paper's row that was measured otherwise."""

import dataclasses

import pandas as pd
import pytest
from make_golden import make
from make_golden_paper import GOLDEN_1, GOLDEN_2, GOLDEN_3, at_paper, records

from gsbench.measure import record as files
from gsbench.report import paper, table1
from gsbench.report.__main__ import main
from gsbench.report.conditions import conditions
from gsbench.report.paper_protocol import departure, sort
from gsbench.report.paper_tables import NAMES, build, write


def test_the_golden_pages(tmp_path):
    """Would catch any change of the pages nobody meant. If it is meant: run make_golden_paper.py and read it."""
    write(build(records()), tmp_path)
    assert (tmp_path / "table1.md").read_text() == GOLDEN_1.read_text()
    assert (tmp_path / "table2.md").read_text() == GOLDEN_2.read_text()
    assert (tmp_path / "table_successors.md").read_text() == GOLDEN_3.read_text()


def test_the_difference_is_of_like_with_like(tmp_path):
    """Would catch a delta of the wrong sign, of another row, or one of seconds on two machines.

    Seeds of 30 and 31 dB have mean 30.5 and, by t with one degree of freedom, half an interval of 12.706 x 0.5.
    """
    write(build([at_paper(seed=0, psnr=30.0), at_paper(seed=1, psnr=31.0)]), tmp_path)
    line = pd.read_csv(tmp_path / "table1.csv").iloc[0]
    assert line["psnr"] == 30.5
    assert line["psnr ±"] == pytest.approx(12.7062 * 0.5, abs=1e-3)
    assert line["psnr paper"] == 30.72
    assert line["psnr difference"] == pytest.approx(-0.22)
    assert line["psnr_best_on_test (leaks) difference"] == pytest.approx(31.0 - 30.72)  # 0.5 above the final one
    assert line["train_min paper"] == 63.4
    assert pd.isna(line["train_min difference"])
    assert "| difference | -0.22 | +0.28 |" in (tmp_path / "table1.md").read_text()


def test_seconds_of_two_machines_are_never_averaged(tmp_path):
    """Would catch minutes of a seed from another machine, or of a scene from another, in one mean."""
    runs = [at_paper(seed=0, psnr=30.0), at_paper(seed=1, psnr=31.0), at_paper(seed=2, psnr=32.0)]
    other = dataclasses.replace(runs[2].provenance, device="another CPU")
    cost = dataclasses.replace(runs[2].cost, train_s=6.0)
    runs[2] = dataclasses.replace(runs[2], provenance=other, cost=cost)
    write(build(runs), tmp_path)
    line = pd.read_csv(tmp_path / "table1.csv").iloc[0]
    assert line["psnr"] == 31.0
    assert line["train_min"] == pytest.approx((runs[0].cost.train_s + runs[1].cost.train_s) / 120)
    assert "another CPU, 2 threads (1 run)" in (tmp_path / "table1.md").read_text()


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
def test_no_other_protocol_beside_the_papers_row(change, named, tmp_path):
    """Would catch 200x200 or a stand-in shown as if it were what the paper measured."""
    run = at_paper(**change)
    assert departure(run) == named
    write(build([run]), tmp_path)
    text = (tmp_path / "table1.md").read_text()
    assert "| paper" not in text
    assert "| difference" not in text
    other = "# OTHER DATA, mini" if named == "data" else "# OTHER PROTOCOL, D-NeRF"
    assert other in text
    assert "Missing: all 8 scenes" in text
    assert "8 of 8" not in (tmp_path / "table2.md").read_text()


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
    said = table1.missing("D-NeRF", runs)
    assert "all models of bouncingballs, hellwarrior" in said
    assert "trex: 6dgs, 7dgs_noagr" in said
    assert "seeds, of 3: trex 3dgs has 1." in said
    assert "\n" not in said
    whole = [at_paper(model=m, scene=s, seed=k) for m in table1.MODELS for s in paper.PROTOCOLS["D-NeRF"].scenes
             for k in range(3)]  # fmt: skip
    assert table1.missing("D-NeRF", whole).startswith("Complete")


def test_another_recipe_has_its_own_row(tmp_path):
    """Would catch the paper's learning rates averaged with gsbench's, and one training counted as two seeds."""
    runs = [at_paper(psnr=30.0), at_paper(psnr=20.0, variant="recipe=paper"),
            at_paper(psnr=30.0, variant="best_on_test=true")]  # fmt: skip
    write(build(runs), tmp_path)
    lines = pd.read_csv(tmp_path / "table1.csv", keep_default_na=False)
    assert lines[["recipe", "seeds", "psnr"]].values.tolist() == [["", 1, 30.0], ["recipe=paper", 1, 20.0]]


def test_the_protocol_of_dgs_shares_no_mean_with_gsbenchs(tmp_path):
    """Would catch runs on images of another filter as more seeds of one row, or in one table without a word."""
    own = {"name": "dgs2026", "resize": "pillow", "quantise": True, "variant": "protocol=dgs2026"}
    runs = [at_paper(seed=0), at_paper(seed=1, **own), at_paper(seed=2, batch_size=1)]
    runs.append(at_paper(seed=3, batch_size=1, variant="protocol=published"))
    assert [len(pool.runs) for pool in sort(runs).other_protocol] == [2]  # one pool is shown, the other is named
    (left,) = sort(runs).left_out["D-NeRF"]
    assert "400x400 by pillow" in left
    write(build(runs), tmp_path)
    assert pd.read_csv(tmp_path / "table1.csv")["seeds"].tolist() == [1, 2]
    said = conditions([at_paper(), at_paper(seed=1, **{**own, "variant": ""})])
    assert any("WARNING: the rows differ in resize: area" in line and "pillow" in line for line in said)


def test_only_the_pool_nearest_to_the_paper_is_shown():
    """Would catch pages of trials, and runs that vanish without a word."""
    runs = [at_paper(iterations=n, resolution="100x100", experiment=f"e{n}") for n in (500, 7000, 1000)]
    found = sort(runs)
    assert [pool.steps for pool in found.other_protocol] == [7000]
    assert found.left_out["D-NeRF"] == [
        "1 run of D-NeRF: experiment e1000, 100x100, 1,000 iterations",
        "1 run of D-NeRF: experiment e500, 100x100, 500 iterations",
    ]


def test_scenes_of_two_sizes_share_a_table():
    """Would catch 7DGS-PBR split in two: its heart1 is smaller than its other scenes."""
    sizes = {"heart1": "250x250", "dust": "400x400"}
    runs = [at_paper(dataset="7DGS-PBR", scene=s, resolution=size, downscale=4) for s, size in sizes.items()]
    (pool,) = sort(runs).other_protocol
    assert pool.heading == "7DGS-PBR: experiment dnerf, 250x250, 400x400, 30,000 iterations"


@pytest.mark.parametrize("odd", [["D-NeRF"], {"a": 1}, None, 3, "9" * 5000 + "x1"])
def test_odd_values_in_a_record_stop_nothing(odd, tmp_path):
    """Would catch a stack trace for a record whose protocol is valid JSON and nonsense."""
    write(
        build([at_paper(paper_dataset=odd), at_paper(resolution=odd, seed=1), at_paper(frames=odd, seed=2)]), tmp_path
    )
    assert "OTHER PROTOCOL" in (tmp_path / "table1.md").read_text()


def test_an_average_stands_in_table_2_only_if_it_is_whole(tmp_path):
    """Would catch an average of seven scenes beside those of eight."""
    scenes = paper.PROTOCOLS["D-NeRF"].scenes
    whole = [
        at_paper(scene=s, psnr=30.0 + i, eval_split="val" if s == "lego" else "test") for i, s in enumerate(scenes)
    ]
    write(build(whole), tmp_path)
    assert "| measured: 7dgs | 33.50 | 34.00 |" in (tmp_path / "table2.md").read_text()
    write(build(whole[1:]), tmp_path)
    text = (tmp_path / "table2.md").read_text()
    assert "| measured: 7dgs, 7 of 8 scenes | – |" in text
    assert "33.50" not in text


def test_hostile_names_stay_text(tmp_path):
    """Would catch a heading, a cell, a link or a formula made by a record."""
    hostile = "=1+1|x\n# head <script>alert(1)</script> [a](http://b)"
    run = make(dataset=hostile, protocol=at_paper().protocol)
    broken = dataclasses.replace(at_paper(), status="failed", reason="| \n# out", metrics=None, missing={}, cost=None)
    write(build([run, broken]), tmp_path)
    text = (tmp_path / "table1.md").read_text()
    assert not any(line.startswith(("# head", "# out")) for line in text.splitlines())
    assert "&lt;script>" in text
    assert "\\[a\\](" in text
    assert all("|" not in line.replace("\\|", "") for line in text.splitlines() if "head" in line)
    cells = pd.read_csv(tmp_path / "table1.csv")["dataset"].tolist()
    assert cells == ["'=1+1|x\\n# head <script>alert(1)</script> [a](http://b)"]


def test_the_command_writes_its_files(tmp_path, capsys):
    """Would catch files elsewhere than said, a page written over, and an exit code of 0 without records."""
    for run in records():
        folder = files.run_path(tmp_path, run.experiment, run.scene, run.model, run.seed, variant=run.variant)
        files.write(run, folder / files.FILE_NAME)
    assert main([str(tmp_path), "--tables"]) == 0
    assert sorted(path.name for path in tmp_path.iterdir() if path.is_file()) == sorted(NAMES)
    assert "Missing:" in capsys.readouterr().out
    assert (tmp_path / "table1.md").read_text() == GOLDEN_1.read_text()
    (tmp_path / "empty").mkdir()
    assert main([str(tmp_path / "empty"), "--tables"]) == 2
