"""Links of the pages of the root and of docs/, and pages that errors and comments name: what they lead to is there."""

import ast
import pickle
import re
import urllib.parse
from collections import Counter
from pathlib import Path

import pytest
from tiny_run import ROOT, main_here

from gsbench.errors import DOCS, InputError, TooLargeError

PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / DOCS).glob("*.md")])
SOURCES = sorted((ROOT / "gsbench").rglob("*.py"))
BLOCK = re.compile(r"^(```+).*?^\1", re.MULTILINE | re.DOTALL)


def slugs(page: Path) -> set[str]:
    """The anchors that GitHub gives the headings of a page."""
    counts: Counter[str] = Counter()
    anchors = set()
    for heading in re.findall(r"^#+ +(.*?) *$", BLOCK.sub("", page.read_text()), re.MULTILINE):
        words = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", heading).lower()
        slug = re.sub(r"[^\w\- ]", "", words).replace(" ", "-")
        anchors.add(f"{slug}-{counts[slug]}" if counts[slug] else slug)
        counts[slug] += 1
    return anchors


def broken(page: Path) -> list[str]:
    """The links of a page that lead to no file or heading; those to other sites are not looked at."""
    prose = re.sub(r"(`+)(?!`).+?(?<!`)\1(?!`)", "", BLOCK.sub("", page.read_text()), flags=re.DOTALL)
    bad = []
    for target in re.findall(r"\]\(([^)\s]+)\)", prose):
        path, _, anchor = urllib.parse.unquote(target).partition("#")
        file = page.parent / path if path else page
        root = page.parents[page.parent.name == DOCS]
        if not re.match(r"[a-z]+:", target) and (
            not file.exists() or not file.resolve().is_relative_to(root) or (anchor and anchor not in slugs(file))
        ):
            bad.append(target)
    return bad


def constants_of(source: str) -> dict[str, ast.expr]:
    """What a source assigns to names."""
    return {
        ast.unparse(node.targets[0]): node.value for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Assign)
    }


def pointers_in(source: str, imported: dict[str, ast.expr]) -> list[str]:
    """The pages that a source names: in calls as `docs=`, as text or by a constant, and as docs/x.md."""
    constants = imported | constants_of(source)
    calls = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call)]
    words = [word.value for call in calls for word in call.keywords if word.arg == "docs"]
    by_argument = [ast.literal_eval(constants.get(ast.unparse(word), word)) for word in words]
    return [*by_argument, *re.findall(rf"\b{DOCS}/(\w+\.md(?:#[\w-]+)?)", source)]


def missing(pointer: str) -> bool:
    """Whether the page, or the heading, that a pointer such as data.md#fetching names is not there."""
    name, _, anchor = pointer.partition("#")
    page = ROOT / DOCS / name
    return not page.is_file() or (anchor != "" and anchor not in slugs(page))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    """Catches a file that was moved, and a heading that was reworded, under a link to it."""
    assert broken(page) == []


def test_pointers_of_errors_and_comments_lead_to_a_heading():
    """Catches a page that was moved, and a heading that was reworded, under an error that names it."""
    texts = {path: path.read_text() for path in SOURCES}
    constants = {name: value for text in texts.values() for name, value in constants_of(text).items()}
    pointers = {path.relative_to(ROOT): pointers_in(text, constants) for path, text in texts.items()}
    assert sum(map(len, pointers.values())) > 30
    assert [(path, pointer) for path, names in pointers.items() for pointer in names if missing(pointer)] == []


def test_what_leads_nowhere_is_found(tmp_path):
    """Catches checks that pass whatever a page links to or an error names."""
    (tmp_path / "docs").mkdir()
    (tmp_path / "other.md").write_text("# One `two`, three!\n\n# Twice\n\n# Twice\n")
    page = tmp_path / "docs" / "page.md"
    page.write_text(
        "# Own\n[a](../other.md#one-two-three) [b](#own) [c](https://a.b/c) `[d](e.md)` [f](../other.md#twice-1)\n"
        "```\n[g](h.md)\n```\n[i](j.md) [k](../other.md#four) [l](#m) [n](../../../../etc/hostname)\n"
    )
    assert broken(page) == ["j.md", "../other.md#four", "#m", "../../../../etc/hostname"]
    assert pointers_in("raise InputError(f'{x}', docs='data.md#fetching') from None", {}) == ["data.md#fetching"]
    assert pointers_in("PAGE = 'data.md'\nraise InputError('no images', docs=PAGE)", {}) == ["data.md"]
    assert [missing(pointer) for pointer in ("data.md#fetching", "data.md#fetched", "datum.md")] == [False, True, True]


def test_the_printed_line_ends_with_the_pointer(tmp_path, capsys):
    """Catches a pointer that is kept and not printed, and one on a second line."""
    assert main_here("+exp=dnerf", "model=3dgs", f"results={tmp_path}") == 2
    *_, line = capsys.readouterr().err.splitlines()
    assert line.startswith("gsbench: error: data.root is not set")
    assert line.endswith(" (docs/data.md#what-is-read)")


@pytest.mark.parametrize("kind", [InputError, TooLargeError])
def test_a_worker_sends_the_pointer(kind):
    """Catches an error that cannot be unpickled in the process that started the worker, or that has two pointers."""
    sent = pickle.loads(pickle.dumps(kind("no images", docs="data.md")))
    assert type(sent) is kind
    assert str(sent) == "no images (docs/data.md)"
