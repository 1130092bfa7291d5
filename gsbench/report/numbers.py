"""Give the result tables of a report as numbers for JSON, with the facts of every run beside them."""

from typing import Any

from gsbench.measure.record import Record
from gsbench.report.layout import Row, Section, Table
from gsbench.report.ranks import RULE, mean, ranks
from gsbench.report.tables import quantities


def numbers(records: list[Record], tables: list[Table], faults: list[str]) -> dict[str, Any]:
    """Return result tables as plain values.

    Args:
        records: the run records in the tables.
        tables: the tables of `gsbench.report.tables.build`.
        faults: the records that are left out, and why.

    Returns:
        A dict. "tables": for each row and column the mean, the ends of its 95 % interval over seeds (NaN if there is
        none), what each seed measured, and the rank (1: best, 2: second best, 0: other). "runs": for each run its seed,
        protocol, machine, commit and hashes.
    """
    return {
        "tables": [_table(table) for table in tables],
        "rule": RULE,
        "runs": [quantities(record) for record in records],
        "left_out": faults,
    }


def _table(table: Table) -> dict[str, Any]:
    return {
        "title": table.title,
        "columns": [{"name": c.name, "title": c.title, "better": c.better or None} for c in table.columns],
        "sections": [_section(section, table) for section in table.sections],
        "notes": [*table.marks, *table.footnotes],
    }


def _section(section: Section, table: Table) -> dict[str, Any]:
    names = {column.key: column.name for column in table.columns}
    rows = [_row(row, names) for row in section.rows]
    for column in table.columns:
        for row, place in zip(rows, ranks(section.rows, column), strict=True):
            if column.name in row["numbers"]:
                row["numbers"][column.name]["rank"] = place
    return {"title": section.title, "rows": rows, "notes": section.notes}


def _row(row: Row, names: dict[str, str]) -> dict[str, Any]:
    """Return the cells of a row as shown, and its numbers, by `names` of columns; only measured rows have numbers."""
    found = {names[key]: (mean(runs), runs) for key, runs in row.values.items()}
    shown = {names[key]: text for key, text in row.cells.items()}
    return {
        "label": row.label,
        "of_the_paper": row.paper,
        "shown": shown,
        "numbers": {
            name: {"mean": of.mean, "low": of.low, "high": of.high, "seeds": of.seeds, "by_scene_and_seed": runs}
            for name, (of, runs) in found.items()
        },
    }
