"""Define a section of a report (a table with its figures and a paragraph), how cells are shown, and the registry.

A section is a function that is registered with `@section`; it takes the tables of one experiment and returns a Section,
or None where it has nothing to show. Every renderer (gsbench.report.render) starts from the same shown table.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import pandas as pd

from gsbench.errors import printable
from gsbench.report import stats
from gsbench.report.columns import RUNS
from gsbench.report.frame import Results

EMPTY = "–"
LONGEST = 700  # characters of a text of a record that a cell shows


@dataclass(frozen=True)
class Column:
    """How a column is shown: its title, its decimals (None: two below ten, else one) and which values are better."""

    title: str
    digits: int | None = 2
    better: str = ""  # "higher" or "lower"; empty if models are not ranked by it
    signed: bool = False

    def show(self, value: float) -> str:
        """Format a number of this column."""
        return number(value, self.digits_of(value), signed=self.signed)

    def digits_of(self, value: float) -> int:
        """Return the decimals with which a value is shown."""
        return self.digits if self.digits is not None else 1 if abs(value) >= 10 else 2


COLUMNS = {column.name: Column(column.title, column.digits, column.better) for column in RUNS if column.title} | {
    "p_holm": Column("p, Holm", 3),
    "low": Column("95 % low", 2, signed=True),
    "high": Column("95 % high", 2, signed=True),
}


@dataclass(frozen=True)
class Figure:
    """A figure of a section: its caption, the function of gsbench.report.render.charts that draws it, and its table."""

    caption: str
    draw: str
    table: pd.DataFrame
    options: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Section:
    """A part of a report; the table has numbers, which every renderer shows by `columns`.

    A column "psnr_db ±" is shown in the cell of "psnr_db", and "psnr_db rank" marks it (1: best, 2: second best).
    """

    key: str
    title: str
    text: str
    table: pd.DataFrame
    columns: dict[str, Column] = field(default_factory=dict)
    figures: tuple[Figure, ...] = ()
    notes: tuple[str, ...] = ()
    folded: bool = False  # whether a page shows the table only on demand
    images: tuple[Any, ...] = ()  # what gsbench.report.sections.gallery cuts from the files of runs
    sortable: bool = False  # whether the reader of a page sorts and filters the rows, of which it shows more

    @property
    def shown_columns(self) -> list[str]:
        """Return the names of the columns that are shown as such, without intervals and ranks."""
        return [name for name in self.table if not str(name).endswith((" ±", " rank"))]

    def column(self, name: str) -> Column:
        """Return how a column is shown."""
        return self.columns.get(name) or COLUMNS.get(name) or Column(name)

    def shown(self, mark: Callable[[str, int], str] = lambda text, _: text) -> pd.DataFrame:
        """Return the table as texts on one line each, by title; `mark` gets the text of a number and its rank."""
        titles = [self.column(name).title for name in self.shown_columns]
        assert len(set(titles)) == len(titles), f"{self.key}: two columns have one title: {titles}"
        texts = [self._texts(name, mark) for name in self.shown_columns]
        return pd.DataFrame(dict(zip(titles, texts, strict=True)), dtype=object)

    def is_number(self, name: str) -> bool:
        """Tell whether a column is of numbers, which are aligned at the right."""
        return pd.api.types.is_numeric_dtype(self.table[name]) and not pd.api.types.is_bool_dtype(self.table[name])

    def rank(self, name: str) -> list[int]:
        """Return the ranks of a column: 1 for the best, 2 for the second best, 0 for others."""
        ranks = self.table.get(f"{name} rank")
        return [0] * len(self.table) if ranks is None else ranks.fillna(0).astype(int).tolist()

    def _texts(self, name: str, mark: Callable[[str, int], str]) -> list[str]:
        halves = self.table.get(f"{name} ±", [math.nan] * len(self.table))
        is_number = self.is_number(name)
        values = zip(self.table[name], halves, strict=True)
        cells = [self._number(name, value, half) if is_number else text(value) for value, half in values]
        return [mark(cell, rank) if rank else cell for cell, rank in zip(cells, self.rank(name), strict=True)]

    def _number(self, name: str, value: float, half: float) -> str:
        if math.isnan(value):
            return EMPTY
        column = self.column(name)
        is_whole = name not in self.columns and name not in COLUMNS and float(value).is_integer()  # such as a count
        digits = 0 if is_whole else column.digits_of(value)
        return number(value, digits, signed=column.signed) + ("" if math.isnan(half) else f" ± {number(half, digits)}")


def number(value: float, digits: int, *, signed: bool = False) -> str:
    """Format a number with commas; a difference has a sign; what rounds to zero has none; infinity is "never"."""
    if not math.isfinite(value):
        return EMPTY if math.isnan(value) else "never"
    zero = f"{0:.{digits}f}"
    shown = f"{value:{'+' if signed else ''},.{digits}f}"
    return zero if shown.lstrip("+-") == zero else shown


def text(value: Any) -> str:
    """Return a value that is no number on one short line; what is missing is empty."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None or value != value:
        return ""
    line = printable(str(value)[: 4 * LONGEST])
    return line if len(line) <= LONGEST else f"{line[: LONGEST - 1]}…"


Asked = list[tuple[str, str, stats.Weights]]  # a quantity, a name and a weighted sum of models
Build = Callable[[Results, pd.DataFrame], Section | None]


@dataclass(frozen=True)
class Registered:
    """A function that makes a section, and one that returns the differences that this section tests."""

    build: Build
    asks: Callable[[Results], Asked] | None
    in_terminal: bool
    in_latex: bool


SECTIONS: dict[str, Registered] = {}  # by the name of their functions


def section(
    asks: Callable[[Results], Asked] | None = None, *, in_terminal: bool = False, in_latex: bool = False
) -> Callable[[Build], Build]:
    """Register a function that makes a section of one experiment from its tables and the tested differences.

    Args:
        asks: returns the differences that the section shows as significant or not. They come back as the rows of
            `tested`, adjusted for all comparisons of the report.
        in_terminal: whether the terminal and ``table.md`` show the section too; the page and --json show every one.
        in_latex: whether --latex shows it.
    """

    def register(build: Build) -> Build:
        SECTIONS[build.__name__] = Registered(build, asks, in_terminal, in_latex)
        return build

    return register
