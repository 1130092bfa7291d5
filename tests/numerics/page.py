"""Write the results of the audit as tables, JSON and a plot, and as a Markdown page that shows them all."""

import io
import json
import os
from dataclasses import asdict
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

from gsbench.measure.atomic import write_atomically
from gsbench.measure.machine import processor_name
from gsbench.measure.provenance import git_commit, versions
from numerics.audit import Audit
from numerics.cases import AREAS, Cell, of_area

COLUMNS = ("area", "case", "subject", "scheme", "backend", "forward", "gradient", "bad", "ms", "holds", "note")
MARK = "**over** "
RUNS = ("training", "drift")  # areas in which each case is a training
COLORS = {"square_root": "tab:blue", "schur": "tab:red", "cholesky": "tab:orange"}
LEAST, MOST = 1e-16, 1e3  # the range of plotted errors; values outside are plotted at the edge


def write(audit: Audit, folder: Path) -> None:
    """Write the tables, the JSON, the plot and the Markdown page to a folder."""
    rows = [[getattr(cell, name) for name in COLUMNS] for cell in audit.cells]
    provenance = {"processor": processor_name(), "git_commit": git_commit(), "versions": versions()}
    write_atomically(folder / "table.md", table(audit).encode())
    write_atomically(folder / "table.csv", pd.DataFrame(rows, columns=COLUMNS).to_csv(index=False).encode())
    write_atomically(folder / "audit.json", json.dumps(asdict(audit) | provenance, indent=1).encode())
    write_atomically(folder / "condition.png", plot(audit))
    write_atomically(folder / "page.md", page(audit).encode())


def page(audit: Audit) -> str:
    """Return the report of the audit as Markdown."""
    lines = ["# Stability audit", "", verdict(audit), "", *conditions(audit), ""]
    lines += [
        "## Error against condition number",
        "",
        "![the error against the condition number](condition.png)",
        "",
        "Relative error of the sliced covariance: 7DGS in float32 by torch, the factor in the paper's order, random "
        "factors whose diagonals go down to 10^-8. Solid: median, dashed: 99th percentile, both on the left axis. "
        "Dotted, on the right axis: share of covariances that are indefinite or not finite.",
        "",
    ]
    cases = ["## the cases", "", "| case | what it stresses, and where it was met |", "| --- | --- |"]
    cases += [f"| {case.name} | {case.stresses} |" for area in AREAS for case in of_area(area)]
    return "\n".join([*lines, table(audit), *cases, ""])


def verdict(audit: Audit) -> str:
    """Return a sentence that says which error bounds the default settings exceed, if any."""
    if audit.broken:
        names = ", ".join(sorted({f"{cell.case} ({cell.subject}, {cell.backend})" for cell in audit.broken}))
        return f"**{len(audit.broken)} cells of the defaults are over their bound:** {names}."
    return f"The defaults keep their bounds in all {sum(cell.is_default for cell in audit.cells)} cells."


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


# ---- tables


def table(audit: Audit) -> str:
    """Return Markdown tables of all errors (one for each area and model), of the trainings, and of the times."""
    lines = []
    for area in ("population", *(area for area in AREAS if area not in RUNS)):
        for subject in dict.fromkeys(cell.subject for cell in audit.cells if cell.area == area):
            cells = [cell for cell in audit.cells if (cell.area, cell.subject) == (area, subject)]
            lines += [f"## {area}{'' if subject == '-' else f', {subject}'}", "", *_grid(cells), ""]
    return "\n".join([*lines, *_runs(audit), *_costs(audit)])


def _grid(cells: list[Cell]) -> list[str]:
    columns = list(dict.fromkeys((cell.scheme, cell.backend) for cell in cells))
    names = [" ".join(part for part in column if part != "-") for column in columns]
    by_place = {(cell.case, cell.scheme, cell.backend): cell for cell in cells}
    rows = []
    for case, bound in {cell.case: cell.bound for cell in cells}.items():
        texts = [show(by_place[case, *column]) if (case, *column) in by_place else "" for column in columns]
        rows.append(f"| {case} | {_number(bound.forward)} / {_number(bound.gradient)} | {' | '.join(texts)} |")
    return [f"| case | bound | {' | '.join(names)} |", "| --- |" + " ---: |" * (len(columns) + 1), *rows]


def show(cell: Cell) -> str:
    """Format one cell: the errors of result and gradient, the share of invalid results, and milliseconds."""
    numbers = f"{_number(cell.forward)} / {_number(cell.gradient)} / {100 * cell.bad:.3g} % / {cell.ms:.3g}"
    return ("" if cell.holds else MARK) + numbers


def _number(x: float) -> str:
    return "–" if x != x else "0" if x == 0 else f"{x:.0e}"


def _runs(audit: Audit) -> list[str]:
    lines = [
        "## training",
        "",
        "| case | model | backend | result | not finite | s | what came out |",
        "| --- | --- | --- | --- | ---: | ---: | --- |",
    ]
    for cell in (cell for cell in audit.cells if cell.area in RUNS):
        result = f"{cell.forward:.4f} dB" if cell.area == "drift" else "as it should" if cell.forward == 0 else "failed"
        lines.append(
            f"| {cell.case} | {cell.subject} | {cell.backend} | {'' if cell.holds else MARK}{result} | "
            f"{100 * cell.bad:.3g} % | {cell.ms / 1e3:.1f} | {cell.note} |"
        )
    return [*lines, ""]


def _costs(audit: Audit) -> list[str]:
    lines = [
        "## what safety costs",
        "",
        "Milliseconds of slicing 100,000 7D Gaussians, medians of nine (torch: one). The kernel of `cholesky` does",
        "what one of `schur` would have to, solving where that inverts; `schur` runs in torch, as published code does.",
        "The last column is forward and backward as multiples of `cholesky` in the same order on the same backend.",
        "",
        "| factor order | scheme | backend | forward | backward | multiples |",
        "| --- | --- | --- | ---: | ---: | ---: |",
    ]
    beside = {(cost.order, cost.backend): cost for cost in audit.safety if cost.scheme == "cholesky"}
    for cost in audit.safety:
        other = beside.get((cost.order, cost.backend))
        ratio = f"{cost.forward / other.forward:.2f} / {cost.backward / other.backward:.2f}" if other else "–"
        lines.append(
            f"| {cost.order} | {cost.scheme} | {cost.backend} | {cost.forward:.1f} | {cost.backward:.1f} | {ratio} |"
        )
    return [*lines, ""]


def plot(audit: Audit) -> bytes:
    """Plot errors (left axis) and the share of invalid covariances (right axis) over the condition number, as a PNG."""
    figure, axes = plt.subplots(figsize=(7.5, 4.5), layout="constrained")
    shares = axes.twinx()
    for curve in audit.conditions:
        color, (median, tail) = COLORS[curve.scheme], np.clip([curve.median, curve.percentile99], LEAST, MOST)
        axes.loglog(curve.condition, median, color=color, marker="o", markersize=3, label=curve.scheme)
        axes.loglog(curve.condition, tail, color=color, linestyle="--")
        shares.plot(curve.condition, [100 * x for x in curve.bad], color=color, linestyle=":")
    axes.set(xlabel="condition number of the factor", ylabel="relative error of the covariance", ylim=(1e-8, 10))
    shares.set(ylabel="indefinite or not finite, % (dotted)", ylim=(-2, 102))
    axes.grid(alpha=0.3)
    if audit.conditions:
        axes.legend(loc="upper left", title="solid: median, dashed: 99 %")
    png = io.BytesIO()
    figure.savefig(png, format="png", dpi=110)
    plt.close(figure)
    return png.getvalue()
