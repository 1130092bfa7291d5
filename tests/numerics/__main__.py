"""Run the audit of numerical stability (`make stability`): compute hard inputs with every model and backend.

The exit code is 1 if the error of a default setting exceeds its bound.
"""

import argparse
import os
import sys
from pathlib import Path

from gsbench.errors import one_line
from gsbench.process.ending import end_with


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="make stability", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("results/stability"), help="folder of the results")
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--short", action="store_true", help="the defaults alone, in a minute; writes no page")
    length.add_argument("--long", action="store_true", help="train for 2,000 steps at 30 times the learning rates")
    options = parser.parse_args(arguments)
    os.environ.setdefault("MPLBACKEND", "Agg")
    if not options.short:
        try:
            options.out.mkdir(parents=True, exist_ok=True)  # before the minutes of the audit
        except OSError as error:
            print(f"make stability: error: --out: {one_line(error)}", file=sys.stderr)
            return 2
    from numerics import audit, page  # imports torch

    results = audit.run(long=options.long, short=options.short)
    if options.short:
        for cell in results.broken:
            print(f"{cell.case}, {cell.subject}, {cell.backend}: {page.show(cell)}; {cell.note}")
        print(page.verdict(results))
    else:
        page.write(results, options.out)
        print(page.table(results))
        print(page.verdict(results))
        print(f"Written: {options.out / 'page.md'}, table.md, table.csv, audit.json")
    return 1 if results.broken else 0


if __name__ == "__main__":
    end_with("make stability", main)
