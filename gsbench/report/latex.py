r"""Format result tables as LaTeX for a paper, with the package booktabs.

The document needs ``\usepackage{booktabs}``.
"""

import re
from collections.abc import Iterator

from gsbench.errors import printable
from gsbench.report.layout import EMPTY, QuantityColumn, Row, Section, Table
from gsbench.report.ranks import BEST, RULE, SECOND, ranks

ARROWS = {"higher": r" $\uparrow$", "lower": r" $\downarrow$", "": ""}
SPREAD = "±: half the width of the 95 % interval over seeds."
_SPECIAL = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    "±": r"$\pm$",
    "×": r"$\times$",
    "−": "$-$",
    EMPTY: "--",
    **{c: f"\\{c}" for c in "&%$#_{}"},
}


def latex(tables: list[Table]) -> str:
    r"""Format result tables as LaTeX, one ``table*`` for each.

    The best and second best values are marked by the rule of `gsbench.report.ranks`, and the paper's own rows are in
    italics. The conditions of the measurement stand above each table as comments.
    """
    return "\n".join(line for i, table in enumerate(tables, 1) for line in _lines(table, i))


def _lines(table: Table, number: int) -> Iterator[str]:
    for note in (*table.footnotes, *(note for section in table.sections for note in section.notes)):
        yield f"% {printable(note)}"
    ranked = any(row.values for section in table.sections for row in section.rows)
    caption = " ".join([f"{_capital(table.title)}.", SPREAD, *([RULE] if ranked else [])])
    yield r"\begin{table*}"
    yield r"\centering\small"
    yield rf"\caption{{{escape(caption)}}}"
    yield rf"\label{{tab:gsbench-{number}}}"
    yield rf"\begin{{tabular}}{{l{'r' * (len(table.columns) + 1)}}}"
    yield r"\toprule"
    yield _row(["model", *(escape(c.title) + ARROWS[c.better] for c in table.columns), "seeds"])
    for section in table.sections:
        yield r"\midrule"
        yield rf"\multicolumn{{{len(table.columns) + 2}}}{{l}}{{{escape(section.title)}}} \\"
        yield from _rows(section, table.columns)
    yield r"\bottomrule"
    yield r"\end{tabular}"
    for i, mark in enumerate(table.marks, 1):
        yield rf"\par\footnotesize\raggedright $^{{({i})}}$ {escape(mark)}"
    yield r"\end{table*}"
    yield ""


def _rows(section: Section, columns: list[QuantityColumn]) -> Iterator[str]:
    """Yield the rows of a section; rows that have no numbers of single runs keep the star of the best PSNR as bold."""
    places = {column.key: ranks(section.rows, column) for column in columns}
    for i, row in enumerate(section.rows):
        cells = [_cell(row, column, places[column.key][i]) for column in columns]
        if row.best and not row.values:
            cells[0] = rf"\textbf{{{cells[0]}}}"
        yield _row([_italic(row, _text(row.label)), *cells, row.seeds])


def _cell(row: Row, column: QuantityColumn, place: int) -> str:
    """Format a cell; only the mean is bold or underlined, not its interval."""
    mean, sign, rest = row.cells.get(column.key, "").partition(" ± ")
    text = _text(mean)
    if place == BEST:
        text = rf"\textbf{{{text}}}"
    elif place == SECOND:
        text = rf"\underline{{{text}}}"
    return _italic(row, text) + (rf" {{\scriptsize $\pm$ {_text(rest)}}}" if sign else "")


def _italic(row: Row, text: str) -> str:
    return rf"\textit{{{text}}}" if row.paper and text else text


def _text(text: str) -> str:
    """Escape a text, and raise the number of a footnote, such as " (1)", above the line."""
    return re.sub(r" (\(\d+\))", r"$^{\1}$", escape(text))


def _row(cells: list[str]) -> str:
    return f"{' & '.join(cells)} \\\\"


def escape(text: str) -> str:
    """Escape the special characters of LaTeX, so that the text is shown unchanged and runs no command."""
    return "".join(_SPECIAL.get(c, c) for c in printable(text))


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
