"""Build the HTML report of a folder of run records: collect its sections, render the template, write report.html."""

import functools
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib import resources
from pathlib import Path

import jinja2
from markupsafe import Markup

from gsbench.measure.atomic import write_atomically
from gsbench.measure.record import Record
from gsbench.report import layout
from gsbench.report.comparisons import comparisons
from gsbench.report.configurations import Group, groups
from gsbench.report.family import Family
from gsbench.report.page import cost, evidence, figures, messages, on_demand, time_to_quality, worth
from gsbench.report.page.content import Canvas, DataTable, PageSection, Runs
from gsbench.report.page.gallery import GalleryView, gallery
from gsbench.report.page.palette import (
    DARK,
    LIGHT,
    PAGE_DARK,
    PAGE_LIGHT,
    STAGES_DARK,
    STAGES_LIGHT,
    Style,
    styles,
    variables,
)
from gsbench.report.page.svg import marker

FILE_NAME = "report.html"
MOST_FAULTS = 20  # faulty records that are listed
MOST_SCENES = 8  # scenes with figures of their own, over all experiments of the report


@dataclass(frozen=True)
class Chapter:
    """The part of the HTML report about one experiment on one data set."""

    key: str
    title: str
    summary: str
    answers: list[cost.BudgetAnswer]
    basis: str
    seeds: tuple[str, str]  # which models have one seed only, and the command that runs more
    sections: list[PageSection]
    views: list[GalleryView]
    tables: list[layout.Table]
    failures: DataTable | None
    legend: list[tuple[str, Style]]


def write(
    records: list[Record],
    folder: Path,
    faults: Sequence[str] = (),
    *,
    reload: int = 0,
) -> Path:
    """Write the HTML report of run records to ``report.html`` in their folder, and return its path.

    Args:
        records: the run records to show, at least one.
        folder: the folder that has the records and their images; the report is written there.
        faults: the records that are left out, and why.
        reload: seconds after which an open report reloads itself; 0 for never.
    """
    path = folder / FILE_NAME
    write_atomically(path, render(records, folder, faults, reload=reload).encode())
    return path


def render(
    records: list[Record],
    folder: Path,
    faults: Sequence[str] = (),
    *,
    reload: int = 0,
) -> str:
    """Return the HTML report as text; the arguments are those of `write`."""
    found, runs = groups(records), Runs()
    chapters = _chapters(found, folder, runs)
    return _template().render(
        title=messages.shorten(folder.resolve().name, 80) or "results",
        chapters=chapters,
        runs=runs.entries,
        faults=[messages.shorten(fault) for fault in faults[:MOST_FAULTS]],
        more_faults=max(0, len(faults) - MOST_FAULTS),
        reload=reload,
        light=_definitions(variables(PAGE_LIGHT, LIGHT, STAGES_LIGHT)),
        dark=_definitions(variables(PAGE_DARK, DARK, STAGES_DARK)),
        css=_own("page.css"),
        js=_own("page.js"),
        marker=lambda style: Markup(marker(style.marker, style.colour)),
    )


def write_figures(records: list[Record], folder: Path, out: Path) -> list[Path]:
    """Write the figures of the HTML report as PDF and SVG to the folder `out`, and return the paths of the files.

    Args:
        records: the run records to show, at least one.
        folder: the folder that has the records.
        out: the folder of the files, which is made if it does not exist.
    """
    written: list[Path] = []
    found, stems = groups(records), Counter[str]()
    for group, chapter in zip(found, _chapters(found, folder, Runs()), strict=True):
        for section in chapter.sections:
            legend: list[figures.LegendEntry] = [*(chapter.legend if section.legend else []), *section.swatches]
            for tab in section.tabs:
                for drawing in tab.drawings:
                    stem = figures.file_name(group.experiment, group.dataset, section.key, tab.label, drawing.caption)
                    stems[stem] += 1
                    name = stem if stems[stem] == 1 else f"{stem}-{stems[stem]}"
                    written += figures.write(drawing.panel, legend, out / name)
    return written


def _chapters(found: list[Group], folder: Path, runs: Runs) -> list[Chapter]:
    """Make the chapter of each experiment; a model has the same style in all of them."""
    look = styles(sorted({name for group in found for name in group.series}))
    return [
        _chapter(group, folder, Canvas(f"g{i}", runs, {name: look[name] for name in group.series}, scenes))
        for scenes in [MOST_SCENES // len(found)]
        for i, group in enumerate(found)
    ]


@functools.cache
def _template() -> jinja2.Template:
    """Return the report's template, compiled once in a process."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader(__package__, "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"safe_svg": Markup, "shorten": messages.shorten, "asdict": asdict}
    return environment.get_template("page.html.j2")


def _own(name: str) -> Markup:
    """Return the text of a file in the folder of this module, such as the style sheet, to include it in the report."""
    return Markup((resources.files(__package__) / name).read_text())


def _definitions(colours: dict[str, str]) -> Markup:
    """Return colours by name as definitions of CSS variables."""
    return Markup(";".join(f"--{name}:{colour}" for name, colour in colours.items()))


def _chapter(group: Group, folder: Path, canvas: Canvas) -> Chapter:
    counts = [messages.count(n, what) for n, what in ((len(group.records), "run"), (len(group.models), "model"))]
    family = comparisons(group)
    counts += [messages.count(len(group.scenes), "scene"), messages.count(len({r.seed for r in group.records}), "seed")]
    return Chapter(
        key=canvas.name,
        title=f"experiment {group.experiment}, data {messages.shorten(group.dataset, 60)}",
        summary=" · ".join([*counts, messages.shorten(group.machine, 80)]),
        answers=cost.answers(group, family),
        basis=cost.basis_words(group, family),
        seeds=cost.seeds_words(group),
        sections=_sections(group, family, folder, canvas),
        views=gallery([r for r in group.finished if r.variant == group.variant], folder),
        tables=evidence.paper_tables(group),
        failures=evidence.failures(group),
        legend=list(canvas.look.items()),
    )


def _sections(group: Group, family: Family, folder: Path, canvas: Canvas) -> list[PageSection]:
    chosen = on_demand.on_demand_section(group, canvas, folder)
    return [
        cost.frontier_section(group, canvas),
        time_to_quality.quality_section(group, canvas),
        worth.effects_section(group, family, canvas),
        *([chosen] if chosen else []),
        worth.stages_section(group, canvas),
        time_to_quality.anytime_section(group, canvas),
        worth.pairs_section(group, family, canvas),
        evidence.protocol_section(group),
    ]
