"""Rewrite the tables and the page of a folder whenever a run record in it is added or changes."""

import time
from collections.abc import Sequence
from pathlib import Path

from gsbench.errors import InputError, one_line
from gsbench.measure import record as files
from gsbench.report import output
from gsbench.report.frame import load

EVERY = 5.0  # seconds after which the folder is read again and an open page reloads itself


def watch(folder: Path, columns: Sequence[str] = (), *, every: float = EVERY) -> int:
    """Rewrite the files of `output.write` whenever run records arrive, until Ctrl-C; return 0.

    If the folder has no record or only damaged ones, the reason is printed, and the function keeps waiting. The page
    reloads itself in the browser until the function ends.

    Args:
        folder: the folder where records are or will be.
        columns: the columns of the result table; empty for those that the runs have.
        every: seconds between two checks of the folder.
    """
    before, printed = frozenset[tuple[Path, int]](), ""
    try:
        while True:
            state = _state(folder)
            if state != before or not printed:
                before, line = state, _write(folder, columns, reload=max(1, round(every)))
                if line != printed:
                    printed = line
                    print(f"{time.strftime('%H:%M:%S')} {line}", flush=True)
            time.sleep(every)
    except KeyboardInterrupt:
        print(f"\nStopped. {_write(folder, columns, reload=0)}")
        return 0


def _state(folder: Path) -> frozenset[tuple[Path, int]]:
    """Return the paths of all run records with their times; a record that is just being replaced is skipped."""
    state = set()
    for path in files.find(folder) if folder.is_dir() else []:
        try:
            state.add((path, path.stat().st_mtime_ns))
        except FileNotFoundError:
            continue
    return frozenset(state)


def _write(folder: Path, columns: Sequence[str], reload: int) -> str:
    """Write the files, and return a line that counts the run records; on failure return the reason."""
    try:
        results = load(folder)
        if results.runs.empty:
            return f"no record can be read: {results.faults[0]}"
        *_, page = output.write(results, folder, output.tables(results, columns), reload=reload)
    except (InputError, OSError) as error:
        return one_line(error)
    counts = {"records": len(results.runs), "not ok": int((results.runs.status != "ok").sum()),
              "left out": len(results.faults)}  # fmt: skip
    return f"{', '.join(f'{n} {what}' for what, n in counts.items() if n)}: {page}"
