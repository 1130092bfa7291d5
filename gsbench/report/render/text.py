"""Show sections in a terminal, as Markdown and as LaTeX, and tables as CSV: one function each."""

import re
import textwrap
from collections.abc import Iterator, Sequence
from typing import Any

import pandas as pd

from gsbench.errors import printable
from gsbench.report.section import EMPTY, Section

WIDEST = 44  # characters of a cell in a terminal
ARROWS = {"higher": r" $\uparrow$", "lower": r" $\downarrow$", "": ""}
STYLES = {0: "{}", 1: r"\textbf{{{}}}", 2: r"\underline{{{}}}"}
TEX = {
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


def terminal(sections: Sequence[Section], width: int = 120) -> str:
    """Return sections as plain text of at most `width` characters a line, with a star at the best numbers.

    The rows of a scene stand below its name. Columns that do not fit are left out, and a line names them.
    """
    return "\n".join(line for section in sections for line in _terminal(section, width))


def _terminal(section: Section, width: int) -> Iterator[str]:
    """Yield the lines of a section: title, table with the rows of each scene below its name, text and notes."""
    table = section.shown(lambda text, rank: f"{text}*" if rank == 1 else text).map(_narrow)
    has_scenes = "scene" in table.columns[:1]
    scenes = list(dict.fromkeys(table.scene)) if has_scenes else [""]
    names = list(table)[1:] if has_scenes else list(table)
    widths = {name: max(map(len, [name, *table[name]])) for name in names}
    fitting = [n for n in range(1, len(names) + 1) if sum(widths[name] + 2 for name in names[:n]) <= width]
    shown = names[: max(fitting, default=1)]
    numeric = dict(zip(table, map(section.is_number, section.shown_columns), strict=True))

    def line(cells: Sequence[str]) -> str:
        texts = zip(shown, cells, strict=True)
        padded = (text.rjust(widths[name]) if numeric[name] else text.ljust(widths[name]) for name, text in texts)
        return f"  {'  '.join(padded)}"[:width].rstrip()

    yield from (*_wrapped(section.title, width), "", *([line(shown)] if len(table) else []))
    for scene in scenes:
        rows = table[table.scene == scene] if has_scenes else table
        if scene:
            yield scene[:width]
        yield from map(line, rows[shown].to_numpy().tolist())
    words = [section.text.replace("Bold: ", "With *: "), *(f"- {note}" for note in section.notes)]
    left_out = names[len(shown) :] if len(table) else []
    words += [f"- left out for lack of width: {', '.join(left_out)}"] if left_out else []
    yield from (*([""] if len(table) else []), *(part for text in words for part in _wrapped(text, width)), "")


def _narrow(text: str) -> str:
    """Return the text of a cell; of a long one the beginning and the end, as names of variants begin alike."""
    half = WIDEST // 2 - 1
    return text if len(text) <= WIDEST else f"{text[:half]}..{text[-half:]}"


def _wrapped(text: str, width: int) -> list[str]:
    return textwrap.wrap(printable(text), width, subsequent_indent="  ", break_on_hyphens=False)


def markdown(sections: Sequence[Section]) -> str:
    """Return sections as Markdown with a heading each; the best numbers are bold."""
    parts = []
    for section in sections:
        notes = "\n".join(f"- {escaped(note)}" for note in section.notes)
        parts += [f"## {escaped(section.title)}", table(section), escaped(section.text), notes]
    return "\n\n".join(filter(None, parts)) + "\n"


def table(section: Section) -> str:
    """Return the table of a section as Markdown, as the blocks of README and docs have it."""
    shown = section.shown(bold)
    marks = ["---:" if section.is_number(name) else "---" for name in section.shown_columns]
    rows = [list(shown), marks, *shown.to_numpy().tolist()]
    return "\n".join(f"| {' | '.join(map(escaped, row))} |" for row in rows) if len(shown) else ""


def bold(text: str, rank: int) -> str:
    """Mark the best number of a column or row."""
    return f"**{text}**" if rank == 1 else text


def escaped(text: str) -> str:
    """Escape the characters of Markdown and HTML that would end a cell or change how a text is shown."""
    text = re.sub(r"&(?=[#\w])", "&amp;", printable(text)).replace("<", "&lt;")
    return re.sub(r"([\\|\[\]])", r"\\\1", text)


def latex(sections: Sequence[Section]) -> str:
    r"""Return sections as LaTeX for a paper, one ``table*`` each; the document needs ``\usepackage{booktabs}``.

    The best numbers are bold, the second best underlined. Notes stand above each table as comments.
    """
    return "\n".join(line for i, section in enumerate(sections, 1) for line in [*_latex(section, i), ""])


def _latex(section: Section, number: int) -> list[str]:
    """Return the lines of a section as a table of LaTeX with a number in its label; notes are comments above it."""
    names = section.shown_columns
    shown = section.shown()
    titles = [tex(section.column(name).title) + ARROWS[section.column(name).better] for name in names]
    ranks = list(zip(*(section.rank(name) for name in names), strict=True))
    underlined = " Underlined: the second best." if any(2 in row for row in ranks) else ""
    rows = [
        " & ".join(_cell(text, rank) for text, rank in zip(texts, places, strict=True))
        for texts, places in zip(shown.to_numpy().tolist(), ranks, strict=True)
    ]
    return [
        *(f"% {printable(note)}" for note in section.notes),
        r"\begin{table*}",
        r"\centering\small",
        rf"\caption{{{tex(f'{section.title}. {section.text}{underlined}')}}}",
        rf"\label{{tab:gsbench-{number}}}",
        rf"\begin{{tabular}}{{{''.join('r' if section.is_number(name) else 'l' for name in names)}}}",
        r"\toprule",
        f"{' & '.join(titles)} \\\\",
        r"\midrule",
        *(f"{row} \\\\" for row in rows),
        r"\bottomrule",
        r"\end{tabular}",
        r"\end{table*}",
    ]


def _cell(text: str, rank: int) -> str:
    """Return a cell; only the mean is bold or underlined, not its interval."""
    mean, sign, half = text.partition(" ± ")
    return STYLES[rank].format(tex(mean)) + (rf" {{\scriptsize $\pm$ {tex(half)}}}" if sign else "")


def tex(text: str) -> str:
    """Escape the special characters of LaTeX, so that a text is shown unchanged and runs no command."""
    return "".join(TEX.get(c, c) for c in printable(text))


def csv(frame: pd.DataFrame) -> str:
    """Return a table as CSV, the numbers not rounded.

    A text is on one line; if it begins like a formula, which a spreadsheet would compute, a ' is put before it.
    """
    return frame.map(_safe).rename(columns=_safe).to_csv(index=False)


def _safe(value: Any) -> Any:
    if value is None or isinstance(value, bool | int | float) or hasattr(value, "item"):  # item: a number of numpy
        return value
    line = printable(value)
    return f"'{line}" if line.startswith(("=", "+", "-", "@")) else line
