"""Tables 1 and 2 and the successors: nothing beside a published row that was measured otherwise, and whole means."""

from typing import Any

import pandas as pd
import pytest
from records import at_paper, but, lost, make, results, write_all

from gsbench.measure.record import Record
from gsbench.report import paper
from gsbench.report.__main__ import main
from gsbench.report.paper import departure
from gsbench.report.paper_tables import (
    FILES,
    OWED,
    SOURCES,
    SUCCESSOR_SCENES,
    of_the_paper,
    published,
    sections,
    seeds,
    successors,
    table1,
    table2,
    write,
)
from gsbench.report.render import text

BY_DGS: dict[str, Any] = {"name": "dgs2026", "resize": "pillow", "quantise": True, "variant": "protocol=dgs2026"}
D_NERF = paper.PROTOCOLS["D-NeRF"].scenes


def first_table(*runs: Record) -> pd.DataFrame:
    return table1(of_the_paper(results(*runs)))


def shown(*runs: Record, name: str = "table1") -> str:
    return text.markdown(sections(results(*runs))[name])


def all_scenes(model: str) -> list[Record]:
    """A run of each scene of D-NeRF, of 30, 31 .. 37 dB."""
    return [
        at_paper(model, scene, psnr=30.0 + i, eval_split="val" if scene == "lego" else "test")
        for i, scene in enumerate(D_NERF)
    ]


def test_the_difference_is_of_like_with_like():
    """Would catch a delta of the wrong sign, of another row, or one of seconds on two machines. Seeds of 30 and 31 dB
    have mean 30.5 and, by t with one degree of freedom, half an interval of 12.706 x 0.5."""
    runs = [at_paper(seed=0, psnr=30.0), at_paper(seed=1, psnr=31.0)]
    line = first_table(*runs).iloc[0]
    expected = {
        "psnr_db": 30.5,
        "psnr_db ±": 12.7062 * 0.5,
        "psnr_db paper": 30.72,
        "psnr_db difference": -0.22,
        "psnr_best_on_test_db difference": 31.0 - 30.72,
        "train_min paper": 63.4,
    }
    assert {name: line[name] for name in expected} == pytest.approx(expected, abs=1e-3)
    assert pd.isna(line["train_min difference"])
    assert "| difference | -0.22 | 0.28 |" in shown(*runs)


def test_seconds_of_two_machines_are_never_averaged():
    """Would catch minutes of a seed from another machine in one mean."""
    elsewhere = but(at_paper(seed=2, psnr=32.0), provenance={"device": "another CPU"}, cost={"train_s": 6.0})
    runs = [at_paper(seed=0, psnr=30.0), at_paper(seed=1, psnr=31.0), elsewhere]
    line = first_table(*runs).iloc[0]
    assert (line["psnr_db"], line["train_min"]) == pytest.approx((31.0, (90 + 91) / 120))


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
    assert "# Table 1" not in page
    assert not table2(results(run)).source.str.startswith("measured").any()


def test_each_data_set_has_its_own_protocol():
    """Would catch half resolution asked of Technicolor, 800x800 of heart1, test of lego, batches of 4 everywhere."""
    train = {"dataset": "Technicolor", "scene": "Train", "resolution": "2048x1088", "batch_size": 1}
    right = [
        at_paper(dataset="7DGS-PBR", scene=scene, resolution=size)
        for scene, size in (("heart1", "500x500"), ("heart2", "800x800"))
    ]
    right += [at_paper(scene="lego", eval_split="val"), at_paper(**train, frames=[151, 200])]
    assert [departure(run) for run in right] == [""] * 4
    assert departure(at_paper(**train, frames=[151, 199])) == "frames"


def test_finished_seeds_are_counted():
    """Would catch a gap that looks like a result, and a scene or a model without a count."""
    runs = [at_paper(model=m, seed=s) for m in ("4dgs", "7dgs") for s in range(3)] + [at_paper(model="3dgs")]
    counts = seeds(of_the_paper(results(*runs, at_paper(variant="recipe=paper", seed=4))), "D-NeRF").set_index("model")
    assert counts.trex.to_dict() == {"3dgs": 1, "4dgs": 3, "6dgs": 0, "7dgs_noagr": 0, "7dgs": 3}
    assert (list(counts), counts.drop(columns="trex").to_numpy().sum()) == (list(D_NERF), 0)


def test_a_row_is_of_one_recipe_and_protocol():
    """Would catch the paper's learning rates averaged with gsbench's, images of another filter as more seeds of a row,
    and one training counted as two seeds."""
    recipes = [
        at_paper(psnr=30.0),
        at_paper(psnr=20.0, variant="recipe=paper"),
        at_paper(psnr=30.0, variant="best_on_test=true"),
    ]
    lines = first_table(*recipes)
    assert lines[["recipe", "seeds", "psnr_db"]].values.tolist() == [["", 1, 30.0], ["recipe=paper", 1, 20.0]]
    runs = [at_paper(seed=0), at_paper(seed=1, **BY_DGS), at_paper(seed=2, batch_size=1)]
    runs.append(at_paper(seed=3, batch_size=1, variant="protocol=published"))
    assert first_table(*runs)[["table", "seeds"]].values.tolist() == [["paper", 1], ["other protocol", 2]]


def test_a_row_names_its_experiment_where_a_table_has_two():
    """Would catch two rows of one name, whose numbers differ."""
    two = [at_paper("7dgs"), at_paper("7dgs", experiment="mine")]
    assert "| 7dgs |" in shown(two[0])
    assert "| 7dgs mine |" in shown(*two)


def test_only_the_pool_of_most_scenes_nearest_to_the_paper_is_shown():
    """Would catch pages of trials, one long trial in place of all scenes, and 7DGS-PBR split in two by heart1."""
    trials = [at_paper(iterations=n, resolution="100x100", experiment=f"e{n}") for n in (500, 7000, 1000)]
    page = shown(*trials)
    assert "# OTHER PROTOCOL, D-NeRF: experiment e7000, 100x100, 7,000 iterations" in page
    assert page.count("# OTHER PROTOCOL") == 1
    two_scenes = [
        at_paper(scene=scene, iterations=1000, resolution="100x100", experiment="two") for scene in ("hook", "trex")
    ]
    assert "experiment two, 100x100, 1,000 iterations" in shown(*trials, *two_scenes)
    sizes = {"heart1": "250x250", "dust": "400x400", "cloud": "400x400"}
    runs = [at_paper(dataset="7DGS-PBR", scene=s, resolution=size, downscale=4) for s, size in sizes.items()]
    assert "7DGS-PBR: experiment dnerf, 250x250, 400x400, 30,000 iterations" in shown(*runs)


@pytest.mark.parametrize("odd", [["D-NeRF"], {"a": 1}, None, 3, "9" * 5000 + "x1"])
def test_odd_values_in_a_record_stop_nothing(odd):
    """Would catch a stack trace for a record whose protocol is valid JSON and nonsense."""
    runs = [at_paper(paper_dataset=odd), at_paper(resolution=odd, seed=1), at_paper(frames=odd, seed=2)]
    assert "OTHER PROTOCOL" in shown(*runs)


def test_an_average_stands_in_table_2_only_if_it_is_whole():
    """Would catch an average of seven scenes beside those of eight, and one that does not say over how many it is."""
    for runs, expected in ((all_scenes("7dgs"), [33.5]), (all_scenes("7dgs")[1:], [])):
        rows = table2(results(*runs))
        assert rows.psnr_db[rows.source.str.startswith("measured")].tolist() == expected
        assert ("| average over 8 scenes | 7dgs | 33.50 |" in shown(*runs)) == bool(expected)


def technicolor(model: str, psnr: float, **changes: Any) -> list[Record]:
    first = {"Birthday": 151, "Fabien": 51, "Painter": 100, "Theater": 51, "Train": 151}
    images = {"dataset": "Technicolor", "resolution": "2048x1088", "downscale": 1, "batch_size": 1} | changes
    return [
        at_paper(model, scene, psnr=psnr, frames=[begin, begin + 49], experiment="technicolor", **images)
        for scene, begin in first.items()
    ]


def test_measured_rows_stand_below_the_published_ones_of_their_method():
    """Would catch our 4DGaussians far from the paper's, one that is called hexplane, a model without a row or without a
    reason, an average over four scenes, and a retraining by others that looks like a number of its authors."""
    measured = {"3dgs": 25.0, "4dgs": 33.0, "hexplane": 31.0, "stg": 33.1, "7dgs": 33.7, "freetime": 40.0}
    runs = [run for model, psnr in measured.items() for run in technicolor(model, psnr)]
    rows = table2(results(*runs, *technicolor("ex4dgs", 33.4)[:4], *technicolor("6dgs", 26.0, background="white")))
    rows = rows[rows.dataset == "Technicolor"]
    assert rows[["method", "source", "psnr_db"]].fillna(0).values.tolist() == [
        ["DyNeRF", "paper, quoted", 31.80],
        ["HyperReel", "paper, quoted", 32.73],
        ["4DGaussians", "paper, retrained", 30.79],
        ["4DGaussians", "measured: hexplane, experiment technicolor", 31.0],
        ["STG", "paper, retrained", 33.23],
        ["STG", "measured: stg, experiment technicolor", 33.1],
        ["STG", "not measured: stg_full, 0 of 5 scenes", 0],
        ["4DGS", "paper, reproduced", 33.25],
        ["4DGS", "measured: 4dgs, experiment technicolor", 33.0],
        ["Ex4DGS", "paper, reproduced", 33.49],
        ["Ex4DGS", "not measured: ex4dgs, 4 of 5 scenes", 0],
        ["7DGS", "paper, reproduced", 33.58],
        ["7DGS", "measured: 7dgs, experiment technicolor", 33.7],
        ["3DGS", "measured: 3dgs, experiment technicolor", 25.0],
    ]
    page = shown(*runs, name="table2")
    assert "- retrained: quoted by the 7DGS paper (Table 2) from the paper of Ex4DGS, whose authors trained" in page
    assert "- reproduced: reproduced by the 7DGS paper (Table 2) with the method's official code" in page


def test_table_2_has_a_reason_for_each_model_without_runs():
    """Would catch a data set that nobody has here, such as Technicolor, without rows for our models."""
    rows = table2(results(at_paper("stg")))
    lacking = rows[rows.source.str.startswith("not measured")]
    assert lacking.groupby("dataset").method.apply(set).to_dict() == {key: {*OWED.values()} for key in paper.PROTOCOLS}
    assert lacking.psnr_db.isna().all()
    assert "not measured: stg, 1 of 8 scenes" in set(lacking.source[lacking.method == "STG"])


def test_hostile_names_stay_text(tmp_path):
    """Would catch a heading, a cell, a link or a formula made by a record."""
    name = "=1+1|x\n# head <script>alert(1)</script> [a](http://b)"
    write(results(make(dataset=name, protocol=at_paper().protocol), lost(at_paper(), "| \n# out")), tmp_path)
    page = (tmp_path / "table1.md").read_text()
    assert not any(line.startswith(("# head", "# out")) for line in page.splitlines())
    assert "&lt;script>" in page
    assert "\\[a\\](" in page
    assert all("|" not in line.replace("\\|", "") for line in page.splitlines() if "head" in line and line[0] != "|")
    cells = pd.read_csv(tmp_path / "table1.csv")["dataset"].tolist()
    assert cells == ["'=1+1|x\\n# head <script>alert(1)</script> [a](http://b)"]


def test_the_command_writes_its_files(tmp_path, capsys):
    """Would catch files elsewhere than the command says, and an exit code of 0 without records."""
    folder = write_all([at_paper(), at_paper("dgs"), lost(at_paper("4dgs", "lego"))], tmp_path)
    assert main([str(folder), "--tables"]) == 0
    assert sorted(path.name for path in folder.iterdir() if path.is_file()) == sorted(FILES)
    assert "Seeds, D-NeRF" in capsys.readouterr().out
    (tmp_path / "empty").mkdir()
    assert main([str(tmp_path / "empty"), "--tables"]) == 2


@pytest.mark.parametrize(("dataset", "count"), [("D-NeRF", 11), ("7DGS-PBR", 4)])
def test_published_means_are_those_of_the_published_scenes(dataset, count):
    """Would catch a number that is typed wrongly, a scene that is left out, and a mean over scenes it does not say."""
    rows = published(dataset)
    assert set(rows.source) <= set(SOURCES)
    means = rows[(rows.scene == paper.AVERAGE) & ~rows.method.str.contains("MCMC")]
    assert len(means) == count
    for mean in means.itertuples():
        scenes = [scene for scene in SUCCESSOR_SCENES[dataset] if mean.scenes != 7 or scene != "lego"]
        of = rows[(rows.method == mean.method) & (rows.source == mean.source) & rows.scene.isin(scenes)]
        assert sorted(of.scene) == sorted(scenes)
        assert mean.scenes == len(of)
        assert of.psnr_db.mean() == pytest.approx(mean.psnr_db, abs=0.0125)  # the authors round before they average


def test_the_mean_without_lego_is_beside_the_rows_that_lack_lego():
    """Would catch seven scenes compared with eight: without lego dGS' standard run is 0.8 dB better."""
    rows = successors(results(at_paper()))
    rows = rows[(rows.scene == "avg") & (rows.dataset == "D-NeRF")].set_index(["method", "scenes"])
    means = rows.psnr_best_on_test_db
    expected = {("dGS", 8): 33.59, ("dGS", 7): 34.387, ("N-DGS", 7): 33.813, ("dGS MCMC 150K", 7): 34.64}
    assert {key: means[key] for key in expected} == pytest.approx(expected, abs=1e-3)
    assert ("dGS MCMC 150K", 8) not in means


def test_a_row_of_a_successor_has_one_protocol_and_names_it():
    """Would catch runs of two protocols averaged as seeds, one without its protocol, and a trial on val as a result.
    Also images of one size kept apart, because one folder has them at twice that size."""
    rows = successors(
        results(
            at_paper("dgs", seed=0, psnr=30.0),
            at_paper("dgs", seed=6, psnr=30.0, downscale=1, variant="device=cuda,downscale=1"),
            at_paper("dgs", seed=1, psnr=31.0, **BY_DGS),
            at_paper("dgs", seed=2, psnr=32.0, quantise=True),
            at_paper("dgs", seed=3, psnr=33.0, batch_size=1, variant="recipe=mcmc,batch_size=1"),
            at_paper("dgs", seed=4, psnr=34.0, downscale=8, resolution="100x100", iterations=500),
            at_paper("dgs", seed=5, psnr=35.0, eval_split="val"),
            at_paper("3dgs", psnr=20.0),
            at_paper("dgs", psnr=21.0, dataset="mini"),
        )
    )
    measured = rows[rows.row == "measured"].sort_values("psnr_db")
    assert measured[["recipe", "protocol", "seeds", "psnr_db"]].values.tolist() == [
        ["", "gsbench, 1, 30,000 x 4", 2, 30.0],
        ["", "dgs2026, 1, 30,000 x 4", 1, 31.0],
        ["", "gsbench, 1, 30,000 x 4, quantise True", 1, 32.0],
        ["recipe=mcmc", "gsbench, 1, 30,000 x 1", 1, 33.0],
        ["", "gsbench, 1/4, 500 x 4", 1, 34.0],
    ]


@pytest.mark.parametrize(
    ("lacking", "expected"), [(None, {8: 33.5, 7: 33.5 - 0.5 / 7}), ("lego", {7: 33.5 - 0.5 / 7}), ("hook", {})]
)
def test_a_measured_mean_is_over_all_scenes_of_its_section(lacking, expected):
    """Would catch a mean over the scenes that happen to be finished beside a published mean over seven or eight."""
    runs = [run for run in all_scenes("dgs") if run.scene != lacking]
    rows = successors(results(*runs))
    rows = rows[(rows.row == "measured") & (rows.scene == "avg")]
    assert dict(zip(rows.scenes, rows.psnr_db, strict=True)) == pytest.approx(expected)
