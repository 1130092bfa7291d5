"""Print the result table of a folder of run records, and save it there (``python -m gsbench.report RESULTS_DIR``)."""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

from gsbench.as_json import as_json
from gsbench.errors import InputError, one_line
from gsbench.measure.atomic import write_atomically
from gsbench.measure.record import Record
from gsbench.process.ending import end_with
from gsbench.report import frame, layout, live, paper_tables, reproduction, select, tables
from gsbench.report.frame import Results
from gsbench.report.latex import latex
from gsbench.report.numbers import numbers
from gsbench.report.page import build
from gsbench.report.publish import publish
from gsbench.report.render import page, text

PRINTED = Path("-")  # the value of --json without a FILE


def main(arguments: list[str] | None = None) -> int:
    """Print and write the result tables and ``report.html`` for a folder of run records.

    A record is left out, and the reason is printed, if it is damaged or if another record describes the same run.
    With the options --latex, --select, or --json without a FILE, nothing is written into the folder.

    Returns:
        1 if a record is left out or if the option --against finds that PSNR differs, 2 if there is no record or a file
        cannot be read or written, otherwise 0.
    """
    options = _options(arguments)
    if options.live:
        return live.watch(options.results, train=options.train)
    differs = False
    try:
        chosen = select.parse(options.select)
        results = frame.load(options.results)
        records, faults = chosen.of(list(results.runs.record)), list(results.faults)
        if options.publish:
            print(publish(options.results, options.publish))
        elif records and options.tables:
            _paper_tables(records, options)
        elif records and options.against:
            differs = _against(results, options)
        elif records:
            _tables(records, faults, chosen.columns, options)
        if records and options.figures:
            written = build.write_figures(records, options.results, options.figures)
            print(f"Written: {len(written) // 2} figures in {options.figures}", file=sys.stderr)
    except (InputError, OSError) as error:
        print(f"gsbench.report: {one_line(error)}", file=sys.stderr)
        return 2
    for fault in faults:
        print(f"gsbench.report: left out: {fault}", file=sys.stderr)
    return 1 if faults or differs else 0


def _options(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m gsbench.report", description=__doc__)
    parser.add_argument("results", type=Path, metavar="RESULTS_DIR", help="a folder with records, at any depth")
    parser.add_argument("--train", action="store_true", help="also PSNR on training views: the gap is overfitting")
    either = parser.add_mutually_exclusive_group()
    either.add_argument("--tables", action="store_true", help="only table1.*, table2.* and table_successors.*")
    either.add_argument("--live", action="store_true", help="write again whenever a record arrives, until Ctrl-C")
    either.add_argument("--publish", type=Path, metavar="DIR", help="copy the records to DIR, and write its table anew")
    either.add_argument("--against", type=Path, metavar="DIR", help="compare with the records in DIR; 1 if they differ")
    form = parser.add_mutually_exclusive_group()
    form.add_argument("--latex", action="store_true", help="print the tables as LaTeX for a paper, and write nothing")
    form.add_argument("--json", type=Path, nargs="?", const=PRINTED, metavar="FILE",
                      help="print the numbers as JSON, and write nothing; FILE: also write them there")  # fmt: skip
    parser.add_argument("--figures", type=Path, metavar="FOLDER", help="write the page's figures there as PDF and SVG")
    parser.add_argument("--select", nargs="+", default=[], metavar="KEY=A,B",
                        help="only these: model=.. scene=.. column=..; nothing is written to RESULTS_DIR")  # fmt: skip
    options = parser.parse_args(arguments)
    if options.against and options.latex:
        parser.error("--against: expected no --latex beside it")
    if (options.live or options.publish) and (options.latex or options.json or options.figures or options.select):
        parser.error("--live, --publish: expected none of --latex, --json, --figures and --select beside them")
    if options.select and (options.tables or options.against):
        parser.error("--select: expected none of --tables and --against beside it")
    return options


def _tables(records: list[Record], faults: list[str], columns: list[str], options: argparse.Namespace) -> None:
    """Print the result tables, and write them with the HTML report unless only a part or another form was asked for."""
    built = tables.build(records, train=options.train, columns=columns)
    if _is_printed(options, built, lambda: numbers(records, built, faults)):
        return
    print(layout.terminal(built))
    if not options.select:
        tables.write(records, options.results, built)
        page = build.write(records, options.results, faults)
        print(f"Written: {options.results / 'table.md'}, {options.results / 'table.csv'}, {page}")


def _paper_tables(records: list[Record], options: argparse.Namespace) -> None:
    """Print the tables of papers, and write them unless another form was asked for."""
    built = paper_tables.build(records)
    shown = [table for made, _ in built.values() for table in made]
    if _is_printed(options, shown, lambda: {name: lines for name, (_, lines) in built.items()}):
        return
    paper_tables.write(built, options.results)
    print(layout.terminal(shown))
    print(f"Written: {', '.join(str(options.results / name) for name in paper_tables.NAMES)}")


def _against(results: Results, options: argparse.Namespace) -> bool:
    """Print and write the comparison with another folder, and return whether PSNR differs."""
    other = frame.load(options.against)
    for fault in other.faults:
        print(f"gsbench.report: left out: {fault}", file=sys.stderr)
    compared = reproduction.compare(results, other, (str(options.results), str(options.against)))
    made = [reproduction.section(compared)]
    if not _is_printed(options, [], lambda: reproduction.content(compared, results.runs, other.runs)):
        records = list(results.runs.record)
        built = tables.build(records, train=options.train)
        print(layout.terminal(built))
        tables.write(records, options.results, built)
        written = page.write(results, options.results, more=made)
        print(f"Written: {options.results / 'table.md'}, {options.results / 'table.csv'}, {written}")
        print(f"\n{text.terminal(made)}")
        print("\n".join(reproduction.lines(compared, results.runs, written)))
    return compared.verdict == reproduction.DIFFERS


def _is_printed(options: argparse.Namespace, built: list[layout.Table], content: Callable[[], object]) -> bool:
    """Print tables as LaTeX or JSON if that was asked for, and return whether it was; write JSON to a given FILE."""
    if options.latex:
        print(latex(built))
    elif options.json == PRINTED:
        print(as_json(content()))
    elif options.json:
        write_atomically(options.json, f"{as_json(content())}\n".encode())
    return bool(options.latex or options.json == PRINTED)


if __name__ == "__main__":
    end_with("gsbench.report", main)
