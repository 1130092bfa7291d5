"""Format result tables as Markdown for files and as plain text for a terminal."""

import math
import re
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import chain

EMPTY = "–"
Values = Mapping[str, Mapping[str, Mapping[int, float]]]  # by QuantityColumn.key, scene and seed; NaN: not measured


@dataclass(frozen=True)
class QuantityColumn:
    """A column of a result table: the quantity, its title and its number of digits."""

    key: str
    title: str
    digits: int | None  # decimals; None: two below ten, otherwise one
    paper: str = ""  # the field of PaperRow with the same quantity
    better: str = ""  # "higher" or "lower"; empty if models are not ranked by the quantity

    @property
    def name(self) -> str:
        """Return the key without a remark such as "(leaks)"."""
        return self.key.partition(" ")[0]

    def show(self, mean: float, std: float = math.nan) -> str:
        """Format a number as ``mean``, as ``mean ± std`` if a spread is given, or as a dash if the mean is NaN."""
        if math.isnan(mean):
            return EMPTY
        digits = self.digits if self.digits is not None else 1 if mean >= 10 else 2
        return f"{mean:.{digits}f}" + ("" if math.isnan(std) else f" ± {std:.{digits}f}")


@dataclass(frozen=True)
class Row:
    """A row of a result table: a model's mean over seeds, a run that did not finish, or the 7DGS paper's numbers."""

    label: str
    cells: dict[str, str]  # by QuantityColumn.key
    seeds: str = ""  # number of seeds
    best: bool = False  # whether its first column (PSNR) has the best measured value
    values: Values = field(default_factory=dict)  # of a measured row: the numbers behind its cells
    paper: bool = False  # whether the numbers are the paper's own


@dataclass(frozen=True)
class Section:
    """The rows of a result table for one scene, or for the average over scenes."""

    title: str
    rows: list[Row]
    notes: list[str] = field(default_factory=list)  # why a row is not ok or left out; the pixels of regions


@dataclass(frozen=True)
class Table:
    """The result table of one experiment on one data set."""

    title: str
    columns: list[QuantityColumn]
    sections: list[Section]
    marks: list[str]  # the meaning of (1), (2), ... in the cells
    footnotes: list[str]  # the conditions under which the numbers hold


def markdown(tables: list[Table]) -> str:
    """Format result tables as Markdown.

    Every scene has a heading and a table, in which the best PSNR is bold. The footnotes come last.
    """
    lines: list[str] = []
    for table in tables:
        lines += [f"# {_escape(table.title)}", ""]
        titles = _titles(table)
        for section in table.sections:
            lines += [f"## {_escape(section.title)}", ""]
            if section.rows:
                lines += [_line(list(map(_escape, titles))), _line(["---", *["---:"] * (len(titles) - 1)])]
            for row in section.rows:
                label, first, *rest = map(_escape, _texts(row, table.columns))
                lines.append(_line([label, f"**{first}**" if row.best else first, *rest]))
            lines += ["", *(f"- {_escape(note)}" for note in section.notes), *([""] if section.notes else [])]
        lines += [f"({i}) {_escape(mark)}  " for i, mark in enumerate(table.marks, 1)]
        lines += ["", *(f"- {_escape(note)}" for note in table.footnotes), ""]
    return "\n".join(lines)


def terminal(tables: list[Table], width: int = 120) -> str:
    """Format result tables as plain text of at most `width` characters per line, with a star at the best PSNR.

    Columns that do not fit are left out, and a footnote names them.
    """
    lines: list[str] = []
    for table in tables:
        texts = [[_texts(row, table.columns, star="*") for row in section.rows] for section in table.sections]
        titles = _titles(table)
        widths = [max(map(len, column)) for column in zip(titles, *chain.from_iterable(texts), strict=True)]
        fitting = [n for n in range(2, len(widths) + 1) if sum(widths[:n]) + 2 * n <= width]
        widths = widths[: max(fitting, default=1)]
        lines += [*_wrapped(table.title, width), "", _aligned(titles, widths)[:width]]
        for section, rows in zip(table.sections, texts, strict=True):
            lines += _wrapped(section.title, width)
            lines += [_aligned(row, widths)[:width] for row in rows]
            for note in section.notes:
                lines += _wrapped(f"  - {note}", width)
        lines.append("")
        for i, mark in enumerate(table.marks, 1):
            lines += _wrapped(f"({i}) {mark}", width)
        for note in table.footnotes:
            lines += _wrapped(f"- {note}", width)
        if len(widths) < len(titles):
            lines += _wrapped(f"- columns left out, for lack of width: {', '.join(titles[len(widths) :])}", width)
        lines.append("")
    return "\n".join(lines)


def _aligned(texts: list[str], widths: list[int]) -> str:
    """Join texts into a line of columns with the given widths: the first is left-aligned, the others are right-aligned.

    Texts for which there is no width are left out.
    """
    first, *rest = texts[: len(widths)]
    return "  ".join(["  " + first.ljust(widths[0]), *map(str.rjust, rest, widths[1:])]).rstrip()


def _titles(table: Table) -> list[str]:
    return ["model", *(c.title for c in table.columns), "seeds"]


def _texts(row: Row, columns: list[QuantityColumn], star: str = "") -> list[str]:
    """Return the texts of a table row from left to right, with `star` behind the PSNR if it is the best."""
    first, *rest = (row.cells.get(c.key, "") for c in columns)
    return [row.label, first + star * row.best, *rest, row.seeds]


def _line(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _wrapped(text: str, width: int) -> list[str]:
    return textwrap.wrap(text, width, subsequent_indent="    ", break_on_hyphens=False)


def _escape(text: str) -> str:
    """Escape the special characters of Markdown and HTML, so that the text is shown unchanged."""
    return re.sub(r"([\\`*|\[\]])", r"\\\1", re.sub(r"&(?=[#\w])", "&amp;", text).replace("<", "&lt;"))
