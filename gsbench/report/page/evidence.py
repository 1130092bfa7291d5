"""Write the parts of the HTML report that document the runs: result tables, protocol, failed runs and commands."""

from gsbench.measure.record import Record
from gsbench.report import layout, tables
from gsbench.report.conditions import commit, conditions
from gsbench.report.configurations import Group, iterations
from gsbench.report.page import messages
from gsbench.report.page.content import Column, DataTable, PageSection, Value

LONGEST_NOTE = 700


def paper_tables(group: Group) -> list[layout.Table]:
    """Return the result tables of the runs with the most common settings, and with the rows of the 7DGS paper."""
    return tables.build(_compared(group), machine=group.machine)


def _compared(group: Group) -> list[Record]:
    """Return the runs with the settings that most models share; return all runs if none has these settings."""
    return [r for r in group.records if r.variant == group.variant] or group.records


def protocol_section(group: Group) -> PageSection:
    """Make the section with notes on protocol, data, machine, commit, versions and seeds, and with a table of all runs.

    Warnings come first.
    """
    columns = [Column("run"), Column("status"), Column("PSNR dB", 2), Column("training s", 1), Column("CPU s", 1)]
    columns += [Column("load", 1), Column("ms a frame", 2), Column("MB", 2), Column("iterations"), Column("machine")]
    columns += [Column("commit"), Column("command")]
    rows: list[list[Value]] = [
        [
            messages.run_name(r),
            r.status,
            *(group.value(r, q) for q in ("psnr", "seconds", "cpu_s", "load", "ms", "mb")),
            iterations(r),
            r.provenance.machine,
            commit(r),
            messages.command([r]) or "not in its record",
        ]
        for r in group.records
    ]
    compared = _compared(group)
    notes = [messages.shorten(note, LONGEST_NOTE) for note in conditions(compared)]
    if group.elsewhere:
        others = f"{messages.count(group.elsewhere, 'run')} on other machines are left out everywhere"
        machine = messages.shorten(group.machine, 200)
        notes.insert(0, f"Times are of one machine: {machine}. Seconds, ms and FPS of {others}.")
    ended = messages.count(len(group.finished), "run")
    lost = len(group.records) - len(group.finished)
    every = f"All {ended} finished." if len(group.finished) > 1 else "The run finished."
    said = [f"{ended} finished, {messages.count(lost, 'run')} did not (below)." if lost else every]
    if len(compared) < len(group.records):
        said.append(f"The lines below describe the {messages.count(len(compared), 'run')} in the tables above.")
    return PageSection(
        "protocol", "Protocol, machine, seeds", said, table=DataTable("runs.csv", columns, rows), notes=notes
    )


def failures(group: Group) -> DataTable | None:
    """Return a table of the runs that did not finish and why; None if all runs finished."""
    lost = [r for r in group.records if r.status != "ok"]
    columns = [Column("run"), Column("status"), Column("reason")]
    rows: list[list[Value]] = [[messages.run_name(r), r.status, messages.shorten(r.reason, 2000)] for r in lost]
    return DataTable("not_finished.csv", columns, rows) if lost else None
