"""``python -m gsbench.stability``: audit hard cases, write the page; exit with 1 where a default breaks its bound."""

import argparse
import os
import sys
from pathlib import Path


def main(arguments: list[str] | None = None) -> int:
    """Run the audit; see `--help`."""
    parser = argparse.ArgumentParser(prog="python -m gsbench.stability", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("results/stability"), help="folder of the results")
    options = parser.parse_args(arguments)
    os.environ.setdefault("MPLBACKEND", "Agg")
    from gsbench.stability import audit, page  # imports torch

    found = audit.run()
    page.write(found, options.out)
    print(page.table(found))
    print(page.verdict(found))
    print(f"Written: {options.out / 'page.md'}, table.md, table.csv, audit.json")
    return 1 if found.broken else 0


if __name__ == "__main__":
    sys.exit(main())
