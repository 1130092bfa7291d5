"""Write what a report leaves in a folder of results: the result tables, the numbers of all runs, and the page."""

from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from gsbench.measure.atomic import write_atomically
from gsbench.report.frame import Results
from gsbench.report.render import page, text
from gsbench.report.section import Section
from gsbench.report.sections.experiment import table
from gsbench.report.sections.protocol import protocol

NOT_IN_FILE = ["config", "missing", "path", "record"]  # columns of `runs` that are no values


def tables(results: Results, columns: Sequence[str] = ()) -> list[Section]:
    """Return the result table and the protocol of each experiment.

    Args:
        results: the tables of the runs.
        columns: the columns of the result table; empty for those that the runs have.
    """
    chapters = results.chapters()
    return [of for chapter in chapters for of in (table(chapter, columns), protocol(chapter, pd.DataFrame())) if of]


def write(
    results: Results, folder: Path, shown: Sequence[Section], *, reload: int = 0, more: Sequence[Section] = ()
) -> list[Path]:
    """Write ``table.md``, ``table.csv`` and ``report.html`` to a folder, and return their paths.

    Args:
        results: the tables of the runs.
        folder: the folder of the files.
        shown: the sections of ``table.md``: `tables`.
        reload: seconds after which an open page reloads itself; 0 for never.
        more: sections of the page that are not of one experiment.
    """
    write_atomically(folder / "table.md", text.markdown(shown).encode())
    write_atomically(folder / "table.csv", text.csv(results.runs.drop(columns=NOT_IN_FILE)).encode())
    return [folder / "table.md", folder / "table.csv", page.write(results, folder, reload=reload, more=more)]
