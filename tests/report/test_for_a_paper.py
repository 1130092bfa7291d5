"""What a paper takes from the report: tables as LaTeX, numbers as JSON, figures as files, and a selection of them."""

import json
import re

import pytest
from make_golden import GOLDEN, GOLDEN_LATEX, make, records

from gsbench.as_json import as_json
from gsbench.errors import InputError
from gsbench.measure import record as files
from gsbench.report import select, tables
from gsbench.report.__main__ import main
from gsbench.report.latex import escape, latex
from gsbench.report.layout import QuantityColumn, Row
from gsbench.report.page.figures import file_name
from gsbench.report.ranks import BEST, SECOND, ranks

PSNR, MINUTES = QuantityColumn("psnr", "PSNR", 2, better="higher"), QuantityColumn("s", "s", 1, better="lower")


def row(*values: float, key: str = "psnr") -> Row:
    """A measured row of one scene, with a value for each seed."""
    return Row("a model", {}, values={key: {"suzanne": dict(enumerate(values))}})


@pytest.fixture
def folder(tmp_path):
    """A folder of results with the records of the golden page."""
    for i, run in enumerate(records()):
        files.write(run, tmp_path / "results" / str(i) / files.FILE_NAME)
    return tmp_path / "results"


def written(folder):
    return sorted(path.name for path in folder.iterdir() if path.is_file())


# ---- which is best


@pytest.mark.parametrize(
    ("values", "places"),
    [
        ([(20.0,), (22.0,), (21.0,)], [0, BEST, SECOND]),
        ([(22.001,), (22.004,), (21.0,)], [BEST, BEST, SECOND]),  # they look equal
        ([(20.0, 20.1, 20.2), (20.1, 20.0, 20.3), (18.0, 18.1, 18.2)], [BEST, BEST, SECOND]),
        ([(20.0, 22.0, 24.0), (20.1, 22.1, 24.1)], [SECOND, BEST]),  # paired: always ahead by 0.1
        ([(21.0, 21.0), (float("nan"), 30.0)], [BEST, 0]),
        ([(float("nan"),)], [0]),
    ],
)
def test_ties_are_told_by_the_interval_of_the_paired_difference(values, places):
    """Catches ranks by the mean alone, by overlapping intervals, and a row that is best though a seed has no number."""
    assert ranks([row(*v) for v in values], PSNR) == places


def test_rows_of_several_scenes_are_ranked_by_seeds():
    """Catches an interval over scenes: a model is ahead on these three, by amounts that differ from scene to scene."""
    scenes = {"suzanne": 20.0, "pendulum": 26.0, "moving-matte": 31.0}
    ahead = {"suzanne": 0.1, "pendulum": 0.3, "moving-matte": 2.0}
    noise = (0.0, 0.02, -0.01)
    behind = {scene: dict(enumerate(psnr + 3 * x for x in noise)) for scene, psnr in scenes.items()}
    first = {scene: {seed: runs[seed] + ahead[scene] + noise[seed] for seed in runs} for scene, runs in behind.items()}
    rows = [Row("a model", {}, values={"psnr": runs}) for runs in (behind, first)]
    assert ranks(rows, PSNR) == [SECOND, BEST]


def test_lower_is_better_for_times_and_the_paper_has_no_rank():
    """Catches the slowest model in bold, and a number of other hardware that takes the bold from a measured one."""
    rows = [row(3.0, key="s"), Row("paper", {"s": "1.0"}, paper=True), row(2.0, key="s")]
    assert ranks(rows, MINUTES) == [SECOND, 0, BEST]
    assert ranks(rows, QuantityColumn("s", "s", 1)) == [0, 0, 0]


# ---- LaTeX


def test_the_golden_latex():
    """Catches any change of the LaTeX nobody meant. If it is meant: run make_golden.py and read the difference."""
    assert latex(tables.build(records())) == GOLDEN_LATEX.read_text()


def test_latex_is_balanced_and_every_row_has_every_column():
    """Catches a table that LaTeX refuses: an open brace or environment, a row with a cell too many or too few."""
    text = "\n".join(line for line in latex(tables.build(records())).splitlines() if not line.startswith("%"))
    bare = re.sub(r"\\[{}]", "", text)
    assert bare.count("{") == bare.count("}")
    assert text.count(r"\begin{") == text.count(r"\end{") == 2
    columns = len(re.search(r"tabular}{(l+r+)}", text)[1])
    body = text.split(r"\toprule")[1].split(r"\bottomrule")[0]
    rows = [line for line in body.splitlines() if line.endswith(r"\\") and "multicolumn" not in line]
    assert {len(re.findall(r"(?<!\\)&", line)) + 1 for line in rows} == {columns}
    assert rf"\multicolumn{{{columns}}}{{l}}{{suzanne}}" in body


def test_text_of_a_record_is_no_latex_command():
    """Catches a scene or a reason from a record that LaTeX would run, or that ends a comment."""
    nasty = "\\input{/etc/passwd} % $x_1^2$ & #~\n\\end{table*}"
    text = latex(tables.build([make(dataset=nasty), make(seed=1, dataset=nasty, status="failed", reason=nasty)]))
    assert r"\textbackslash{}input\{/etc/passwd\} \% \$x\_1\textasciicircum{}2\$ \& \#\textasciitilde{}" in text
    assert all(line.startswith("%") for line in text.splitlines() if "\\input" in line)
    assert text.count("\n\\end{table*}") == 1
    assert escape("±–\n") == r"$\pm$--\textbackslash{}n"


# ---- the command


def test_latex_and_json_are_printed_and_nothing_is_written(folder, capsys):
    """Catches `> table.tex` with another line in it, and a selection that replaces the folder's own table."""
    assert main([str(folder), "--latex"]) == 0
    assert capsys.readouterr().out == GOLDEN_LATEX.read_text() + "\n"
    assert main([str(folder), "--json"]) == 0
    json.loads(capsys.readouterr().out)
    assert main([str(folder), "--select", "model=7dgs"]) == 0
    assert "4dgs" not in capsys.readouterr().out
    for also in (["--json"], ["--latex"]):
        assert main([str(folder), "--tables", *also]) == 0
    assert r"\toprule" in capsys.readouterr().out
    assert main([str(folder), "--against", str(folder), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["theirs"] == str(folder)
    assert written(folder) == []


def test_json_has_the_numbers_of_the_table(folder, capsys):
    """Catches numbers that differ from the cells, an interval that is NaN, and runs without machine or protocol."""
    assert main([str(folder), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    (table,) = printed["tables"]
    suzanne = {one["label"]: one for one in table["sections"][1]["rows"]}
    psnr = suzanne["7dgs"]["numbers"]["psnr"]
    assert (psnr["mean"], psnr["seeds"], psnr["rank"]) == (25.5, 2, 1)
    assert psnr["by_scene_and_seed"] == {"suzanne": {"0": 25.0, "1": 26.0}}
    assert suzanne["7dgs"]["shown"]["psnr"] == f"25.50 ± {psnr['high'] - 25.5:.2f}"
    assert suzanne["4dgs"]["numbers"]["psnr"]["low"] is None
    assert suzanne["4dgs"]["numbers"]["psnr_moving"]["mean"] is None
    assert suzanne["paper, other data (4)"]["of_the_paper"]
    runs = printed["runs"]
    assert len(runs) == len(records())
    assert {run["machine"] for run in runs} == {records()[0].provenance.machine}
    assert {run["protocol_eval_split"] for run in runs} == {"test"}
    assert sorted(run["seed"] for run in runs if run["model"] == "7dgs") == [0, 0, 1, 2]


def test_json_to_a_file_comes_beside_the_usual_output(folder, tmp_path, capsys):
    """Catches a FILE that replaces the report, and one that is not the JSON that is printed."""
    assert main([str(folder), "--json", str(tmp_path / "table.json")]) == 0
    assert "Written" in capsys.readouterr().out
    assert (folder / "table.md").read_text() == GOLDEN.read_text()
    main([str(folder), "--json"])
    assert capsys.readouterr().out == (tmp_path / "table.json").read_text()


def test_unknown_numbers_are_null():
    """Catches NaN, which is no JSON, at any depth."""
    assert json.loads(as_json({"a": [float("nan"), (1.5, float("inf"))], "b": files.Path("x")})) == {
        "a": [None, [1.5, None]],
        "b": "x",
    }


# ---- the selection


def test_a_selection_keeps_its_columns_in_order(folder, capsys):
    """Catches a column that is left, lost or moved, and a status that vanishes with the column of PSNR."""
    assert main([str(folder), "--latex", "--select", "model=7dgs", "scene=suzanne", "column=fps,psnr_train"]) == 0
    text = capsys.readouterr().out
    assert r"model & FPS $\uparrow$ & PSNR train & seeds \\" in text
    assert "7dgs seed 2 & diverged & " in text
    assert "moving-matte" not in text.partition(r"\begin")[2]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["model=8dgs"], "--select model=8dgs: no such model. Did you mean '6dgs'|--select model=8dgs: no such model"),
        (["scene=suzane"], "Did you mean 'suzanne'? Valid: moving-matte, suzanne."),
        (["column=PSNR"], "Valid: fps, lpips_alex, lpips_vgg, num_gaussians, psnr, "),
        (["models=7dgs"], "expected model=.., scene=.. or column=.., got 'models=7dgs'"),
        (["model="], "expected model=.., scene=.. or column=.., got 'model='"),
        (["model=7dgs", "model=4dgs"], "expected model= once, got it twice: join the values by commas"),
        (["model=7dgs_noagr", "scene=moving-matte"], "There is: 3dgs on moving-matte, 3dgs on suzanne, "),
    ],
)
def test_a_wrong_selection_lists_what_there_is(folder, capsys, words, said):
    """Catches an empty table, or an error that leaves the user to guess the names."""
    assert main([str(folder), "--select", *words]) == 2
    err = capsys.readouterr().err
    assert any(one in err for one in said.split("|"))
    assert err.count("\n") == 1


def test_a_selection_without_words_selects_all():
    """Catches a default that leaves out a model."""
    assert select.parse([]).of(records()) == records()
    with pytest.raises(InputError):
        select.parse(["model=,"])


# ---- figures


def test_figures_are_those_of_the_page_in_real_colours(folder, tmp_path, capsys):
    """Catches a figure of the page that is not written, a placeholder colour, and a file without its legend."""
    of = ("--select", "model=4dgs,7dgs", "scene=suzanne")
    assert main([str(folder), *of, "--figures", str(tmp_path / "figures")]) == 0
    found = sorted(path.name for path in (tmp_path / "figures").iterdir())
    stems = {name.partition(".")[0] for name in found}
    assert found == sorted(f"{stem}.{kind}" for stem in stems for kind in ("pdf", "svg"))
    assert f"Written: {len(stems)} figures" in capsys.readouterr().err
    assert "mini-frontier-suzanne-psnr-against-training-seconds" in stems
    for stem in stems:
        assert (tmp_path / "figures" / f"{stem}.pdf").read_bytes().startswith(b"%PDF")
    drawn = [(tmp_path / "figures" / f"{stem}.svg").read_text() for stem in sorted(stems)]
    assert not any(re.search(r"#0(10[01]0[1-4]|200[0-9a-f]{2}|300[0-9a-f]{2})\b", text) for text in drawn)
    frontier = (tmp_path / "figures" / "mini-frontier-suzanne-psnr-against-training-seconds.svg").read_text()
    assert "7dgs" in frontier
    assert "3dgs" not in frontier


def test_a_file_name_is_no_path():
    """Catches a scene whose name leads out of the folder."""
    assert file_name("../..", "a/B\0", "é x") == "a-b-x"
