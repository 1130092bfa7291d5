"""Show sections as one HTML file with interactive figures, which needs no other file and no network."""

import base64
import functools
import hashlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

from gsbench.errors import printable
from gsbench.report.frame import Results, title_of
from gsbench.report.render import charts, text
from gsbench.report.render.palette import MARKERS, THEMES, styles
from gsbench.report.section import Figure, Section
from gsbench.report.section import text as short
from gsbench.report.sections import built

MOST_ROWS = 250  # of a table that the page shows; its CSV file has all
MOST_SORTABLE = 5000  # of a table whose rows the reader filters
MOST_FAULTS = 20  # damaged records that are listed
TURNED = 13  # columns from which a table of few rows is shown with its columns as rows


Links = Sequence[tuple[str, str]]  # texts and addresses


@dataclass(frozen=True)
class Article:
    """The part of the page about one experiment on one data set."""

    key: str
    title: str
    summary: str
    sections: list[Section]
    series: list[str] = field(default_factory=list)  # the models of the figures
    best: str = ""  # the model that pictures show first
    links: Links = ()  # to other pages about these runs


def page(title: str, results: Results, *, reload: int = 0, more: Sequence[Section] = ()) -> str:
    """Return the page of at least one run as text; no script but its own can run in it, and none may evaluate text."""
    articles = [article(f"g{i}", chapter) for i, chapter in enumerate(results.chapters())]
    return rendered(title, articles, results.faults, more, reload=reload)


def rendered(
    title: str,
    articles: Sequence[Article],
    faults: Sequence[str] = (),
    more: Sequence[Section] = (),
    *,
    reload: int = 0,
    links: Links = (),
) -> str:
    """Return the page of some articles as text.

    Args:
        title: the heading of the page.
        articles: its articles.
        faults: why records were left out.
        more: sections that are not of one experiment, such as a comparison with another folder.
        reload: seconds after which an open page reloads itself; 0 for never.
        links: other pages, named above all articles.
    """
    look = styles(name for article in articles for name in article.series)
    keyed = [(f"{article.key}-{section.key}", section) for article in articles for section in article.sections]
    keyed += [(f"more-{section.key}", section) for section in more]
    specs = {
        f"{key}-{i}": charts.spec(figure, look) for key, section in keyed for i, figure in enumerate(section.figures)
    }
    views = {key: list(map(asdict, section.images)) for key, section in keyed if section.key == "gallery"}
    scripts = [*([_library()] if specs else []), _asset("page.js")]
    return _template().render(
        title=short(title)[:80] or "results",
        articles=articles,
        more=more,
        links=links,
        look=look,
        markers=MARKERS,
        specs=specs,
        views=views,
        faults=[short(fault) for fault in faults],
        most_faults=MOST_FAULTS,
        reload=reload,
        hashes=" ".join(map(_hash, scripts)),
        scripts=[Markup(script) for script in scripts],
        css=Markup(_asset("page.css")),
        light=_variables(0),
        dark=_variables(1),
    )


def figures(results: Results, folder: Path) -> list[Path]:
    """Write all figures of the page as PDF and SVG files to a folder, and return their paths."""
    articles = [article("", chapter) for chapter in results.chapters()]
    look = styles(name for article in articles for name in article.series)
    return [
        path
        for article in articles
        for section in article.sections
        for figure in section.figures
        for path in charts.write(figure, look, folder / f"{article.title} {section.key} {figure.caption}")
    ]


def article(key: str, chapter: Results, sections: Sequence[Section] | None = None, *, links: Links = ()) -> Article:
    """Return an article about one experiment, with all its sections or with some; its key begins the ids of these."""
    runs = chapter.runs
    counts = {"run": len(runs)} | {name: runs[name].nunique() for name in ("model", "scene", "seed")}
    words = [f"{n:,} {what}{'' if n == 1 else 's'}" for what, n in counts.items()]
    summary = " · ".join([*words, printable(runs.timed_on.iloc[0])[:100]])
    mean = runs.groupby("model").psnr_db.mean()
    best = "" if mean.isna().all() else str(mean.idxmax())
    shown = built(chapter) if sections is None else sections
    shown = [replace(s, title="Results") if s.key == "experiment" else s for s in shown]  # the article has its title
    return Article(key, title_of(runs), summary, shown, sorted(runs.series.unique()), best, links)


def table(section: Section) -> dict[str, Any]:
    """Return what the template shows as a table: rows of (text, class); turned if it is wide and short.

    A column without any text is left out.
    """
    shown = section.shown().iloc[: MOST_SORTABLE if section.sortable else MOST_ROWS]
    columns = []
    for name, title in zip(section.shown_columns, shown, strict=True):
        if shown[title].ne("").any():
            kind = "number" if section.is_number(name) else ""
            cells = zip(shown[title], section.rank(name), strict=False)
            columns.append([(title, kind), *((cell, f"{kind} best" if rank == 1 else kind) for cell, rank in cells)])
    turned = len(columns) > TURNED > len(shown) and not section.sortable
    if columns and not turned:  # a group is named in its first row
        above = [None, *(text for text, _ in columns[0])]
        columns[0] = [
            (text, "repeated" if text == before else kind)
            for (text, kind), before in zip(columns[0], above, strict=False)
        ]
    rows = columns if turned else list(zip(*columns, strict=True))
    return {"rows": rows, "turned": turned, "more": len(section.table) - len(shown)}


def _keys(figure: Figure) -> dict[str, list[str]]:
    """Return what a reader can choose in a figure: its scenes and its models."""
    return {name: list(dict.fromkeys(figure.table.get(name, []))) for name in ("scene", "series")}


def _swatches(section: Section) -> list[tuple[str, str]]:
    """Return the legend of the stacked bars of a section: each part with the variable of its colour."""
    bars = [(figure.options["parts"], figure.options["colours"]) for figure in section.figures if figure.draw == "bars"]
    return [pair for parts, hues in bars for pair in zip(parts, charts.part_colours(parts, hues), strict=True)]


@functools.cache
def _template() -> jinja2.Template:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("gsbench.report", "render"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    csv = lambda section: base64.b64encode(text.csv(section.table).encode()).decode()  # noqa: E731
    environment.filters |= {"table": table, "csv": csv, "keys": _keys, "swatches": _swatches, "short": short}
    return environment.get_template("page.html.j2")


@functools.cache
def _library() -> str:
    """Return Vega, Vega-Lite and Vega-Embed as one script, from the package vl-convert-python."""
    import vl_convert  # takes a moment

    script: str = vl_convert.javascript_bundle("window.vegaEmbed = vegaEmbed;")
    return script.replace("</script", "<\\/script")  # in a text, which would end the element of the page


def _asset(name: str) -> str:
    return (resources.files("gsbench.report.render") / name).read_text()


def _hash(script: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}'"


def _variables(theme: int) -> Markup:
    return Markup(";".join(f"--{name}:{pair[theme]}" for name, pair in THEMES.items()))
