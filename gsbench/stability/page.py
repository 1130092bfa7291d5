"""Write the results of the stability audit as tables, JSON, plots, and a Markdown page that shows them all."""

import csv
import io
import json
import os
from dataclasses import asdict
from pathlib import Path
from typing import Any

from gsbench.measure.atomic import write_atomically
from gsbench.measure.machine import processor_name
from gsbench.measure.provenance import git_commit, versions
from gsbench.stability import plots
from gsbench.stability.audit import Audit
from gsbench.stability.cases import AREAS, CASES, Cell

COLUMNS = ("area", "case", "subject", "scheme", "backend", "forward", "gradient", "bad", "ms", "holds", "note")
MARK = "**over** "
RUNS = ("training", "drift")  # areas in which each test case is a training


def write(audit: Audit, folder: Path) -> None:
    """Write the tables, the JSON, the plots and the Markdown page of a stability audit to `folder`."""
    tables = table(audit)
    write_atomically(folder / "table.md", tables.encode())
    write_atomically(folder / "table.csv", csv_of(audit.cells).encode())
    write_atomically(folder / "audit.json", json.dumps(_plain(audit), indent=1).encode())
    figures = plots.write(audit, folder)
    write_atomically(folder / "page.md", page(audit, tables, figures).encode())


def page(audit: Audit, tables: str, figures: list[plots.Plot]) -> str:
    """Return the report of the stability audit as Markdown."""
    lines = ["# Stability audit", "", verdict(audit), "", *conditions(audit), ""]
    for figure in figures:
        lines += [f"## {figure.title}", "", f"![{figure.title}]({figure.file})", "", figure.caption, ""]
    return "\n".join([*lines, tables, *stresses()])


def verdict(audit: Audit) -> str:
    """Return a sentence that says which error bounds the default settings exceed, if any."""
    if audit.broken:
        names = ", ".join(sorted({f"{cell.case} ({cell.subject}, {cell.backend})" for cell in audit.broken}))
        return f"**{len(audit.broken)} cells of the defaults are over their bound:** {names}."
    defaults = sum(cell.is_default for cell in audit.cells)
    return f"The defaults keep their bounds in all {defaults} cells."


def conditions(audit: Audit) -> list[str]:
    """Return lines that name the machine, the software versions and the meaning of a table cell."""
    checks = ", ".join(f"{value:.0e} ({order})" for order, value in audit.verified.items())
    return [
        f"{processor_name()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} at the end; commit {git_commit()}; "
        f"{', '.join(f'{k} {v}' for k, v in versions().items())}; backends here: {', '.join(audit.backends)}; "
        f"{audit.seconds:.0f} s.",
        "",
        "A cell reads: error of the result / error of its gradient / share not finite or indefinite / milliseconds of "
        "one thread, forward and backward. It is the worst Gaussian of a case, and the 99.9th percentile of the hard "
        "slices. "
        f"{MARK.strip()} marks a cell over its bound; a default is the scheme `square_root`. `cholesky` has a kernel "
        "for 6D and 7D on the CPU, to be compared with; `schur` runs in torch.",
        f"The hard slices' float64 reference differs from mpmath by at most: {checks}.",
    ]


def table(audit: Audit) -> str:
    """Return Markdown tables of all errors (one table per area and model), of the trainings, and of the times."""
    lines = []
    for area in ("population", *(area for area in AREAS if area not in RUNS)):
        for subject in dict.fromkeys(cell.subject for cell in audit.cells if cell.area == area):
            cells = [cell for cell in audit.cells if (cell.area, cell.subject) == (area, subject)]
            lines += [f"## {area}{'' if subject == '-' else f', {subject}'}", "", *_grid(cells), ""]
    return "\n".join([*lines, *runs(audit), *costs(audit)])


def runs(audit: Audit) -> list[str]:
    """Return the Markdown table of the trainings: whether each one ended as expected, and its result."""
    lines = ["## training", "", "| case | model | backend | result | not finite | s | what came out |",
             "| --- | --- | --- | --- | ---: | ---: | --- |"]  # fmt: skip
    for cell in (cell for cell in audit.cells if cell.area in RUNS):
        result = f"{cell.forward:.4f} dB" if cell.area == "drift" else "as it should" if cell.forward == 0 else "failed"
        lines.append(f"| {cell.case} | {cell.subject} | {cell.backend} | {'' if cell.holds else MARK}{result} | "
                     f"{100 * cell.bad:.3g} % | {cell.ms / 1e3:.1f} | {cell.note} |")  # fmt: skip
    return [*lines, ""]


def _grid(cells: list[Cell]) -> list[str]:
    columns = list(dict.fromkeys((cell.scheme, cell.backend) for cell in cells))
    names = [" ".join(part for part in column if part != "-") for column in columns]
    found = {(cell.case, cell.scheme, cell.backend): cell for cell in cells}
    rows = []
    for case in dict.fromkeys(cell.case for cell in cells):
        bound = next(cell.bound for cell in cells if cell.case == case)
        texts = [show(found[case, *column]) if (case, *column) in found else "" for column in columns]
        rows.append(f"| {case} | {_number(bound.forward)} / {_number(bound.gradient)} | {' | '.join(texts)} |")
    return [f"| case | bound | {' | '.join(names)} |", "| --- |" + " ---: |" * (len(columns) + 1), *rows]


def show(cell: Cell) -> str:
    """Format one table cell: the errors of result and gradient, the share of invalid results, and milliseconds."""
    numbers = f"{_number(cell.forward)} / {_number(cell.gradient)} / {100 * cell.bad:.3g} % / {cell.ms:.3g}"
    return ("" if cell.holds else MARK) + numbers


def _number(x: float) -> str:
    return "–" if x != x else "0" if x == 0 else f"{x:.0e}"


def costs(audit: Audit) -> list[str]:
    """Return the Markdown table of the times of the algorithms for conditional Gaussians.

    It compares the default `square_root` with `schur` and `cholesky`, which subtract covariances.
    """
    lines = [
        "## what safety costs", "",
        "Milliseconds of slicing 100,000 7D Gaussians, medians of nine (torch: one). The kernel of `cholesky` does",
        "what one of `schur` would have to, solving where that inverts; `schur` runs in torch, as published code does.",
        "The last column is forward and backward as multiples of `cholesky` in the same order on the same backend.", "",
        "| factor order | scheme | backend | forward | backward | multiples |",
        "| --- | --- | --- | ---: | ---: | ---: |",
    ]  # fmt: skip
    beside = {(cost.order, cost.backend): cost for cost in audit.safety if cost.scheme == "cholesky"}
    for cost in audit.safety:
        other = beside.get((cost.order, cost.backend))
        ratio = f"{cost.forward / other.forward:.2f} / {cost.backward / other.backward:.2f}" if other else "–"
        lines.append(f"| {cost.order} | {cost.scheme} | {cost.backend} | {cost.forward:.1f} | {cost.backward:.1f} | "
                     f"{ratio} |")  # fmt: skip
    return [*lines, ""]


def stresses() -> list[str]:
    """Return the Markdown table that says why each test case is numerically hard."""
    lines = ["## the cases", "", "| case | what it stresses, and where it was met |", "| --- | --- |"]
    return [*lines, *(f"| {case.name} | {case.stresses} |" for case in CASES.values()), ""]


def csv_of(cells: list[Cell]) -> str:
    """Return all results of the stability audit as CSV, one line per test case, model, algorithm and backend."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for cell in cells:
        writer.writerow([getattr(cell, name) for name in COLUMNS])
    return text.getvalue()


def _plain(audit: Audit) -> dict[str, Any]:
    return asdict(audit) | {"processor": processor_name(), "git_commit": git_commit(), "versions": versions()}
