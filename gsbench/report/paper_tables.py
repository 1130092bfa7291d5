"""Write Tables 1 and 2 of the 7DGS paper from records, as Markdown and CSV (``make tables``)."""

from pathlib import Path
from typing import Any

import pandas as pd

from gsbench.measure.atomic import write_atomically
from gsbench.measure.record import Record
from gsbench.report import layout, table1, table2
from gsbench.report.conditions import printable
from gsbench.report.layout import Table
from gsbench.report.paper_protocol import sort

NAMES = ("table1.md", "table1.csv", "table2.md", "table2.csv")
_FORMULA = "=+-@"  # a spreadsheet computes a cell that begins with one of these


def write(records: list[Record], folder: Path) -> list[Table]:
    """Write NAMES to `folder` atomically and return the tables that are in them."""
    found = sort(records)
    shown = []
    for name, (tables, lines) in (("table1", table1.build(found)), ("table2", table2.build(found))):
        write_atomically(folder / f"{name}.md", layout.markdown(tables).encode())
        frame = pd.DataFrame([{key: _text(value) for key, value in line.items()} for line in lines])
        write_atomically(folder / f"{name}.csv", frame.to_csv(index=False).encode())
        shown += tables
    return shown


def _text(value: Any) -> Any:
    """Keep a text from a record on one line, and from being computed by a spreadsheet; leave numbers."""
    if not isinstance(value, str):
        return value
    text = printable(value)
    return f"'{text}" if text[:1] and text[0] in _FORMULA else text
