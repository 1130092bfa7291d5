"""The table of successors: published numbers that agree with their means, and measured rows that say their protocol."""

from statistics import fmean

import pandas as pd
import pytest
from make_golden_paper import at_paper

from gsbench.report import paper, paper_tables
from gsbench.report.table_successors import SCENES, SOURCES, build, published


@pytest.mark.parametrize("dataset", SCENES)
def test_published_means_are_those_of_the_published_scenes(dataset):
    """Would catch a number that is typed wrongly, a scene that is left out, and a mean over scenes it does not say."""
    rows = published(dataset)
    assert {row.source for row in rows} <= set(SOURCES)
    means = [row for row in rows if row.scene == paper.AVERAGE and "MCMC" not in row.method]
    assert len(means) == {"D-NeRF": 6, "7DGS-PBR": 4}[dataset]
    for mean in means:
        own = {row.scene: row.psnr for row in rows if row.method == mean.method and row.scene != paper.AVERAGE}
        assert set(own) == set(SCENES[dataset])
        assert mean.scenes == len(own)
        assert fmean(own.values()) == pytest.approx(mean.psnr, abs=0.0125)  # the authors round before they average


def test_the_mean_without_lego_is_beside_the_rows_that_lack_lego(tmp_path):
    """Would catch seven scenes compared with eight: without lego dGS' standard run is 0.8 dB better."""
    paper_tables.write(paper_tables.build([at_paper()]), tmp_path)
    lines = pd.read_csv(tmp_path / "table_successors.csv")
    means = lines[(lines["scene"] == "avg") & (lines["dataset"] == "D-NeRF")]
    found = means.set_index(["method", "scenes"])["psnr_best_on_test (leaks)"]
    assert found["dGS", 8] == 33.59
    assert found["dGS", 7] == pytest.approx(34.387, abs=1e-3)
    assert found["N-DGS", 7] == pytest.approx(33.813, abs=1e-3)
    assert found["dGS MCMC 150K", 7] == 34.64
    assert ("dGS MCMC 150K", 8) not in found


def test_a_row_has_one_protocol_and_names_it(tmp_path):
    """Would catch runs of two protocols averaged as seeds, one without its protocol, and a trial on val as a result."""
    theirs = {"name": "dgs2026", "resize": "pillow", "quantise": True, "variant": "protocol=dgs2026"}
    runs = [
        at_paper("dgs", seed=0, psnr=30.0),
        at_paper("dgs", seed=1, psnr=31.0, **theirs),
        at_paper("dgs", seed=2, psnr=32.0, quantise=True),
        at_paper("dgs", seed=3, psnr=33.0, batch_size=1, variant="recipe=mcmc,batch_size=1"),
        at_paper("dgs", seed=4, psnr=34.0, downscale=8, iterations=500),
        at_paper("dgs", seed=5, psnr=35.0, eval_split="val"),
        at_paper("3dgs", psnr=20.0),
        at_paper("dgs", psnr=21.0, dataset="mini"),
    ]
    paper_tables.write(paper_tables.build(runs), tmp_path)
    lines = pd.read_csv(tmp_path / "table_successors.csv", keep_default_na=False)
    measured = lines[lines["row"] == "measured"][["recipe", "protocol", "seeds", "psnr"]].values.tolist()
    assert sorted(measured, key=lambda row: row[-1]) == [
        ["", "gsbench, 2, 30,000 x 4", "1", "30.0"],
        ["", "dgs2026, 2, 30,000 x 4", "1", "31.0"],
        ["", "gsbench, 2, 30,000 x 4, quantise True", "1", "32.0"],
        ["recipe=mcmc", "gsbench, 2, 30,000 x 1", "1", "33.0"],
        ["", "gsbench, 8, 500 x 4", "1", "34.0"],
    ]


def test_a_measured_mean_is_over_all_scenes_of_its_section():
    """Would catch a mean over the scenes that happen to be finished beside a published mean over seven or eight."""
    scenes = SCENES["D-NeRF"]
    runs = [at_paper("dgs", scene, psnr=30.0 + i, eval_split="val" if scene == "lego" else "test")
            for i, scene in enumerate(scenes)]  # fmt: skip
    for missing, expected in ((None, {8: 33.5, 7: 33.5 - 0.5 / 7}), ("lego", {7: 33.5 - 0.5 / 7}), ("hook", {})):
        tables, lines = build([run for run in runs if run.scene != missing])
        means = {one["scenes"]: one["psnr"] for one in lines if one["row"] == "measured" and one["scene"] == "avg"}
        assert means == pytest.approx(expected)
        assert any("No finished run here of ubs, dbs" in note for note in tables[0].footnotes)
