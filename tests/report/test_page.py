"""The page, the command and the other forms of a report: what stays text, what is written, and that it is one file."""

import base64
import dataclasses
import io
import json
import os
import re
import subprocess
import sys
import time
from html import unescape

import cv2
import numpy as np
import pandas as pd
import pytest
from parsed_page import Page
from records import (
    HOSTILE,
    but,
    chapter,
    elsewhere,
    every_row,
    frontier,
    hostile,
    lost,
    make,
    on_demand,
    results,
    sections,
    three_lengths,
    write_all,
)
from skimage.color import deltaE_ciede2000, rgb2lab

from gsbench.errors import InputError
from gsbench.measure import record as files
from gsbench.measure.images import strip, write_png
from gsbench.measure.record import Region
from gsbench.report import output, select
from gsbench.report.__main__ import main
from gsbench.report.frame import load
from gsbench.report.render import page, palette, text
from gsbench.report.section import SECTIONS, Registered, Section
from gsbench.report.sections import gallery
from gsbench.report.sections.stages import REST, STAGES

SMALL = {"models": ("3dgs", "4dgs"), "scenes": ("suzanne",), "seeds": 2, "lengths": (1000,)}


def html(*runs):
    return page.page("mini", results(*runs))


def charts_of(*runs):
    return json.loads(re.search(r'id="specs">(.*?)</script>', html(*runs), re.S)[1])


@pytest.fixture(scope="module")
def small():
    return html(*frontier(**SMALL))


@pytest.fixture
def folder(tmp_path):
    for i, run in enumerate((*every_row(), make(experiment="other", psnr=11.5))):
        files.write(run, tmp_path / "results" / str(i) / files.FILE_NAME)
    return tmp_path / "results"


# ---- the page


def test_hostile_texts_stay_text(small):
    """Catches markup, quotes, directions and length from a record that reach the page as anything but text."""
    written = html(*hostile())
    of_page = Page(written)
    assert "alert(1)" in of_page.text
    assert not [name for name, _ in of_page.attributes if name.startswith("on")]
    assert of_page.tags.count("script") == Page(small).tags.count("script")
    assert "x" * 800 not in of_page.text
    assert "\u202e" not in written
    assert len(written) < 2_500_000
    assert "<script>" in HOSTILE
    assert chapter(*hostile()).runs.device.str.startswith(HOSTILE[:50]).all()


def test_nothing_is_loaded_from_elsewhere_and_no_script_but_the_pages_own_runs(tmp_path):
    """Catches an address of the network or of the disk, and a policy that allows more than two scripts."""
    written = page.page("mini", load(write_all(frontier(**SMALL), tmp_path, pictures=1)))
    for value in Page(written).values("src", "href", "xlink:href", "action", "srcset", "poster", "data"):
        assert value.startswith(("#", "data:")), value[:80]
    assert "data:image/webp" in written
    policy = unescape(re.search(r'Content-Security-Policy" content="([^"]*)"', written)[1])
    hashes = " ".join(map(page._hash, re.findall(r"<script>(.*?)</script>", written, re.S)))
    assert policy == f"default-src 'none'; style-src 'unsafe-inline'; script-src {hashes}; img-src data:"
    assert hashes.count("sha256") == 2


def test_equal_records_give_equal_pages_and_ids_are_unique(small):
    """Catches a page that depends on the order of records, and parts of two experiments that share an id."""
    runs = frontier(**SMALL)
    assert html(*runs[::-1]) == small
    Page(html(*runs, *(but(r, experiment="other") for r in runs)))


def test_every_colour_is_defined():
    """Catches a part of a bar that is black, as there are more stages than colours, and a chart without its table or
    of columns that its data lack, such as the order of the parts of a bar."""
    runs = frontier(**SMALL)
    runs = [*runs, *on_demand(runs)]
    stages = {"stage_s": dict.fromkeys([*STAGES, "foreign"], 1.0), "train_s": 20.0}
    drawn = charts_of(but(runs[0], cost=stages), *runs[1:])
    variables = set(re.findall(r"var\(--([\w-]+)\)", json.dumps(drawn)))
    assert {f"stage-{i}" for i in range(len(STAGES) + 1)} <= variables <= palette.THEMES.keys()
    assert len(palette.OF_STAGES) == len((*STAGES, REST))
    keys = {"frontier", "pairs", "effects", "curves", "on_demand", "stages"}
    assert {key.split("-")[1] for key in drawn} == keys
    assert all(len(section.table) for section in sections(*runs).values() if section.key != "gallery")
    for key, chart in drawn.items():
        columns = {name for rows in chart["datasets"].values() for row in rows for name in row}
        assert set(re.findall(r'"field": "([^"]+)"', json.dumps(chart))) <= columns, key


def test_charts_hold_the_numbers_of_their_tables():
    """Catches a figure of other numbers than those of its table, one that goes as one run lacks its cost, infinity in
    its JSON, and numbers of a logarithmic axis that touch."""
    drawn, of = charts_of(*frontier(**SMALL)), sections(*frontier(**SMALL))
    (rows,) = drawn["g0-frontier-0"]["datasets"].values()
    means = [row["psnr_db"] for row in rows if row["kind"] == "mean"]
    assert means == pytest.approx(of["frontier"].table.psnr_db.tolist(), rel=1e-4)
    assert {row["kind"] for row in rows} == {"mean", "run"}
    (rows,) = drawn["g0-curves-0"]["datasets"].values()
    assert [row["train_s"] for row in rows] == pytest.approx(of["curves"].table.train_s.tolist(), rel=1e-4)
    figures = {key for key in charts_of(*frontier(**SMALL), elsewhere(make(), "other")) if "frontier" in key}
    assert figures == {key for key in drawn if "frontier" in key}
    (rows,) = charts_of(*three_lengths())["g0-frontier-0"]["datasets"].values()
    best = {(row["model"], row["variant"]) for row in rows if row["best"] is True and row["kind"] == "mean"}
    assert best == {("a", ""), ("a", "iterations=4"), ("b", ""), ("b", "iterations=9")}
    json.dumps(drawn, allow_nan=False)
    assert all(chart["config"]["axis"]["labelSeparation"] >= 4 for chart in drawn.values())


def test_what_did_not_finish_is_on_the_page():
    """Catches a page without the reason of a failure, one failure that hides what finished, and lost faults."""
    runs = frontier(("3dgs", "7dgs"), lengths=(1000,))
    written = Page(html(lost(runs[0]), *runs[1:])).text
    assert "out of memory" in written
    assert "mean of 2 scenes" in written
    assert "No run has finished" in Page(html(*map(lost, runs))).text
    faulty = dataclasses.replace(results(*runs), faults=tuple(f"fault {i}" for i in range(30)))
    assert "and 10 more" in Page(page.page("x", faulty)).text


def test_a_table_shows_its_first_rows_and_its_file_has_all():
    """Catches a page of thousands of rows, and a file that lacks some or rounds."""
    section = sections(*frontier(seeds=30, scenes=("suzanne",), lengths=(500, 1000)))["runs"]
    shown = page.table(section)
    assert (len(shown["rows"]), shown["more"]) == (page.MOST_ROWS + 1, 300 - page.MOST_ROWS)
    table = pd.read_csv(io.StringIO(text.csv(section.table)))
    assert table.psnr_db.tolist() == section.table.psnr_db.tolist()


@pytest.mark.slow
def test_five_thousand_records():
    """Catches a page that takes longer than 60 s or grows beyond 10 MB with the number of runs."""
    scenes, lengths = tuple(f"scene{i}" for i in range(10)), tuple(250 * i for i in range(1, 11))
    runs = frontier(scenes=scenes, seeds=10, lengths=lengths)
    assert len(runs) == 5000
    start = time.process_time()
    written = html(*runs)
    assert time.process_time() - start < 60
    assert len(written.encode()) < 10_000_000


# ---- colours


@pytest.mark.parametrize("theme", [0, 1])
def test_colours_of_models_can_be_read_and_told_from_each_other(theme):
    """Catches a colour that disappears on its page, and 7dgs, 7dgs_noagr and auto in three shades of one colour."""
    colours = [palette.PAGE["paper"][theme], *(pair[theme] for pair in palette.OF_MODELS)]
    rgb = np.array([[int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)] for colour in colours])
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    light = linear @ (0.2126, 0.7152, 0.0722) + 0.05  # WCAG
    assert (np.maximum(light[1:], light[0]) / np.minimum(light[1:], light[0])).min() >= 4.5
    lab = rgb2lab(rgb[None, 1:])[0]
    apart = deltaE_ciede2000(lab[:, None], lab[None]) + 100 * np.eye(len(lab))
    usual = [palette.MODELS.index(m) for m in ("3dgs", "4dgs", "6dgs", "7dgs", "7dgs_noagr", "auto")]
    assert apart.min() > 11
    assert apart[np.ix_(usual, usual)].min() > 18
    assert len(palette.OF_MODELS) == len(palette.MARKERS) == len(set(palette.MARKERS))


def test_a_model_keeps_its_colour():
    """Catches colours that depend on which other models are there, and two models that share one."""
    assert palette.styles(["3dgs", "7dgs"])["7dgs"] == palette.styles(["7dgs"])["7dgs"]
    known = palette.styles([*palette.MODELS, "another"])
    assert len(set(known.values())) == len(known)
    assert len(palette.styles([f"m{i}" for i in range(40)])) == 40


# ---- pictures


def shown_views(folder):
    (of,) = load(folder).chapters()
    section = gallery.gallery(of, pd.DataFrame())
    return [] if section is None else list(section.images)


def test_strips_are_cut_back_to_their_images(tmp_path):
    """Catches a crop that is off by the gap or the header, pixels that stay enlarged, and a crash at a foreign file."""
    random = np.random.default_rng(0)
    for shape, count in (((30, 50, 3), 3), ((300, 260, 3), 1)):
        pairs = random.random((count, 2, *shape))
        write_png(strip([*pairs]), tmp_path / "pictures.png")
        rows = np.array([parts[:2] for parts in gallery.cut(tmp_path / "pictures.png", f"{shape[1]}x{shape[0]}")])
        assert rows.shape == pairs.shape
        assert abs(rows[..., ::-1] - pairs * 255).max() <= 0.5 + 1e-4
    for resolution in ("259x300", "260x299", "not loaded"):
        assert gallery.cut(tmp_path / "pictures.png", resolution) == []
    (tmp_path / "pictures.png").write_bytes(b"no image")
    assert [gallery.cut(tmp_path / name, "260x300") for name in ("pictures.png", "none.png")] == [[], []]


def test_the_gallery_has_every_model_on_the_same_view_with_its_score(tmp_path):
    """Catches a view without a model, names and scores of other views, and regions that are not there."""
    runs = frontier(("3dgs", "7dgs"), ("suzanne",), 1, (1000,))
    scored = [
        dataclasses.replace(view, psnr_moving=None if i == 3 else 20.0 + i) for i, view in enumerate(runs[1].per_view)
    ]
    runs[1] = but(runs[1], per_view=scored, regions={"moving": Region("masks", 9, 0.1, "0" * 64)})
    views = shown_views(write_all(runs, tmp_path, pictures=3))
    assert [view.name for view in views] == ["test/r_000", "test/r_003", "test/r_006"]
    assert list(views[0].render) == list(views[0].error) == ["3dgs", "7dgs"]
    data = base64.b64decode(views[0].truth.partition(",")[2])
    assert cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR).shape == (40, 60, 3)
    plain, moving = ([f"PSNR {run.per_view[i].psnr:.2f} dB" for i in (0, 3, 6)] for run in runs)
    assert [view.scores["3dgs"] for view in views] == plain
    endings = ("20.00", "–", "26.00")
    assert [view.scores["7dgs"] for view in views] == [f"{m}, moving {e}" for m, e in zip(moving, endings, strict=True)]


def test_files_of_more_views_are_shown_beside_those_of_fewer(tmp_path):
    """Catches a render of another view beside the true image: files have the views evenly spaced among all of them."""
    runs = frontier(("3dgs", "7dgs"), ("suzanne",), 1, (1000,))
    folder = write_all(runs, tmp_path, pictures=3)
    (path,) = folder.glob("suzanne/7dgs*/seed0/pictures.png")
    colours = np.linspace(0, 1, 5)
    write_png(strip([np.full((2, 40, 60, 3), colour) for colour in colours]), path)
    views = shown_views(folder)
    assert [view.name for view in views] == ["test/r_000", "test/r_006"]
    assert [view.scores["7dgs"] for view in views] == [f"PSNR {runs[1].per_view[i].psnr:.2f} dB" for i in (0, 6)]
    for view, colour in zip(views, colours[[0, 3]], strict=True):
        data = base64.b64decode(view.render["7dgs"].partition(",")[2])
        assert abs(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR).mean() - 255 * colour) < 2


def test_the_pictures_fit(tmp_path, monkeypatch):
    """Catches images that make the page too large: noise compresses worst, and the budget is for one view of three."""
    runs = frontier(("3dgs", "7dgs"), ("suzanne",), 1, (1000,))
    folder = write_all([*runs, *on_demand(runs[1:])], tmp_path, pictures=3)
    everything = sum(view.size for view in shown_views(folder))
    for budget, expected in ((everything // 5, 1), (10, 0)):
        monkeypatch.setattr(gallery, "BUDGET", budget)
        assert len(views := shown_views(folder)) == expected
        assert sum(view.size for view in views) <= budget
    of_sets = [("a", folder / "suzanne" / "auto" / "seed0" / "effect_sets.png")] * 20
    assert gallery.images(of_sets[:1])[0].width == 912
    assert sum(len(image.source) for image in gallery.images(of_sets)) <= gallery.IMAGES_BUDGET


# ---- text forms


def test_text_from_a_record_cannot_break_a_form(tmp_path):
    """Catches a reason with a pipe, a newline or a command that breaks Markdown, LaTeX or a terminal, a formula that a
    spreadsheet computes, a negative number that is made a text, and a CSV that rounds."""
    nasty = "=a | b\nc <script> \x1b[31m \\input{/etc/passwd} % $x_1^2$ & #~"
    of = results(
        make(dataset=nasty, metrics=make().metrics | {"psnr": -1.5000000001}), lost(make(seed=1, dataset=nasty), nasty)
    )
    shown = output.shown_sections(of)
    markdown = text.markdown(shown)
    assert "<script" not in markdown
    assert r"a \| b\\nc &lt;script>" in markdown
    for form in (markdown, text.terminal(shown), text.latex(shown)):
        assert not {c for c in form if not c.isprintable()} - {"\n"}
    latex = [line for line in text.latex(shown).splitlines() if not line.startswith("%")]
    assert not re.search(r"(?<!\\textbackslash\{\})(?<!\\)\\input", "\n".join(latex))
    assert text.tex("±–\n_") == r"$\pm$--\textbackslash{}n\_"
    output.write(of, tmp_path, [])
    table = pd.read_csv(tmp_path / "table.csv")
    assert table.reason[1].startswith("'=a | b\\nc")
    assert table.psnr_db[0] == -1.5000000001


def test_latex_is_balanced_and_every_row_has_every_column():
    """Catches a table that LaTeX refuses: an open brace or environment, a row with a cell too many or too few."""
    written = text.latex(output.shown_sections(results(*every_row()), latex=True))
    bare = re.sub(r"\\[{}]", "", "\n".join(line for line in written.splitlines() if not line.startswith("%")))
    assert bare.count("{") == bare.count("}")
    columns = len(re.search(r"tabular}{([lr]+)}", bare)[1])
    rows = [line for line in bare.splitlines() if line.endswith(r"\\")]
    assert {len(re.findall(r"(?<!\\)&", line)) + 1 for line in rows} == {columns}
    assert r"\textbf{25.50} {\scriptsize $\pm$ 6.35}" in written
    assert r"\underline{23.00}" in written
    assert "Underlined: the second best." in written
    assert "With *:" in text.terminal(output.shown_sections(results(*every_row())))


def test_a_table_without_rows_has_no_head_in_a_terminal():
    """Catches titles of columns, and a list of those that do not fit, above nothing."""
    empty = Section("a", "Title", "Words.", pd.DataFrame({"a" * 50: [], "b" * 50: [], "c" * 50: []}))
    assert text.terminal([empty]).split("\n") == ["Title", "", "Words.", ""]


@pytest.mark.parametrize("width", [120, 80, 40])
def test_the_terminal_form_fits(width):
    """Catches a line that wraps, also with several seeds, every column and a long model name, rows of two variants
    that look alike, a lost column, and a text or a note that is not printed."""
    metrics = make().metrics | {"lpips_vgg": 0.25, "psnr_best_on_test": 26.5}
    runs = [*every_row(), make(seed=3, metrics=metrics, missing={})]
    names = [f"a_model_with_a_name_of_more_than_{n}_letters_____" for n in ("forty", "fifty")]
    runs += [make(name, seed=seed) for name in names for seed in (0, 1)]
    sections = output.shown_sections(results(*runs))
    lines = text.terminal(sections, width).splitlines()
    assert max(map(len, lines)) <= width
    assert any("for lack of width" in line for line in lines)
    assert "for lack of width" not in text.terminal(sections, 1000)
    assert all(any(f"{name[:21]}..{name[-21:]}"[: width - 2] in line for line in lines) for name in names)
    printed = "".join("".join(lines).split())
    words = [part for section in sections for part in (section.title, section.text, *section.notes)]
    words = [part.replace("Bold: ", "With *: ") for part in words]
    assert all("".join(part.split()) in printed for part in words)


def test_each_section_stands_where_its_flags_say(monkeypatch):
    """Catches a flag of a section that acts nowhere, and a form that picks its sections by their places."""

    def memory(chapter, _):
        return Section("memory", "Memory", "", chapter.runs[["model", "peak_mb"]])

    keys = lambda **form: [of.key for of in output.shown_sections(results(*every_row()), **form)]  # noqa: E731
    before, before_latex = keys(), keys(latex=True)
    assert (before[0], before[-1], before_latex[0]) == ("experiment", "protocol", "experiment")
    monkeypatch.setitem(SECTIONS, "memory", Registered(memory, None, in_terminal=True, in_latex=True))
    assert keys() == [*before[:-1], "memory", "protocol"]
    assert keys(latex=True) == [*before_latex, "memory"]


# ---- the command


def test_the_command_prints_and_writes(folder, capsys):
    """Catches a command that needs anything but a folder, forgets an experiment, a file or PSNR on training views."""
    assert main([str(folder)]) == 0
    printed = capsys.readouterr().out
    for part in ("experiment mini, data mini", "experiment other, data mini", "11.50*"):
        assert part in printed
    assert max(map(len, printed.splitlines()[:-1])) <= 120
    assert len(pd.read_csv(folder / "table.csv")) == len(every_row()) + 1
    assert "| 3dgs |" in (folder / "table.md").read_text()
    assert Page((folder / "report.html").read_text())
    assert "PSNR train" not in printed
    assert main([str(folder), "--train"]) == 0
    assert "PSNR train" in capsys.readouterr().out


def test_other_forms_are_printed_and_nothing_is_written(folder, tmp_path, capsys):
    """Catches another line in table.tex, a number that JSON lacks or rounds, a lost run, and another selection."""

    def printed(*words):
        assert main([str(folder), *words]) == 0
        assert not [path for path in folder.iterdir() if path.is_file()]
        return capsys.readouterr().out

    assert printed("--latex").count(r"\begin{table*}") == 2
    text = printed("--select", "model=7dgs,4dgs", "scene=suzanne", "column=fps,psnr_db,peak_mb")
    assert "3dgs" not in text
    assert text.index("FPS") < text.index("PSNR") < text.index("peak_mb")
    assert "LPIPS-Alex" not in text.partition("Protocol")[0].partition("Mean over")[0]
    of = json.loads(printed("--json"))
    (row,) = (row for row in of["sections"][1]["rows"] if row.get("model") == "7dgs" and row["scene"] == "suzanne")
    assert (row["psnr_db"], row["seeds"]) == (25.5, 2)
    assert [run["seed"] for run in of["runs"]].count(2) == 1
    assert {run["data_hash"][:4] for run in of["runs"]} == {"5e5e", "3a3a"}
    assert main([str(folder), "--train", "--select", "column=psnr_db"]) == 2
    assert "--train: expected no column= beside it" in capsys.readouterr().err
    assert main([str(folder), "--json", str(tmp_path / "x.json")]) == 0
    assert json.loads((tmp_path / "x.json").read_text()) == of
    assert (folder / "report.html").exists()


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["model=7dg"], "Did you mean '7dgs'?"),
        (["column=psnr"], "Did you mean 'psnr_db'?"),
        (["colour=red"], "expected model=.., scene=.. or column=.."),
        (["model="], "expected model=.."),
        (["model=7dgs", "model=4dgs"], "once, got it twice"),
        (["model=3dgs_x"], "no such model"),
        (["model=7dgs_noagr", "scene=moving-matte"], "got none"),
    ],
)
def test_a_wrong_selection_lists_what_there_is(words, expected):
    """Catches a stack trace, and an empty table without a word."""
    with pytest.raises(InputError, match=re.escape(expected)):
        select.selected(results(*every_row()), select.parse(words))


def test_figures_are_written_in_real_colours(tmp_path):
    """Catches figures without a scene, with variables of a style sheet for colours, or with a path in a name."""
    folder = write_all(frontier(**SMALL | {"scenes": ("a", "b")}), tmp_path)
    assert main([str(folder), "--select", "model=3dgs,4dgs", "--figures", str(tmp_path / "figures")]) == 0
    names = {path.name for path in (tmp_path / "figures").iterdir()}
    assert "experiment-mini-data-mini-frontier-psnr-against-mb-mean-of-2-scenes.pdf" in names
    assert {path.rpartition(".")[2] for path in names} == {"pdf", "svg"}
    svg = (tmp_path / "figures" / "experiment-mini-data-mini-curves-psnr-on-val-while-training-b.svg").read_text()
    assert "var(" not in svg
    assert palette.OF_MODELS[0][0] in svg
    assert "4dgs" in svg, "a legend"


def test_the_command_is_clear_where_there_is_nothing_to_show(tmp_path, capsys):
    """Catches a stack trace, or an exit status of 0, for an empty folder, a missing one, or one that is no folder."""
    for folder in (tmp_path, tmp_path / "missing"):
        assert main([str(folder)]) == 2
        assert "found no" in capsys.readouterr().err
    (tmp_path / "record.json").write_text("{")
    assert main([str(tmp_path)]) == 1
    assert f"left out: {tmp_path}/record.json: expected JSON" in capsys.readouterr().err
    assert not (tmp_path / "table.md").exists()
    files.write(make(), tmp_path / "a" / files.FILE_NAME)
    assert main([str(tmp_path)]) == 1
    printed = capsys.readouterr()
    assert "25.00*" in printed.out
    assert "left out" in printed.err
    (tmp_path / "a" / "table.md").mkdir()
    assert main([str(tmp_path / "a")]) == 2
    assert "table.md" in capsys.readouterr().err


def test_the_command_is_quick_to_help_and_silent_for_a_reader_that_ends(folder):
    """Catches a package that imports torch, or the charts' libraries, to say how it is used, and an error and an exit
    status for `python -m gsbench.report FOLDER | head`."""
    words = [sys.executable, "-X", "importtime", "-m", "gsbench.report"]
    done = subprocess.run([*words, "--help"], capture_output=True, text=True, check=True)
    assert "FOLDER" in done.stdout
    assert not re.search(r"\| *(torch|vl_convert)\n", done.stderr)
    read, write = os.pipe()
    os.close(read)
    words = [sys.executable, *words[3:], str(folder), "--select", "model=7dgs"]
    done = subprocess.run(words, stdout=write, stderr=subprocess.PIPE, text=True, check=False)
    os.close(write)
    assert (done.returncode, done.stderr) == (0, "")


def test_live_writes_again_when_a_record_arrives(tmp_path, capsys, monkeypatch):
    """Catches a loop that draws once, one that stops at a missing folder, and one that has no end."""
    runs = frontier(("3dgs", "7dgs"), ("suzanne",), 1, (1000,))
    steps = iter([lambda: write_all(runs[:1], tmp_path), lambda: write_all(runs[1:], tmp_path), lambda: None])
    path, pages = tmp_path / "mini" / "report.html", []

    def sleep(_):
        pages.append(path.read_text() if path.exists() else None)
        try:
            next(steps)()
        except StopIteration:
            raise KeyboardInterrupt from None

    monkeypatch.setattr(time, "sleep", sleep)
    assert main([str(tmp_path / "mini"), "--live", "--train"]) == 0
    printed = capsys.readouterr().out.splitlines()
    for part, line in zip(("expected a folder of results", "1 records", "2 records"), printed, strict=False):
        assert part in line
    assert printed[-1].startswith("Stopped. 2 records")
    assert pages[0] is None
    assert 'data-reload="5"' in pages[1]
    assert pages[2] == pages[3]
    assert 'data-reload="0"' in path.read_text()
    assert "PSNR train" in path.with_name("table.md").read_text()
