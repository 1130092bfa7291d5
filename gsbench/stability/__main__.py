"""Run the numerical stability audit (`python -m gsbench.stability`), or measure how exact a model's images are.

The audit computes numerically hard inputs with every model and backend. The exit code is 1 if the error of a default
setting exceeds its bound. With a run folder or a PLY, the images of this model in float32 are compared with float64.
"""

import argparse
import importlib.util
import os
import sys
from pathlib import Path

from gsbench.errors import InputError, one_line
from gsbench.extras import how_to_install
from gsbench.process.ending import end_with

EXTRA = ("matplotlib", "mpmath")  # the packages of the extra stability


def main(arguments: list[str] | None = None) -> int:
    """Run the tests of numerical errors, or measure a trained model.

    Return the exit code: 0, or 1 if a default setting exceeds its error bound, or 2 if a package is missing or the
    model cannot be read.
    """
    parser = argparse.ArgumentParser(prog="python -m gsbench.stability", description=__doc__)
    parser.add_argument("model", nargs="?", type=Path, metavar="RUN_FOLDER|FILE.ply",
                        help="no audit: the error of float32 in this model's images")  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print the errors of RUN_FOLDER|FILE.ply as JSON")
    parser.add_argument("--data-root", metavar="FOLDER", help="of the run's data set, where it has moved")
    parser.add_argument("--model-module", metavar="MODULE", help="that registers the run's model")
    parser.add_argument("--out", type=Path, default=Path("results/stability"), help="folder of the results")
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--short", action="store_true", help="the defaults alone, in a minute; writes no page")
    length.add_argument("--long", action="store_true", help="train for 2,000 steps at 30 times the learning rates")
    parser.add_argument("--checkpoint", type=Path, metavar="FILE",
                        help="no audit: the condition numbers in a trained model")  # fmt: skip
    options = parser.parse_args(arguments)
    missing = [name for name in EXTRA if importlib.util.find_spec(name) is None]
    if missing:
        print(
            f"gsbench.stability: error: expected {' and '.join(missing)}: {how_to_install('stability')}",
            file=sys.stderr,
        )
        return 2
    os.environ.setdefault("MPLBACKEND", "Agg")
    if options.checkpoint:
        return show_spectrum(options.checkpoint, options.out)
    if options.model:
        return show_exactness(options)
    if not options.short:
        try:
            options.out.mkdir(parents=True, exist_ok=True)  # before the minutes of the audit
        except OSError as error:
            print(f"gsbench.stability: error: --out: {one_line(error)}", file=sys.stderr)
            return 2
    from gsbench.stability import audit, page  # imports torch

    found = audit.run(long=options.long, short=options.short)
    if options.short:
        for cell in found.broken:
            print(f"{cell.case}, {cell.subject}, {cell.backend}: {page.show(cell)}; {cell.note}")
        print(page.verdict(found))
        return 1 if found.broken else 0
    page.write(found, options.out)
    print(page.table(found))
    print(page.verdict(found))
    print(f"Written: {options.out / 'page.md'}, table.md, table.csv, audit.json")
    return 1 if found.broken else 0


def show_spectrum(checkpoint: Path, folder: Path) -> int:
    """Print and plot the condition numbers of the Gaussians in a checkpoint.

    Return the exit code: 0, or 2 if the file is not a checkpoint.
    """
    from gsbench.stability import spectrum

    try:
        found, failures = spectrum.measure(checkpoint), spectrum.failures(checkpoint)
        picture = spectrum.draw(found, folder, "/".join(checkpoint.parts[-4:-1]))
    except (InputError, OSError) as error:
        print(f"gsbench.stability: error: {one_line(error)}", file=sys.stderr)
        return 2
    print(spectrum.report(found))
    for scheme, (share, worst) in failures.items():
        print(f"{scheme} in float32: {100 * share:.2f} % indefinite, 99th percentile of the error {worst:.1e}")
    print(f"Written: {picture}")
    return 0


def show_exactness(options: argparse.Namespace) -> int:
    """Print and draw how exact the images of a run's model or of a PLY are.

    Return the exit code: 0, or 2 if the model cannot be read.
    """
    from gsbench.models.registry import import_models
    from gsbench.stability import frame, frame_report, subjects

    try:
        import_models(options.model_module)
        subject = subjects.load(options.model, options.out, options.data_root)
        found = frame.measure(subject.model, subject.shots, subject.background, subject.title, subject.antialias)
        if not options.json:
            frame_report.draw(found, subject.picture)
    except (InputError, OSError) as error:
        print(f"gsbench.stability: error: {one_line(error)}", file=sys.stderr)
        return 2
    if options.json:
        print(frame_report.json_of(found))
        return 0
    if subject.note:
        print(f"{subject.note}\n")
    print(frame_report.text(found))
    print(f"Written: {subject.picture}")
    return 0


if __name__ == "__main__":
    end_with("gsbench.stability", main)
