"""Make Tables 1 and 2 of the 7DGS paper from run records, and write them as Markdown and CSV (``make tables``)."""

from pathlib import Path

import pandas as pd

from gsbench.measure.atomic import write_atomically
from gsbench.measure.record import Record
from gsbench.report import layout, table1, table2
from gsbench.report.cells import cell
from gsbench.report.layout import Table
from gsbench.report.paper_protocol import sort

NAMES = ("table1.md", "table1.csv", "table2.md", "table2.csv")


def write(records: list[Record], folder: Path) -> list[Table]:
    """Write Tables 1 and 2 of the 7DGS paper as Markdown and CSV files to `folder`, and return the tables."""
    found = sort(records)
    shown = []
    for name, (tables, lines) in (("table1", table1.build(found)), ("table2", table2.build(found))):
        write_atomically(folder / f"{name}.md", layout.markdown(tables).encode())
        frame = pd.DataFrame([{key: cell(value) for key, value in line.items()} for line in lines])
        write_atomically(folder / f"{name}.csv", frame.to_csv(index=False).encode())
        shown += tables
    return shown
