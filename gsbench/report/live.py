"""Rewrite the result tables and the HTML report of a folder whenever a run record in it is added or changes."""

import time
from pathlib import Path

from gsbench.errors import InputError, one_line
from gsbench.measure import record as files
from gsbench.report import tables
from gsbench.report.page import build

EVERY = 5.0  # seconds after which the folder is read again and an open report reloads itself

State = frozenset[tuple[Path, int]]


def watch(folder: Path, *, train: bool = False, every: float = EVERY) -> int:
    """Rewrite ``table.md``, ``table.csv`` and ``report.html`` whenever run records arrive, until Ctrl-C; return 0.

    If the folder has no record or only damaged ones, the reason is printed, and the function keeps waiting. The report
    reloads itself in the browser until the function ends.

    Args:
        folder: the folder where records are or will be.
        train: whether to show PSNR on training views too.
        every: seconds between two checks of the folder.
    """
    seen, said = State(), ""
    try:
        while True:
            state = _state(folder)
            if state != seen or not said:
                seen, text = state, _written(folder, train, reload=max(1, round(every)))
                if text != said:
                    said = text
                    print(f"{time.strftime('%H:%M:%S')} {said}", flush=True)
            time.sleep(every)
    except KeyboardInterrupt:
        print(f"\nStopped. {_written(folder, train, reload=0)}")
        return 0


def _state(folder: Path) -> State:
    """Return the paths of all run records with their modification times.

    A record is skipped if it disappears during the search, for example because it is being replaced.
    """
    found = set()
    for path in files.find(folder) if folder.is_dir() else []:
        try:
            found.add((path, path.stat().st_mtime_ns))
        except FileNotFoundError:
            continue
    return frozenset(found)


def _written(folder: Path, train: bool, reload: int) -> str:
    """Write the tables and the report, and return a line that counts the run records; on failure return the reason."""
    try:
        records, faults = tables.load(folder)
        if not records:
            return f"no record can be read: {faults[0]}"
        tables.write(records, folder, tables.build(records, train=train))
        page = build.write(records, folder, faults, reload=reload)
    except (InputError, OSError) as error:
        return one_line(error)
    lost = sum(r.status != "ok" for r in records)
    counts = [(len(records), "records"), (lost, "not ok"), (len(faults), "left out")]
    return f"{', '.join(f'{n} {what}' for n, what in counts if n)}: {page}"
