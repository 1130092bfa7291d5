"""Write what a report leaves in a folder of results: the result tables, the numbers of all runs, and the page."""

from collections.abc import Sequence
from operator import attrgetter
from pathlib import Path

from gsbench.measure.atomic import write_atomically
from gsbench.report.frame import Results
from gsbench.report.render import page, text
from gsbench.report.section import Section
from gsbench.report.sections import built
from gsbench.report.sections.experiment import table

NOT_IN_FILE = ["config", "missing", "path", "record"]  # columns of `runs` that are no values


def tables(results: Results, columns: Sequence[str] = (), *, latex: bool = False) -> list[Section]:
    """Return the sections that the terminal and ``table.md`` show, or those of --latex, for each experiment.

    Args:
        results: the tables of the runs.
        columns: the columns of the result table; empty for those that the runs have.
        latex: whether they are for --latex.
    """
    return [
        table(chapter, columns) if of.key == "experiment" else of
        for chapter in results.chapters()
        for of in built(chapter, attrgetter("in_latex" if latex else "in_terminal"))
    ]


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
