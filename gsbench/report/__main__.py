"""Print the result tables of a folder of runs, and write them and a page there: ``python -m gsbench.report FOLDER``."""

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from gsbench.errors import InputError, one_line, printable
from gsbench.measure.atomic import write_atomically
from gsbench.process.ending import end_with
from gsbench.reading import as_json
from gsbench.report import merge, output, paper_tables, reproduction, select
from gsbench.report.frame import Results, load
from gsbench.report.render import page, text
from gsbench.report.sections import built
from gsbench.report.sections.experiment import WITH_TRAIN

PRINTED = Path("-")  # the value of --json without a FILE


def main(arguments: list[str] | None = None) -> int:
    """Print and write the result tables and ``report.html`` for a folder of runs.

    A record is left out, and the reason is printed, if it is damaged or if another record describes the same run.
    With the options --latex, --select, or --json without a FILE, nothing is written into the folder.

    Returns:
        1 if a record is left out or if the option --against finds that PSNR differs, 2 if there is no record or a file
        cannot be read or written, otherwise 0.
    """
    options = _options(arguments)
    columns = list(WITH_TRAIN) if options.train else []
    if options.live:
        return output.watch(options.results, columns)
    differs = False
    try:
        selection = select.parse(options.select)
        if options.train and "column" in selection:
            raise InputError("--train: expected no column= beside it: add psnr_train_db to those of --select")
        results = select.selected(merge.read(options.merge) if options.merge else load(options.results), selection)
        if options.publish:
            print(output.publish(options.results, options.publish))
        elif len(results.runs) and options.tables:
            _paper_tables(results, options)
        elif len(results.runs) and options.against:
            differs = _against(results, options)
        elif len(results.runs):
            _report(results, selection.get("column", columns), options)
        if len(results.runs) and options.figures:
            paths = page.figures(results, options.figures)
            print(f"Written: {len(paths) // 2} figures in {options.figures}", file=sys.stderr)
    except BrokenPipeError:  # the program that reads the output has ended, such as `head`: end_with is silent
        raise
    except (InputError, OSError) as error:
        print(f"gsbench.report: {one_line(error)}", file=sys.stderr)
        return 2
    _print_faults(results)
    return 1 if results.faults or differs else 0


def _options(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m gsbench.report", description=__doc__)
    parser.add_argument("results", type=Path, metavar="FOLDER", help="a folder with runs, at any depth")
    parser.add_argument("--train", action="store_true", help="also PSNR on training views: the gap is overfitting")
    either = parser.add_mutually_exclusive_group()
    either.add_argument("--tables", action="store_true", help="only table1.*, table2.* and table_successors.*")
    either.add_argument("--live", action="store_true", help="write again whenever a record arrives, until Ctrl-C")
    either.add_argument("--publish", type=Path, metavar="DIR", help="copy the runs to DIR, and write its table anew")
    either.add_argument("--against", type=Path, metavar="DIR", help="compare with the runs in DIR; 1 if they differ")
    either.add_argument(
        "--merge", type=Path, nargs="+", metavar="DIR", help="one set of several people's runs: a static site in FOLDER"
    )
    form = parser.add_mutually_exclusive_group()
    form.add_argument("--latex", action="store_true", help="print the tables as LaTeX for a paper, and write nothing")
    form.add_argument(
        "--json",
        type=Path,
        nargs="?",
        const=PRINTED,
        metavar="FILE",
        help="print the numbers as JSON, and write nothing; FILE: also write them there",
    )
    parser.add_argument("--figures", type=Path, metavar="DIR", help="write the page's figures there as PDF and SVG")
    parser.add_argument(
        "--select",
        nargs="+",
        default=[],
        metavar="KEY=A,B",
        help="only these: model=.. scene=.. column=..; nothing is written to FOLDER",
    )
    options = parser.parse_args(arguments)
    if options.against and options.latex:
        parser.error("--against: expected no --latex beside it")
    if (options.live or options.publish) and (options.latex or options.json or options.figures or options.select):
        parser.error("--live, --publish: expected none of --latex, --json, --figures and --select beside them")
    if options.train and (options.tables or options.publish or options.against):
        parser.error("--train: expected none of --tables, --publish and --against beside it")
    if options.select and (options.tables or options.against):
        parser.error("--select: expected none of --tables and --against beside it")
    return options


def _report(results: Results, columns: Sequence[str], options: argparse.Namespace) -> None:
    """Print the result tables, and write them with the page unless only a part or another form was asked for."""
    shown = output.shown_sections(results, columns, latex=options.latex)
    if options.latex:
        print(text.latex(shown))
    elif not _answered_in_json(options, lambda: _content(results)):
        print(text.terminal(shown))
        if not options.select:
            print(f"Written: {', '.join(map(str, output.write(results, options.results, shown)))}")


def _content(results: Results) -> dict[str, object]:
    """Return all sections, the facts of every run, and why records were left out, as plain values for JSON.

    Numbers are not rounded; `as_json` writes those that are missing as null.
    """
    skipped = ("gallery", "runs")  # images, and a table that `runs` below replaces
    sections = [
        {"key": s.key, "title": s.title, "text": s.text, "notes": s.notes, "rows": s.table.to_dict("records")}
        for chapter in results.chapters()
        for s in built(chapter)
        if s.key not in skipped
    ]
    runs = results.runs.drop(columns=["path", "record"]).to_dict("records")
    return {"sections": sections, "runs": runs, "left_out": list(results.faults)}


def _paper_tables(results: Results, options: argparse.Namespace) -> None:
    """Print the tables of papers, and write them unless another form was asked for."""
    shown = [section for table in paper_tables.sections(results).values() for section in table]
    if options.latex:
        print(text.latex(shown))
    elif not _answered_in_json(
        options, lambda: {name: table.to_dict("records") for name, table in paper_tables.numbers(results).items()}
    ):
        paper_tables.write(results, options.results)
        print(text.terminal(shown))
        print(f"Written: {', '.join(str(options.results / name) for name in paper_tables.FILES)}")


def _against(results: Results, options: argparse.Namespace) -> bool:
    """Print and write the comparison with another folder, and return whether PSNR differs."""
    reference = load(options.against)
    _print_faults(reference)
    same = {path.resolve() for path in results.runs.path} & {path.resolve() for path in reference.runs.path}
    if same:
        raise InputError(
            f"--against {printable(options.against)}: expected other runs than those of {printable(options.results)}, "
            f"both have {printable(min(same))}, and a run agrees with itself: name another folder"
        )
    compared = reproduction.compare(results, reference)
    if not _answered_in_json(options, lambda: reproduction.content(compared, results, reference)):
        sections, shown = reproduction.sections(compared, str(options.against)), output.shown_sections(results)
        paths = output.write(results, options.results, shown, more=sections)
        print(text.terminal([*shown, *sections]))
        print(f"Report: {printable(paths[-1])}")  # the page
    return compared.verdict == reproduction.DIFFERS


def _answered_in_json(options: argparse.Namespace, content: Callable[[], object]) -> bool:
    """Write JSON to the FILE of --json, or print it, and return whether that is all that was asked for."""
    if options.json == PRINTED:
        print(as_json(content()))
    elif options.json:
        write_atomically(options.json, f"{as_json(content())}\n".encode())
    return bool(options.json == PRINTED)


def _print_faults(results: Results) -> None:
    for fault in results.faults:
        print(f"gsbench.report: left out: {fault}", file=sys.stderr)


if __name__ == "__main__":
    end_with("gsbench.report", main)
