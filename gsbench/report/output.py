"""Write a report into its folder, once or whenever records arrive, and add runs to a published study."""

import time
from collections.abc import Sequence
from contextlib import suppress
from operator import attrgetter
from pathlib import Path

from gsbench.errors import InputError, one_line, printable
from gsbench.measure import record as files
from gsbench.measure.atomic import write_atomically
from gsbench.report import contributors, merge, study
from gsbench.report.frame import Results, load, run_name
from gsbench.report.render import page, site, text
from gsbench.report.section import Section
from gsbench.report.sections import built
from gsbench.report.sections.experiment import table

EVERY = 5  # seconds after which the folder is read again and an open page reloads itself
NOT_IN_FILE = ["config", "missing", "path", "record"]  # columns of `runs` that are no values


def shown_sections(results: Results, columns: Sequence[str] = (), *, latex: bool = False) -> list[Section]:
    """Return the sections that the terminal and ``table.md`` show, or those of --latex, for each experiment.

    Args:
        results: the tables of the runs.
        columns: the columns of the result table; empty for those that the runs have.
        latex: whether they are for --latex.
    """
    shown = [  # `built` cannot ask for columns, so its table of results is replaced
        table(chapter, columns) if section.key == "experiment" else section
        for chapter in results.chapters()
        for section in built(chapter, attrgetter("in_latex" if latex else "in_terminal"))
    ]
    return shown + (contributors.sections(results) if merge.is_merged(results) and not latex else [])


def write(
    results: Results, folder: Path, shown: Sequence[Section], *, reload: int = 0, more: Sequence[Section] = ()
) -> list[Path]:
    """Write ``table.md``, ``table.csv`` and ``report.html``, or the site of a merged set, and return their paths.

    Args:
        results: the tables of the runs.
        folder: the folder of the files.
        shown: the sections of ``table.md``: `shown_sections`.
        reload: seconds after which an open page reloads itself; 0 for never.
        more: sections of the page that are not of one experiment.
    """
    write_atomically(folder / "table.md", text.markdown(shown).encode())
    write_atomically(folder / "table.csv", text.csv(results.runs.drop(columns=NOT_IN_FILE)).encode())
    if merge.is_merged(results):
        shown_page = site.write(results, folder)[0]  # index.html
    else:
        shown_page = folder / "report.html"
        write_atomically(shown_page, page.page(folder.resolve().name, results, reload=reload, more=more).encode())
    return [folder / "table.md", folder / "table.csv", shown_page]


def watch(folder: Path, columns: Sequence[str] = ()) -> int:
    """Rewrite the files of `write` whenever run records arrive, until Ctrl-C; return 0.

    If the folder has no record or only damaged ones, the reason is printed, and the function keeps waiting. The page
    reloads itself in the browser until the function ends.

    Args:
        folder: the folder where records are or will be.
        columns: the columns of the result table; empty for those that the runs have.
    """
    before, printed = frozenset[tuple[Path, int]](), ""
    try:
        while True:
            state = _state(folder)
            if state != before or not printed:
                before, line = state, _rewrite(folder, columns, reload=EVERY)
                if line != printed:
                    printed = line
                    print(f"{time.strftime('%H:%M:%S')} {line}", flush=True)
            time.sleep(EVERY)
    except KeyboardInterrupt:
        print(f"\nStopped. {_rewrite(folder, columns, reload=0)}")
        return 0


def _state(folder: Path) -> frozenset[tuple[Path, int]]:
    """Return the paths of all run records with their times; a record that is just being replaced is skipped."""
    state = set()
    for path in files.find(folder) if folder.is_dir() else []:
        with suppress(FileNotFoundError):
            state.add((path, path.stat().st_mtime_ns))
    return frozenset(state)


def _rewrite(folder: Path, columns: Sequence[str], reload: int) -> str:
    """Write the files, and return a line that counts the run records; on failure return the reason."""
    try:
        results = load(folder)
        if results.runs.empty:
            return f"no record can be read: {results.faults[0]}"
        written = write(results, folder, shown_sections(results, columns), reload=reload)
    except (InputError, OSError) as error:
        return one_line(error)
    counts = {
        "records": len(results.runs),
        "not ok": int((results.runs.status != "ok").sum()),
        "left out": len(results.faults),
    }
    return f"{', '.join(f'{n} {what}' for what, n in counts.items() if n)}: {written[-1]}"


def publish(folder: Path, to: Path) -> str:
    """Write the runs of a folder, such as ``results/mini``, into a study, such as ``results/published/mini``.

    A run that the study has is replaced, and all others stay. Its result table, ``table.md``, is written anew. The
    function returns a line that describes the result.

    Raises:
        InputError: a record of either is damaged or a duplicate, a run did not finish, its code was not a clean git
            commit, or `folder` would have each run twice; nothing is written.
    """
    results = load(folder)
    inner, outer = to.resolve(), folder.resolve()
    if inner.is_relative_to(outer) and files.PUBLISHED not in inner.relative_to(outer).parts:
        raise InputError(
            f"--publish {printable(to)}: expected a folder outside of {printable(folder)}, whose report would have "
            f"each run twice: name another, or one in {printable(folder / files.PUBLISHED)}, which reports pass by"
        )
    earlier = load(to) if (to / study.RUNS_FILE).exists() else None
    faults = [*results.faults, *(earlier.faults if earlier else ())]
    for record in results.runs.record:
        if reason := merge.unpublishable(record):
            faults.append(f"{record.path}: {reason}")
    if faults:
        more = f"; and {len(faults) - 3} more" if len(faults) > 3 else ""
        raise InputError(
            f"{folder}: expected finished runs of clean commits, got {'; '.join(faults[:3])}{more}", docs="report.md"
        )
    runs = {run_name(record): record for part in (earlier, results) if part for record in part.runs.record}
    records = [runs[key] for key in sorted(runs)]
    study.write(records, to)
    write_atomically(to / "table.md", text.markdown(shown_sections(load(to))).encode())
    return f"Published: {len(results.runs)} runs in {to}, which has {len(records)}; {to / study.RUNS_FILE}"
