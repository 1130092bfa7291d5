"""The site that `make docs` builds: its tables, that every page and link is there, that it needs no network."""

import importlib.util
import os
import subprocess
import sys
from collections import defaultdict
from html.parser import HTMLParser
from pathlib import Path
from types import ModuleType
from urllib.parse import unquote

import pytest
from tiny_run import ROOT, environment

DEAD = "http://127.0.0.1:9"  # a proxy that nothing listens at


@pytest.fixture(scope="module")
def tables() -> ModuleType:
    """docs/site/tables.py, which is no module of a package."""
    spec = importlib.util.spec_from_file_location("site_tables", ROOT / "docs" / "site" / "tables.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", ["models", "config", "results"])
def test_a_table_is_what_the_code_says(tables: ModuleType, name: str) -> None:
    """Catches a model, a key, a default or a published record that was changed without its page."""
    assert (ROOT / "docs" / f"{name}.md").read_text() == tables.filled(name), "write it anew by docs/site/tables.py"


def test_the_tables_name_every_model_and_key(tables: ModuleType) -> None:
    """Catches a table that leaves rows out, or keys whose comment in gsbench/config.py is not found."""
    models = [row.split("`")[1] for row in tables.models().splitlines()[2:]]
    assert models == sorted(path.stem for path in (ROOT / "conf" / "model").glob("*.yaml"))
    config = tables.config()
    assert "| `train.densify.every` | `100` | least number of steps between two rounds" in config
    assert "| `init.ply` | `null`, str | trained 3D Gaussians in the format of 3DGS |" in config


class Page(HTMLParser):
    """The links, the anchors and what a browser would load of an HTML page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.loaded: list[str] = []
        self.ids: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = defaultdict(str, {key: value or "" for key, value in attrs})
        self.ids.add(given["id"])
        if tag == "a" and given["href"]:
            self.links.append(given["href"])
        self.loaded += [one for one in (given["src"], given["href"] if tag == "link" else "") if one]


def broken(site: Path) -> list[str]:
    """The links of a site's pages that lead to nothing in it; those to other sites are not looked at."""
    pages = {path: Page(path.read_text()) for path in site.rglob("*.html")}
    bad = []
    for path, page in pages.items():
        for target in [*page.links, *page.loaded]:
            if target.startswith(("http://", "https://", "mailto:", "data:")):
                continue
            name, _, anchor = unquote(target.partition("?")[0]).partition("#")
            file = (path.parent / name).resolve() if name else path
            if not file.is_file() or (anchor and file in pages and anchor not in pages[file].ids):
                bad.append(f"{path.relative_to(site)}: {target}")
    return bad


@pytest.mark.slow
def test_the_site_builds_offline_without_a_broken_link(tmp_path: Path) -> None:
    """Catches a warning of Sphinx, a link to a page, a heading or a file that is gone, and what needs a network."""
    site = tmp_path / "site"
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", "-q", "-E", "-W", "--keep-going", "-b", "html", "-d", str(tmp_path / "trees"),
         str(ROOT / "docs"), str(site)],
        capture_output=True, text=True, check=False,
        env={**environment(), "http_proxy": DEAD, "https_proxy": DEAD, "PYTHONPATH": os.pathsep.join(sys.path)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert broken(site) == []
    written = {path.stem for path in (ROOT / "docs").glob("*.md")}
    assert written <= {path.stem for path in site.glob("*.html")}
    loaded = {one for path in site.rglob("*.html") for one in Page(path.read_text()).loaded}
    assert not [one for one in loaded if one.startswith(("http:", "https:", "//"))]
    assert "red ball" in (site / "api.html").read_text()


def test_broken_links_of_a_site_are_found(tmp_path: Path) -> None:
    """Catches a check that passes whatever the pages link to."""
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "c.html").write_text('<h1 id="d">d</h1>')
    (tmp_path / "a.html").write_text(
        '<a href="b/c.html#d"><a href="b/c.html#e"><a href="f.html"><img src="g.png"><a href="https://h.i/j">'
    )
    assert broken(tmp_path) == ["a.html: b/c.html#e", "a.html: f.html", "a.html: g.png"]
