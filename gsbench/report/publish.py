"""Copy the records of finished runs to the folder of published records, and rewrite the tables there."""

import sys
from pathlib import Path

from gsbench.errors import InputError
from gsbench.measure import record as files
from gsbench.measure.atomic import write_atomically
from gsbench.report import tables


def publish(folder: Path, to: Path) -> str:
    """Copy every run record of a folder, such as ``results/mini``, to another one, such as ``results/published/mini``.

    A record of the same run in the second folder is replaced, and all others stay. The tables of the second folder are
    rewritten. The function returns a line that describes the result.

    Raises:
        InputError: a record is damaged or a duplicate, a run did not finish, or its code was not a clean git commit;
            nothing is copied.
    """
    records, faults = tables.load(folder)
    for r in records:
        if r.status != "ok":
            faults.append(f"{r.path}: {r.status}: {r.reason}")
        elif r.provenance.git_commit is None or r.provenance.git_commit.endswith("-dirty"):
            faults.append(f"{r.path}: its commit is {r.provenance.git_commit}, which does not reproduce it")
    if faults:
        more = f"; and {len(faults) - 3} more" if len(faults) > 3 else ""
        raise InputError(
            f"{folder}: expected finished runs of clean commits, got {'; '.join(faults[:3])}{more}", docs="report.md"
        )
    for path in files.find(folder):
        write_atomically(to / path.relative_to(folder), path.read_bytes())
    published, left_out = tables.load(to)
    for fault in left_out:
        print(f"gsbench.report: left out: {fault}", file=sys.stderr)
    tables.write(published, to, tables.build(published))
    return (
        f"Published: {len(records)} records in {to}, which has {len(published)}; {to / 'table.md'}, {to / 'table.csv'}"
    )
