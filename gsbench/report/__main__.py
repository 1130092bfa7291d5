"""Print the result table of a folder of run records, and save it there (``python -m gsbench.report RESULTS_DIR``)."""

import argparse
import sys
from pathlib import Path

from gsbench.errors import InputError, one_line
from gsbench.measure.record import Record
from gsbench.report import against_table, layout, live, paper_tables, tables
from gsbench.report.against import DIFFERS, Comparison, compare
from gsbench.report.page import build
from gsbench.report.publish import publish


def main(arguments: list[str] | None = None) -> int:
    """Print and write the result tables and ``report.html`` for a folder of run records.

    A record is left out, and the reason is printed, if it is damaged or if another record describes the same run.

    Returns:
        1 if a record is left out or if the option --against finds that PSNR differs, 2 if there is no record or a file
        cannot be read or written, otherwise 0.
    """
    parser = argparse.ArgumentParser(prog="python -m gsbench.report", description=__doc__)
    parser.add_argument("results", type=Path, metavar="RESULTS_DIR", help="a folder with records, at any depth")
    parser.add_argument("--train", action="store_true", help="also PSNR on training views: the gap is overfitting")
    either = parser.add_mutually_exclusive_group()
    either.add_argument("--tables", action="store_true", help="only table1.*, table2.* and table_successors.*")
    either.add_argument("--live", action="store_true", help="write again whenever a record arrives, until Ctrl-C")
    either.add_argument("--publish", type=Path, metavar="DIR", help="copy the records to DIR, and write its table anew")
    parser.add_argument("--against", type=Path, metavar="DIR", help="compare with the records in DIR; 1 if they differ")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the comparison to FILE")
    options = parser.parse_args(arguments)
    folder = options.results
    if options.json and not options.against:
        parser.error("--json: expected --against beside it")
    if options.against and (options.live or options.tables or options.publish):
        parser.error("--against: expected none of --live, --tables and --publish beside it")
    if options.live:
        return live.watch(folder, train=options.train)
    differs = False
    try:
        records, faults = tables.load(folder)
        if options.publish:
            print(publish(folder, options.publish))
        elif records and options.tables:
            print(layout.terminal(paper_tables.write(records, folder)))
            print(f"Written: {', '.join(str(folder / name) for name in paper_tables.NAMES)}")
        elif records:
            print(layout.terminal(tables.write(records, folder, train=options.train)))
            compared = _compared(records, folder, options.against) if options.against else None
            page = build.write(records, folder, faults, against=compared)
            print(f"Written: {folder / 'table.md'}, {folder / 'table.csv'}, {page}")
            if compared:
                differs = compared.verdict == DIFFERS
                if options.json:
                    against_table.write_json(compared, options.json)
                print(f"\n{layout.terminal(against_table.tables(compared))}\n{compared.line}")
    except (InputError, OSError) as error:
        print(f"gsbench.report: {one_line(error)}", file=sys.stderr)
        return 2
    for fault in faults:
        print(f"gsbench.report: left out: {fault}", file=sys.stderr)
    return 1 if faults or differs else 0


def _compared(records: list[Record], folder: Path, other: Path) -> Comparison:
    """Compare the records of two folders, and print which records of the second folder cannot be read."""
    theirs, faults = tables.load(other)
    for fault in faults:
        print(f"gsbench.report: left out: {fault}", file=sys.stderr)
    return compare(records, theirs, (str(folder), str(other)))


if __name__ == "__main__":
    sys.exit(main())
