"""Print the table of the records in a folder, and write it there (``python -m gsbench.report RESULTS_DIR``)."""

import argparse
import sys
from pathlib import Path

from gsbench.errors import InputError
from gsbench.report import layout, tables


def main(arguments: list[str] | None = None) -> int:
    """Print the tables, write ``table.md`` and ``table.csv``; return 2 if there is no record."""
    parser = argparse.ArgumentParser(prog="python -m gsbench.report", description=__doc__)
    parser.add_argument("results", type=Path, metavar="RESULTS_DIR", help="a folder with records, at any depth")
    parser.add_argument("--train", action="store_true", help="also PSNR on training views: the gap is overfitting")
    asked = parser.parse_args(arguments)
    folder = asked.results
    try:
        print(layout.terminal(tables.write(tables.load(folder), folder, train=asked.train)))
    except InputError as error:
        print(f"gsbench.report: {error}", file=sys.stderr)
        return 2
    print(f"Written: {folder / 'table.md'}, {folder / 'table.csv'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
