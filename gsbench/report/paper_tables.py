"""Make Tables 1 and 2 of the 7DGS paper and the table of its successors as Markdown and CSV (``make tables``)."""

from pathlib import Path

import pandas as pd

from gsbench.measure.atomic import write_atomically
from gsbench.measure.record import Record
from gsbench.report import layout, table1, table2, table_successors
from gsbench.report.cells import cell
from gsbench.report.layout import Table
from gsbench.report.paper_protocol import sort
from gsbench.report.table1 import Line

NAMES = (
    "table1.md", "table1.csv", "table2.md", "table2.csv", "table_successors.md", "table_successors.csv"
)  # fmt: skip


Built = dict[str, tuple[list[Table], list[Line]]]  # by name: the tables, and the lines of the CSV file


def build(records: list[Record]) -> Built:
    """Make the paper's tables and that of its successors."""
    found = sort(records)
    return {
        "table1": table1.build(found),
        "table2": table2.build(found),
        "table_successors": table_successors.build(records),
    }


def write(built: Built, folder: Path) -> None:
    """Write the paper's tables and that of its successors as Markdown and CSV to `folder`."""
    for name, (tables, lines) in built.items():
        write_atomically(folder / f"{name}.md", layout.markdown(tables).encode())
        frame = pd.DataFrame([{key: cell(value) for key, value in line.items()} for line in lines])
        write_atomically(folder / f"{name}.csv", frame.to_csv(index=False).encode())
