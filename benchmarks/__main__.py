"""Measure every row, print a table as it grows, and write results/benchmarks/<name>.json and .md."""

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TextIO

import torch

from benchmarks.against import Built, built
from benchmarks.roofline import UNITS, Limits, limits
from benchmarks.rows import SECTIONS
from benchmarks.timing import Row, measure
from gsbench import kernels
from gsbench.errors import InputError, one_line
from gsbench.measure.atomic import write_atomically
from gsbench.measure.machine import processor_name
from gsbench.measure.provenance import git_commit, versions
from gsbench.reading import as_json

HEADER = "| | median ms | p10 | p90 | wall ms | ns a pixel | target ms | least ms by the machine's limit | ratio |"


def main(arguments: Sequence[str] | None = None) -> int:
    """Return 0; 2 if the commit to compare with is unknown or cannot be built; 130 after Ctrl-C."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("sections", nargs="*", choices=[*SECTIONS, []], help="default: all")
    parser.add_argument("--out", type=Path, default=Path("results/benchmarks"), help="folder of the results")
    parser.add_argument("--name", default="cpu", help="of the two files")
    parser.add_argument("--against", metavar="COMMIT", help="build it too, time it in turns, and show the ratios to it")
    parser.add_argument("--json", action="store_true", help="print the numbers as JSON, and the table on stderr")
    options = parser.parse_args(arguments)
    table = sys.stderr if options.json else sys.stdout
    sections = options.sections or list(SECTIONS)
    try:
        if options.against is None:
            content = measure_all(sections, options.out, options.name, None, table)
        else:
            with built(options.against, options.out / "against.log") as other:
                content = measure_all(sections, options.out, options.name, other, table)
    except InputError as error:
        print(one_line(error), file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    if options.json:
        print(as_json(content))
    return 0


def measure_all(
    sections: Sequence[str], out: Path, name: str, other: Built | None, table: TextIO = sys.stdout
) -> dict[str, Any]:
    """Time the sections of this tree, each after that of the `other` commit, so that a slow minute hits both.

    The table is printed to `table` as it grows. What is written as JSON is returned.
    """
    torch.set_num_threads(1)
    bounds = limits()
    lines = []

    def tell(*more: str) -> None:
        lines.extend(more)
        print("\n".join(more), file=table, flush=True)

    tell("# What the kernels cost", "", *conditions(bounds), "")
    results: list[dict[str, Any]] = []
    their_sections = other.sections() if other else []
    for section in sections:
        tell(f"## {section}", "", SECTIONS[section].__doc__ or "", "")
        medians = other.medians(section) if other and section in their_sections else {}
        if other and section not in their_sections:
            tell(f"{other.short} has no section {section}: its column is empty.", "")
        header = HEADER + (f" x {other.short} |" if other else "")
        tell(header, "| --- |" + " ---: |" * (header.count("|") - 2))
        for row in SECTIONS[section]():
            result = run(row, bounds)
            if other:
                result["against_ms"] = medians.get((row.section, row.name))
            results.append(result)
            tell(line(result))
        tell("")
    machine = {
        "processor": processor_name(),
        "cores": os.cpu_count(),
        "load": os.getloadavg(),
        "instruction_set": kernels.native().active(),
        "versions": versions(),
        "git_commit": git_commit(),
        "against": other and other.commit,
        "limits": bounds._asdict(),
    }
    out.mkdir(parents=True, exist_ok=True)
    content = {"machine": machine, "rows": results}
    write_atomically(out / f"{name}.json", as_json(content).encode())
    write_atomically(out / f"{name}.md", "\n".join(lines).encode())
    return content


def conditions(bounds: Limits) -> list[str]:
    """Where and how: a measurement without its machine and load says little."""
    rates = ", ".join(f"{value:.2f} {UNITS[name]}" for name, value in bounds._asdict().items())
    return [
        f"{processor_name()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} at the start, instruction set "
        f"{kernels.native().active()}, commit {git_commit()}.",
        "",
        f"Limits of one thread, measured in the same run: {rates}. Process-CPU milliseconds of one thread unless said;",
        "the scene's recipe is benchmarks/scene.py. The limit is that of bytes read and written once, of flops or of",
        "blended alphas. Ratio: the median over the limit, below 1 for data in cache; `reference` is torch.",
    ]


def run(row: Row, bounds: Limits) -> dict[str, Any]:
    torch.set_num_threads(row.threads)
    cost = measure(row.call)
    torch.set_num_threads(1)
    least = row.floor and row.floor[1] / getattr(bounds, row.floor[0]) / 1e6
    return {
        "section": row.section,
        "name": row.name,
        "threads": row.threads,
        "target_ms": row.target_ms,
        "pixels": row.pixels,
        "least_ms": least,
        "limit": row.floor and row.floor[0],
        **cost._asdict(),
    }


def line(result: dict[str, Any]) -> str:
    target, least = result["target_ms"], result["least_ms"]
    met = "" if target is None else f"{target:g} {'met' if result['median'] <= target else 'missed'}"
    limit = "" if least is None else f"{least:.2f} ({result['limit']})"
    ratio = "" if least is None else f"{result['median'] / least:.1f}"
    numbers = " | ".join(f"{result[key]:.2f}" for key in ("median", "p10", "p90", "wall"))
    each = "" if result["pixels"] is None else f"{1e6 * result['median'] / result['pixels']:.1f}"
    cells = [result["name"], numbers, each, met, limit, ratio]
    if "against_ms" in result:  # medians of this tree over those of another commit
        against = result["against_ms"]
        cells.append("" if against is None else f"{result['median'] / against:.2f}")
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    sys.exit(main())
