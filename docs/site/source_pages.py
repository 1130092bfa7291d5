"""Give the site a page of each file of the repository that a page of docs/ links to, such as ../gsbench/errors.py.

On GitHub such a link shows the file. The site is a copy of docs/ alone, so it shows a copy of the file; a link to a
folder becomes plain text.
"""

from collections.abc import Iterator
from html import escape
from pathlib import Path
from typing import Any

from docutils import nodes
from pygments.lexers import find_lexer_class_for_filename
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.transforms import SphinxTransform

FOLDER = "source"  # of these pages, in the site


class SourceLinks(SphinxTransform):
    """Point links that leave docs/ at the page of their file, and remember which files need one."""

    default_priority = 100

    def apply(self, **_: Any) -> None:
        """Change the links of one page."""
        links = [*self.document.findall(addnodes.download_reference), *self.document.findall(addnodes.pending_xref)]
        for link in links:
            path = link["reftarget"].partition("#")[0]
            if link.get("reftype") != "myst" or path in self.env.found_docs:  # of a docstring, or to another page
                continue
            target = self.target(f"{path}.md" if link.get("refdomain") == "doc" else path)
            if target is None or target.suffix == ".ipynb":  # a notebook is downloaded
                continue
            if target.is_dir():
                link.replace_self(link.children)
                continue
            name = target.relative_to(root_of(self.app)).as_posix()
            linked(self.env).add(name)
            link.replace_self(nodes.reference("", "", *link.children, refuri=f"{FOLDER}/{name}.html", internal=True))

    def target(self, path: str) -> Path | None:
        """Find what a link leads to, from docs/ or, in the words of README.md, from the root; None: not a file here."""
        root = root_of(self.app)
        places = [(folder / path).resolve() for folder in (Path(self.env.srcdir), root)]
        return next((place for place in places if path and place.exists() and place.is_relative_to(root)), None)


def root_of(app: Sphinx) -> Path:
    """Return the folder of the repository."""
    return Path(app.srcdir).parent


def linked(env: Any) -> set[str]:
    """Return the files that pages link to, which Sphinx keeps between builds."""
    if not hasattr(env, "linked_files"):
        env.linked_files = set()
    files: set[str] = env.linked_files
    return files


def pages(app: Sphinx) -> Iterator[tuple[str, dict[str, str], str]]:
    """Yield the pages of files: name, what is in it, template."""
    for name in sorted(linked(app.env)):
        text = (root_of(app) / name).read_text()
        lexer = find_lexer_class_for_filename(name)
        language = lexer.aliases[0] if lexer else "none"
        code = app.builder.highlighter.highlight_block(text, language, force=True)  # type: ignore[attr-defined]
        yield f"{FOLDER}/{name}", {"title": name, "body": f"<h1>{escape(name)}</h1>\n{code}"}, "page.html"


def setup(app: Sphinx) -> dict[str, bool]:
    """Register with Sphinx."""
    app.add_transform(SourceLinks)
    app.connect("html-collect-pages", pages)
    return {"parallel_read_safe": False, "parallel_write_safe": True}
