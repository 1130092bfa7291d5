"""The links of README.md, the other pages of the root, and docs/: what they lead to is there, headings too."""

import re
import urllib.parse
from collections import Counter
from pathlib import Path

import pytest
from tiny_run import ROOT

PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])


def prose(page: Path) -> str:
    """A page without its code."""
    text = re.sub(r"^(```+).*?^\1", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    return re.sub(r"(`+)(?!`).+?(?<!`)\1(?!`)", "", text, flags=re.DOTALL)


def slugs(page: Path) -> set[str]:
    """The anchors that GitHub gives the headings of a page."""
    text = re.sub(r"^(```+).*?^\1", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    counts: Counter[str] = Counter()
    anchors = set()
    for heading in re.findall(r"^#+ +(.*?) *$", text, re.MULTILINE):
        words = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", heading).lower()
        slug = re.sub(r"[^\w\- ]", "", words).replace(" ", "-")
        anchors.add(f"{slug}-{counts[slug]}" if counts[slug] else slug)
        counts[slug] += 1
    return anchors


def broken(page: Path) -> list[str]:
    """The links of a page that lead to nothing; those to other sites are not looked at."""
    bad = []
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = urllib.parse.unquote(target).partition("#")
        file = page.parent / path if path else page
        if not file.exists() or not file.resolve().is_relative_to(page.parents[page.parent.name == "docs"]):
            bad.append(f"{page.name}: {target}: no such file")
        elif anchor and anchor not in slugs(file):
            bad.append(f"{page.name}: {target}: no such heading; there are {', '.join(sorted(slugs(file)))}")
    return bad


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    """Catches a file that was moved, and a heading that was reworded, under a link to it."""
    assert broken(page) == []


def test_links_that_are_broken_are_found(tmp_path: Path) -> None:
    """Catches a check that passes whatever a page links to."""
    (tmp_path / "docs").mkdir()
    (tmp_path / "other.md").write_text("# One `two`, three!\n\n# Twice\n\n# Twice\n")
    page = tmp_path / "docs" / "page.md"
    page.write_text(
        "# Own\n[a](../other.md#one-two-three) [b](#own) [c](https://a.b/c) `[d](e.md)` [f](../other.md#twice-1)\n"
        "```\n[g](h.md)\n```\n[i](j.md) [k](../other.md#four) [l](#m) [n](../../../../etc/hostname)\n"
    )
    assert [link.split(": ")[1] for link in broken(page)] == [
        "j.md",
        "../other.md#four",
        "#m",
        "../../../../etc/hostname",
    ]
