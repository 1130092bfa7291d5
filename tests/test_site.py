"""The site that `make docs` builds: its tables, that every page and link is there, that it needs no network."""

import dataclasses
import os
import re
import shutil
import sys
from collections.abc import Callable
from html import unescape
from pathlib import Path
from urllib.parse import unquote

import pytest
import tables
from forked import python
from report.records import but
from tiny_run import ROOT, environment

from gsbench.measure.record import Record
from gsbench.measure.speed import RenderTimes
from gsbench.report import blocks, study
from gsbench.report.frame import load
from gsbench.report.output import shown_sections
from gsbench.report.render.text import markdown

PUBLISHED = ROOT / "results" / "published"
LINK = re.compile(r'<a\b[^>]*?\shref="([^"]*)"')
LOADED = re.compile(r'<(?:link\b[^>]*?\shref|[a-z]+\b[^>]*?\ssrc)="([^"]*)"')  # what a browser would load
DEAD = "http://127.0.0.1:9"  # a proxy that nothing listens at


@pytest.mark.parametrize("page", tables.TABLES)
def test_a_page_is_what_code_and_records_say(page):
    """Catches a model, a key, a default or a published record that was changed without its page."""
    assert (ROOT / page).read_text() == tables.filled(page), "write it anew by docs/site/tables.py"


@pytest.mark.parametrize("name", ["dnerf", "mini", "panoptic"])
def test_published_tables_are_those_of_their_runs(name):
    """Catches a table of before a change of what reports show, such as times of runs that shared a GPU."""
    shown = markdown(shown_sections(load(PUBLISHED / name)))
    assert (PUBLISHED / name / "table.md").read_text() == shown, "publish all studies again"


DEARER = {"train_cpu_s": 1000.0, "render_ms": RenderTimes(0.0, 100.0, 200.0)}


def changed(to: Path, name: str, change: Callable[[Record], Record]) -> None:
    """Write a published study elsewhere, with changed records."""
    records, faults = study.read(PUBLISHED / name)
    assert not faults
    study.write(map(change, records), to / name)
    blocks.study.cache_clear()


def better(record: Record, by: float) -> Record:
    """The record of the same run with a higher PSNR, on average and in each view."""
    views = [dataclasses.replace(view, psnr=view.psnr + by) for view in record.per_view if view.psnr is not None]
    return but(record, metrics={"psnr": record.metrics["psnr"] + by}, per_view=views)


def row_of(block: str, name: str) -> list[str]:
    """The cells of a row of a table."""
    (line,) = (line for line in block.splitlines() if line.startswith(f"| {name} |"))
    return [cell.strip() for cell in line.strip("|").split("|")]


def prices_of_a_field(published: Path) -> list[float]:
    """What a field gains in place of time, direction and AGR, dB, and its seconds and milliseconds."""
    row = row_of(blocks.worth(published), "a field instead of these")
    return [float(cell.split()[0].strip("*")) for cell in (row[1], *row[3:])]


def test_the_tables_follow_from_the_records(tmp_path):
    """Catches a best model, a price or a loss of choosing another one that stays when the records change."""
    for name in ("frontier", "suite", "dnerf100", "networks", "compare100"):
        shutil.copytree(PUBLISHED / name, tmp_path / name)
    before, prices = blocks.choices(tmp_path), prices_of_a_field(tmp_path)
    assert row_of(blocks.cost(tmp_path), "4,000")[5].startswith("**28.32**")
    changed(tmp_path, "frontier", lambda r: better(r, 20 * ((r.model, r.variant) == ("3dgs", "iterations=4000"))))
    assert row_of(blocks.cost(tmp_path), "4,000")[1].startswith("**37.27**")
    changed(tmp_path, "dnerf100", lambda r: but(better(r, 2.0), cost=DEARER) if r.model == "hexplane" else r)
    changed(tmp_path, "suite", lambda r: better(r, 20 * ((r.scene, r.model, r.variant) == ("suzanne", "3dgs", ""))))
    kinds = blocks.suite_kinds(tmp_path)
    assert row_of(kinds, "direction: `6dgs` - `3dgs`")[3].startswith("-3.48 ±")  # -0.14 - 20 / 6
    of_7dgs = [row_of(text, "7DGS") for text in (before, blocks.choices(tmp_path))]
    lost, of_dnerf = ([float(row[i].split(",")[0]) for row in of_7dgs] for i in (1, 3))
    assert lost[0] - lost[1] == pytest.approx((20 + 20.85 - 24.72) / 9, abs=0.02)  # without playroom and lego100
    assert 2.0 - 0.6 < of_dnerf[0] - of_dnerf[1] <= 2.0, "there the field gained 2 dB and was the best on most scenes"
    after = prices_of_a_field(tmp_path)
    assert after == pytest.approx([prices[0] + 2, 1000 - 17, 100 - 2], abs=1), "those of 7dgs are 17 s and 2 ms"
    assert row_of(kinds, "a field: `hexplane` - `3dgs`")[3] == "–", "on the other scenes, no field is published"


def test_the_tables_name_every_model_and_key():
    """Catches a table that leaves rows out, or facts of a key."""
    models = [row.split("`")[1] for row in tables.models().splitlines()[2:]]
    assert models == sorted(path.stem for path in (ROOT / "conf" / "model").glob("*.yaml"))
    config = tables.config()
    assert "`train.densify.every=100` | least steps between two rounds (≥1)\n" in config
    assert "`train.penalties.opacity,size.weight=0.0` | factor of the term (≥0)\n" in config
    assert "`train.checkpoint_minutes=2.0` | time between two checkpoints (≥0 minutes)\n" in config
    assert "`scene.name` | folder in data.root; required\n" in config


def broken(site: Path) -> list[str]:
    """The links of a site's pages that lead to nothing in it; those to other sites are not looked at."""
    pages = {path: path.read_text() for path in site.rglob("*.html")}
    ids = {path: set(re.findall(r'\sid="([^"]*)"', text)) for path, text in pages.items()}
    bad = []
    for path, text in pages.items():
        for target in map(unescape, [*LINK.findall(text), *LOADED.findall(text)]):
            name, _, anchor = unquote(target.partition("?")[0]).partition("#")
            file = (path.parent / name).resolve() if name else path
            is_outside = target.startswith(("http://", "https://", "mailto:", "data:"))
            if not is_outside and (not file.is_file() or (anchor and anchor not in ids.get(file, {anchor}))):
                bad.append(f"{path.relative_to(site)}: {target}")
    return bad


def test_code_that_a_page_shows_is_where_the_page_looks():
    """Catches a class that moved to another file, without building the site."""
    block = r"\{literalinclude\} \.\./(\S+)\n(?::\S+:.*\n)*?:pyobject: (\S+)"
    shown = [match for page in (ROOT / "docs").glob("*.md") for match in re.findall(block, page.read_text())]
    assert shown
    for file, name in shown:
        assert re.search(rf"^(class|def) {name}\b", (ROOT / file).read_text(), re.MULTILINE), (file, name)


@pytest.mark.slow
def test_the_site_builds_offline_without_a_broken_link(tmp_path):
    """Catches a warning of Sphinx, a link to a page, a heading or a file that is gone, and what needs a network."""
    site = tmp_path / "site"
    words = ("-m", "sphinx", "-q", "-E", "-W", "--keep-going", "-b", "html", "-d", str(tmp_path / "trees"))
    offline = {"http_proxy": DEAD, "https_proxy": DEAD, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = python(*words, str(ROOT / "docs"), str(site), env=environment() | offline)
    assert done.returncode == 0, done.stderr
    assert broken(site) == []
    written = {path.stem for path in (ROOT / "docs").glob("*.md")}
    assert written <= {path.stem for path in site.glob("*.html")}
    loaded = {address for path in site.rglob("*.html") for address in LOADED.findall(path.read_text())}
    assert not [address for address in loaded if address.startswith(("http:", "https:", "//"))]
    assert "red ball" in (site / "api.html").read_text()
    assert "site.css" in (site / "results.html").read_text(), "without it, a table of ten columns is cut"


def test_broken_links_of_a_site_are_found(tmp_path):
    """Catches a check that passes whatever the pages link to."""
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "c.html").write_text('<h1 id="d">d</h1>')
    (tmp_path / "a.html").write_text(
        '<a href="b/c.html#d"><a href="b/c.html#e"><a href="f.html"><img src="g.png"><a href="https://h.i/j">'
    )
    assert broken(tmp_path) == ["a.html: b/c.html#e", "a.html: f.html", "a.html: g.png"]
