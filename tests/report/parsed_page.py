"""Parse a page of HTML for tests: its elements are closed in order, ids are unique, and links lead to them."""

import json
from html.parser import HTMLParser

import pytest

VOID = {"meta", "link", "img", "input", "br", "hr"}


class Page(HTMLParser):
    """The elements, the attributes and the visible texts of a page that is whole."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str]] = []
        self.texts: list[str] = []
        self.feed(html)
        self.close()
        ids, links = self.values("id"), [*self.values("aria-labelledby"), *self.values("href")]
        assert not self.open, f"not closed: {self.open}"
        assert len(ids) == len(set(ids))
        self.pages = [link for link in links if link.endswith(".html")]  # of a site
        inside = {link.removeprefix("#") for link in {*links} - {*self.pages} if not link.startswith("data:")}
        assert inside <= {*ids}, "a link to nothing"

    def values(self, *names: str) -> list[str]:
        return [value for name, value in self.attributes if name in names]

    @property
    def text(self) -> str:
        """All visible text, with single spaces, and the texts of attributes that are read aloud."""
        return " ".join(" ".join([*self.texts, *self.values("aria-label", "alt", "title")]).split())

    def handle_starttag(self, tag, attrs):
        assert len(dict(attrs)) == len(attrs), f"an attribute comes twice: {attrs}"
        self.tags.append(tag)
        self.attributes += [(name, value or "") for name, value in attrs]
        self.open += [] if tag in VOID else [tag]

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.handle_endtag(tag)

    def handle_endtag(self, tag):
        assert [tag] == self.open[-1:], f"</{tag}> closes {self.open[-3:]}"
        self.open.pop()

    def handle_data(self, data):
        if not {"script", "style"} & set(self.open):
            self.texts.append(data)
        elif data.startswith("{"):
            json.loads(data, parse_constant=pytest.fail)
