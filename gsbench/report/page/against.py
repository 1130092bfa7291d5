"""Write the section of the HTML report that compares the report's runs with runs of another folder."""

from gsbench.report import against_lines
from gsbench.report.against import AGREES, DIFFERS, RULE, UNTOLD, Comparison
from gsbench.report.against_table import COLUMNS, lines
from gsbench.report.configurations import Group
from gsbench.report.page import messages
from gsbench.report.page.content import Column, DataTable, PageSection, Value


def against_section(comparison: Comparison, group: Group) -> PageSection:
    """Make the section that shows the runs of two folders side by side, for each model, scene and seed.

    The section also has the differences of the means and the verdicts. It covers one experiment on one data set.
    """
    own = [row for row in comparison.rows if (row.experiment, row.dataset) == (group.experiment, group.dataset)]
    columns = [Column("scene"), Column("run"), *(Column(c.title) for c in COLUMNS)]
    rows: list[list[Value]] = [
        [row.scene, line.label, *(line.cells[c.key] for c in COLUMNS)] for row in own for line in lines(row)
    ]
    said = [f"{'. '.join(against_lines.compared(comparison))}."]
    ours, theirs = (messages.shorten(name, 80) for name in (comparison.ours, comparison.theirs))
    if own:
        counts = [f"{v} in {sum(r.judged['psnr'].verdict == v for r in own)}" for v in (AGREES, DIFFERS, UNTOLD)]
        said.append(f"PSNR {', '.join(counts)} of {messages.count(len(own), 'row')} here. Cells are {ours} / {theirs}.")
    return PageSection(
        "against",
        f"Against {theirs}",
        said,
        table=DataTable("against.csv", columns, rows) if own else None,
        notes=[RULE],
    )
