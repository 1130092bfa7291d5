"""Errors, warnings and comments of gsbench that point to a page of docs/: the page and its heading are there."""

import ast
import pickle
import re
from pathlib import Path

import pytest
from test_links import slugs
from tiny_run import ROOT, main_here

from gsbench.errors import DOCS, InputError, TooLargeError

SOURCES = sorted((ROOT / "gsbench").rglob("*.py"))


def pointers_in(source: str) -> list[str]:
    """What a source gives as `docs=`, and its constants that point to a heading, which other modules may import."""
    nodes = list(ast.walk(ast.parse(source)))
    constants = {ast.unparse(node.targets[0]): node.value for node in nodes if isinstance(node, ast.Assign)}
    words = [word.value for node in nodes if isinstance(node, ast.Call) for word in node.keywords if word.arg == "docs"]
    values = [constants.get(ast.unparse(word), word) for word in words]
    here = [ast.literal_eval(value) for value in values if not isinstance(value, ast.Name)]  # others are imported
    texts = [value.value for value in constants.values() if isinstance(value, ast.Constant)]
    return here + [text for text in texts if isinstance(text, str) and ".md#" in text]


def missing(pointer: str) -> bool:
    """Whether the page, or the heading, that a pointer such as data.md#fetching names is not there."""
    name, _, anchor = pointer.partition("#")
    page = ROOT / DOCS / name
    return not page.is_file() or (anchor != "" and anchor not in slugs(page))


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT / "gsbench")))
def test_pointers_lead_to_a_heading(path: Path) -> None:
    """Catches a page that was moved, and a heading that was reworded, under an error that names it."""
    source = path.read_text()
    written = re.findall(rf"\b{DOCS}/(\w+\.md(?:#[\w-]+)?)", source)
    assert [pointer for pointer in (*pointers_in(source), *written) if missing(pointer)] == []


def test_a_test_of_pointers_finds_them() -> None:
    """Catches a walk that sees no pointer, and a check that accepts any."""
    assert sum(len(pointers_in(path.read_text())) for path in SOURCES) > 30
    assert pointers_in("raise InputError(f'{x}', docs='data.md#fetching') from None") == ["data.md#fetching"]
    assert pointers_in("PAGE = 'data.md#times'") == ["data.md#times"]
    assert pointers_in("PAGE = 'data.md'\nraise InputError('no images', docs=PAGE)") == ["data.md"]
    assert not missing("data.md#fetching")
    assert missing("data.md#fetched")
    assert missing("datum.md")


def test_the_printed_line_ends_with_the_pointer(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Catches a pointer that is kept and not printed, and one on a second line."""
    assert main_here("+exp=dnerf", "model=3dgs", f"results={tmp_path}") == 2
    *_, line = capsys.readouterr().err.splitlines()
    assert line.startswith("gsbench: error: data.root is not set")
    assert line.endswith(" (docs/data.md#what-is-read)")


@pytest.mark.parametrize("kind", [InputError, TooLargeError])
def test_a_worker_sends_the_pointer(kind: type[InputError]) -> None:
    """Catches an error that cannot be unpickled in the process that started the worker, or that has two pointers."""
    sent = pickle.loads(pickle.dumps(kind("no images", docs="data.md")))
    assert type(sent) is kind
    assert str(sent) == "no images (docs/data.md)"
