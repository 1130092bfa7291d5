"""Print the table of a folder of records and write it there, with a page (``python -m gsbench.report RESULTS_DIR``)."""

import argparse
import sys
from pathlib import Path

from gsbench.errors import InputError, one_line
from gsbench.report import layout, live, paper_tables, tables
from gsbench.report.page import build


def main(arguments: list[str] | None = None) -> int:
    """Print and write the tables and ``report.html``; return 1 if a record is left out, 2 if there is none.

    A record that is damaged, or that of a run which has another record, is left out and named with the reason.
    """
    parser = argparse.ArgumentParser(prog="python -m gsbench.report", description=__doc__)
    parser.add_argument("results", type=Path, metavar="RESULTS_DIR", help="a folder with records, at any depth")
    parser.add_argument("--train", action="store_true", help="also PSNR on training views: the gap is overfitting")
    either = parser.add_mutually_exclusive_group()
    either.add_argument("--tables", action="store_true", help="only Tables 1 and 2 of the paper: table1.* and table2.*")
    either.add_argument("--live", action="store_true", help="write again whenever a record arrives, until Ctrl-C")
    asked = parser.parse_args(arguments)
    folder = asked.results
    if asked.live:
        return live.watch(folder, train=asked.train)
    try:
        records, faults = tables.load(folder)
        if records and asked.tables:
            print(layout.terminal(paper_tables.write(records, folder)))
            print(f"Written: {', '.join(str(folder / name) for name in paper_tables.NAMES)}")
        elif records:
            print(layout.terminal(tables.write(records, folder, train=asked.train)))
            page = build.write(records, folder, faults)
            print(f"Written: {folder / 'table.md'}, {folder / 'table.csv'}, {page}")
    except (InputError, OSError) as error:
        print(f"gsbench.report: {one_line(error)}", file=sys.stderr)
        return 2
    for fault in faults:
        print(f"gsbench.report: left out: {fault}", file=sys.stderr)
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
