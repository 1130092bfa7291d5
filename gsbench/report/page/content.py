"""Define the parts of the HTML report: sections with sentences, figures and tables, and the runs behind the points."""

import base64
import csv
import io
from dataclasses import dataclass, field
from functools import cached_property

from gsbench.measure.record import Record
from gsbench.report.cells import cell
from gsbench.report.configurations import Configuration, Group
from gsbench.report.page import messages
from gsbench.report.page.palette import Style
from gsbench.report.page.svg import Panel

Value = str | float | int | None
MOST_ROWS = 60  # rows of a table that the report shows; the CSV file has all
WIDEST = 135  # characters of a table that fit beside each other; the CSV file has the other columns
NARROWEST = 18  # characters of a column with long texts, which are wrapped; as in page.css
TURNED = 13  # rows up to which a table that is too wide is turned


@dataclass(frozen=True)
class Column:
    """A column of a table; `digits` is the number of decimals, or None for text and whole numbers."""

    title: str
    digits: int | None = None
    infinite: str = "∞"  # the text of an infinite number


@dataclass(frozen=True)
class DataTable:
    """The numbers behind a figure, shown as a table in the HTML report and offered there as a CSV file."""

    name: str  # of the file
    columns: list[Column]
    rows: list[list[Value]]

    @cached_property
    def shown(self) -> list[list[str]]:
        """Return the first rows of the table as text, for the HTML report, without the columns of `same`."""
        return [[show(row[i], self.columns[i]) for i in self._kept] for row in self.rows[:MOST_ROWS]]

    @cached_property
    def shown_columns(self) -> list[Column]:
        """Return the columns of `shown`."""
        return [self.columns[i] for i in self._kept]

    @cached_property
    def same(self) -> str:
        """Return the columns of text or whole numbers that have one value in all rows, with this value."""
        left = [i for i in range(len(self.columns)) if i not in self._varying]
        return "; ".join(f"{self.columns[i].title} {show(self.rows[0][i], self.columns[i])}" for i in left)

    @property
    def is_turned(self) -> bool:
        """Tell whether the HTML report shows columns as rows, because they are too many and rows are few."""
        return self._fitting < len(self._varying) and len(self.rows) < TURNED

    @property
    def hidden_columns(self) -> int:
        """Return the number of columns that the HTML report does not show; they are only in the CSV file."""
        return len(self._varying) - len(self._kept)

    @property
    def _kept(self) -> list[int]:
        """Return the numbers of the columns of `shown`."""
        return self._varying if self.is_turned else self._varying[: self._fitting]

    @cached_property
    def _fitting(self) -> int:
        """Return how many columns fit beside each other, at least two, by the lengths of their titles and texts."""
        total = 0
        for number, i in enumerate(self._varying):
            column = self.columns[i]
            longest = max((len(show(row[i], column)) for row in self.rows[:MOST_ROWS]), default=0)
            total += 2 + max(min(longest, NARROWEST), *map(len, column.title.split()))
            if total > WIDEST and number >= 2:
                return number
        return len(self._varying)

    @cached_property
    def _varying(self) -> list[int]:
        """Return the numbers of the columns that are not in `same`; the first one never is."""
        if len(self.rows) < 2:
            return list(range(len(self.columns)))
        differs = [
            column.digits is not None or len({row[i] for row in self.rows}) > 1 for i, column in enumerate(self.columns)
        ]
        return [i for i, varies in enumerate(differs) if varies or i == 0]

    @property
    def hidden(self) -> int:
        """Return the number of rows that the HTML report does not show; they are only in the CSV file."""
        return max(0, len(self.rows) - MOST_ROWS)

    @property
    def href(self) -> str:
        """Return the whole table as a CSV file in a data URL."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow([cell(c.title) for c in self.columns])
        writer.writerows(
            [None if value != value else cell(value) for value in row] for row in self.rows
        )  # NaN: an empty cell
        return f"data:text/csv;base64,{base64.b64encode(text.getvalue().encode()).decode()}"


def show(value: Value, column: Column) -> str:
    """Format a value of a table as text for the HTML report."""
    if value is None:
        return "–"
    if isinstance(value, float):
        return (
            column.infinite
            if value == float("inf")
            else messages.plain(value, 3 if column.digits is None else column.digits)
        )
    return f"{value:,}" if isinstance(value, int) else messages.shorten(value)


@dataclass(frozen=True)
class PageFigure:
    """A figure of the HTML report with its caption."""

    caption: str
    panel: Panel
    name: str  # prefix of its SVG ids, different for each figure of a page
    alt: str  # a description for readers who cannot see it

    @cached_property
    def svg(self) -> str:
        """Return the figure as an SVG element of the page."""
        return self.panel.svg(self.name, self.alt)


@dataclass(frozen=True)
class Tab:
    """The figures that one tab of the HTML report shows together."""

    label: str
    drawings: list[PageFigure]


@dataclass(frozen=True)
class Swatch:
    """An entry of a colour legend: a name and the CSS variable that holds its colour."""

    name: str
    variable: str


@dataclass(frozen=True)
class Image:
    """An image with its caption and its size in pixels; the source is a data URL."""

    caption: str
    source: str
    width: int
    height: int


@dataclass(frozen=True)
class PageSection:
    """A section of the HTML report with sentences, figures, a table and images."""

    key: str
    title: str
    sentences: list[str]
    tabs: list[Tab] = field(default_factory=list)
    table: DataTable | None = None
    beside: bool = False  # whether the table is shown beside the figures
    legend: bool = False
    notes: list[str] = field(default_factory=list)
    swatches: list[Swatch] = field(default_factory=list)  # a legend of colours
    images: list[Image] = field(default_factory=list)  # below the drawings


def scenes_title(scenes: list[str]) -> str:
    """Name scenes: a single one by its name, several by their number."""
    return scenes[0] if len(scenes) == 1 else f"mean of {messages.count(len(scenes), 'scene')}"


def shown_runs(group: Group, configurations: list[Configuration]) -> list[str]:
    """List a note on the runs of a section if it leaves out runs of other lengths or settings; empty if it has all.

    Args:
        group: the run records of one experiment.
        configurations: those that the section shows.
    """
    number = sum(len(runs) for c in configurations for runs in c.runs.values())
    others = len(group.finished) - number
    if not others or not number:
        return []
    lengths = {c.iterations for c in configurations}
    several = len({c.iterations for c in group.configurations}) > 1
    length = lengths.pop() if len(lengths) == 1 else None
    known = f"{length:,} iterations" if several and length else ""
    what = known or group.variant or "the settings of the experiment"
    return [f"Shown: {messages.count(number, 'run')} with {messages.shorten(what, 100)}. "
            f"{messages.count(others, 'run')} with other lengths or settings are left out."]  # fmt: skip


class Runs:
    """A numbered list of the runs behind the points of all figures.

    The HTML report shows the text of a run when the reader points at its point in a figure.
    """

    def __init__(self) -> None:
        self.entries: list[dict[str, str]] = []
        self._numbers: dict[tuple[str, ...], int] = {}

    def of_record(self, group: Group, record: Record) -> int:
        """Return the number of a single run in the list of runs that the figures refer to."""
        facts = _facts(*(group.value(record, q) for q in ("psnr", "seconds", "ms", "mb")))
        return self._number((messages.run_name(record),), facts, [record])

    def of_configuration(self, group: Group, configuration: Configuration, scenes: list[str]) -> int:
        """Return the number of a model with its settings in the list of runs that the figures refer to.

        Args:
            group: the run records of one experiment.
            configuration: the model with its settings, whose runs are averaged.
            scenes: the scenes over which the runs are averaged.
        """
        runs = [r for s in scenes for r in configuration.runs.get(s, [])]
        seeds = messages.count(len({r.seed for r in runs}), "seed")
        where = scenes_title(scenes)
        name = f"{configuration.name}, {where}, {seeds}"
        means = [
            [s.mean() if len(s := group.sample(configuration, scene, q)) else float("nan") for scene in scenes]
            for q in ("psnr", "seconds", "ms", "mb")
        ]
        facts = _facts(*(sum(m) / len(m) if m else float("nan") for m in means))
        return self._number((group.experiment, group.dataset, name), facts, runs if len(scenes) == 1 else [])

    def of_paper(self, record: Record) -> int:
        """Return the number of the 7DGS paper's result in the list of runs that the figures refer to.

        Args:
            record: the record of a run with the same scene and model.
        """
        name = f"the paper's {record.model} on {record.scene}"
        return self._number((record.dataset, name), "on a V100, its best on test during training", [])

    def _number(self, key: tuple[str, ...], facts: str, records: list[Record]) -> int:
        if key not in self._numbers:
            self._numbers[key] = len(self.entries)
            command = messages.command(records) if records else ""
            self.entries.append({"name": messages.shorten(key[-1], 160), "facts": facts, "command": command})
        return self._numbers[key]


@dataclass(frozen=True)
class Canvas:
    """The state that the figures of one experiment share: the list of runs, the models' styles and an SVG prefix."""

    name: str  # prefix of the SVG ids, different for each experiment
    runs: Runs
    look: dict[str, Style]  # by `Configuration.series`
    scenes: int  # number of scenes with figures of their own


def _facts(psnr: float, seconds: float, ms: float, mb: float) -> str:
    """Return a text with the PSNR and the costs of a point; unknown values are left out."""
    known = [
        (psnr, f"{messages.plain(psnr)} dB"),
        (seconds, messages.duration(seconds)),
        (ms, f"{messages.plain(ms)} ms a frame"),
    ]
    return " · ".join(text for value, text in [*known, (mb, f"{messages.plain(mb, 1)} MB")] if value == value)
