"""Add the finished runs of a folder to a published study, which is three tables (gsbench.report.study)."""

from pathlib import Path

from gsbench.errors import InputError
from gsbench.measure.atomic import write_atomically
from gsbench.report import frame, output, study
from gsbench.report.render import text


def publish(folder: Path, to: Path) -> str:
    """Write the runs of a folder, such as ``results/mini``, into a study, such as ``results/published/mini``.

    A run that the study has is replaced, and all others stay. Its result table, ``table.md``, is written anew. The
    function returns a line that describes the result.

    Raises:
        InputError: a record of either is damaged or a duplicate, a run did not finish, or its code was not a clean git
            commit; nothing is written.
    """
    results = frame.load(folder)
    earlier = frame.load(to) if (to / study.RUNS_FILE).exists() else None
    faults = [*results.faults, *(earlier.faults if earlier else ())]
    for record in results.runs.record:
        if record.status != "ok":
            faults.append(f"{record.path}: {record.status}: {record.reason}")
        elif (record.provenance.git_commit or "-dirty").endswith("-dirty"):
            faults.append(f"{record.path}: its commit is {record.provenance.git_commit}, which does not reproduce it")
    if faults:
        more = f"; and {len(faults) - 3} more" if len(faults) > 3 else ""
        raise InputError(
            f"{folder}: expected finished runs of clean commits, got {'; '.join(faults[:3])}{more}", docs="report.md"
        )
    runs = {frame.name(record): record for part in (earlier, results) if part for record in part.runs.record}
    records = [runs[name] for name in sorted(runs)]
    study.write(records, to)
    write_atomically(to / "table.md", text.markdown(output.tables(frame.load(to))).encode())
    return f"Published: {len(results.runs)} runs in {to}, which has {len(records)}; {to / study.RUNS_FILE}"
