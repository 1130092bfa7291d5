"""Make Table 2 of the 7DGS paper from run records: measured averages over a data set and the paper's averages."""

import math
from typing import Any

from gsbench.errors import printable
from gsbench.measure.record import Record
from gsbench.report import paper
from gsbench.report.conditions import conditions
from gsbench.report.layout import EMPTY, QuantityColumn, Row, Section, Table
from gsbench.report.paper_protocol import MODELS, ModelRecipe, Sorted, finished, model_recipes
from gsbench.report.seed_means import SPREAD, mean
from gsbench.report.table1 import missing
from gsbench.report.tables import LEAKS

COLUMNS = [
    QuantityColumn("psnr", "PSNR", 2),
    QuantityColumn(LEAKS, LEAKS, 2),
    QuantityColumn("ssim", "SSIM", 3),
    QuantityColumn("lpips_alex", "LPIPS-Alex", 3),
]
SOURCES = {
    "quoted": "quoted by the 7DGS paper (Table 2) from earlier publications",
    "retrained": "quoted by the 7DGS paper (Table 2) from the paper of Ex4DGS, whose authors trained the method again; "
    "STG's own paper has 33.6 dB",
    "reproduced": "reproduced by the 7DGS paper (Table 2) with the method's official code; 4DGS' and 7DGS' PSNR is "
    "the best on test seen during training, so it stands in the column that leaks too",
    "table 1": "the average of the 7DGS paper's Table 1 (its Table 2 lacks this data set), best on test",
}
NAMES = {"4dgs": "4DGS", "7dgs_noagr": "7DGS without AGR", "7dgs": "7DGS"}
LPIPS = "LPIPS of D-NeRF and 7DGS-PBR is of a backbone that the paper does not name; of Technicolor it is AlexNet's."

Line = dict[str, Any]


def build(found: Sorted) -> tuple[list[Table], list[Line]]:
    """Make a table for each data set of the 7DGS paper, and the lines of the CSV file.

    A model has numbers only if all scenes of the data set are finished with the paper's protocol.
    """
    made: list[Table] = []
    lines: list[Line] = []
    for dataset, records in found.paper.items():
        marks: list[str] = []
        rows = [*_published(dataset, lines, marks), *_measured(dataset, records, lines)]
        notes = [missing(dataset, records), LPIPS, *(conditions(records, SPREAD) if records else [])]
        sections = [Section(f"average over {len(paper.PROTOCOLS[dataset].scenes)} scenes", rows)]
        made.append(Table(f"Table 2, {dataset}, at the paper's protocol", COLUMNS, sections, marks, notes))
    if found.other_data:
        names = ", ".join(sorted({printable(pool.dataset) for pool in found.other_data}))
        made[-1].footnotes.append(f"OTHER DATA is in table1.md and has no average here: {names}.")
    return made, lines


def _published(dataset: str, lines: list[Line], marks: list[str]) -> list[Row]:
    """Make the rows of the paper's Table 2; if it lacks the data set, use the averages of the paper's Table 1."""
    methods = [(m.method, m.source, m.psnr, m.ssim, m.lpips) for m in paper.table2().get(dataset, [])]
    if not methods:
        averages = [(NAMES[model], paper.paper_row(dataset, paper.AVERAGE, model)) for model in paper.MODELS]
        methods = [(name, "table 1", row.psnr, row.ssim, row.lpips) for name, row in averages if row]
    rows = []
    for name, source, psnr, ssim, lpips in methods:
        if SOURCES[source] not in marks:
            marks.append(SOURCES[source])
        leaks = source == "table 1" or name in NAMES.values()
        values = {"psnr": psnr, LEAKS: psnr if leaks else math.nan, "ssim": _number(ssim), "lpips_alex": _number(lpips)}
        cells = {c.key: c.show(values.get(c.key, math.nan)) for c in COLUMNS}
        rows.append(Row(f"{name} ({marks.index(SOURCES[source]) + 1})", cells, paper=True))
        line: Line = {"dataset": dataset, "method": name, "source": f"paper, {source}", "recipe": "", "seeds": ""}
        lines.append(line | {c.key: values.get(c.key, math.nan) for c in COLUMNS})
    return rows


def _measured(dataset: str, records: list[Record], lines: list[Line]) -> list[Row]:
    """Make a row of measured averages for every model; a row has no numbers if a scene is not finished."""
    scenes = paper.PROTOCOLS[dataset].scenes
    rows = []
    found = model_recipes(records)
    found += [
        ModelRecipe(model, "", "") for model in MODELS if not any((a.model, a.recipe) == (model, "") for a in found)
    ]
    for one in sorted(found, key=lambda one: (MODELS.index(one.model), one)):
        runs = finished(records, one, scenes)
        label = f"measured: {one.model} {one.recipe}".rstrip()
        if len(runs) < len(scenes):
            rows.append(Row(f"{label}, {len(runs)} of {len(scenes)} scenes", {c.key: EMPTY for c in COLUMNS}))
            continue
        means = {c.key: mean(runs, c.key) for c in COLUMNS}
        seeds = min(map(len, runs.values()))
        rows.append(Row(label, {c.key: c.show(means[c.key].mean, means[c.key].half) for c in COLUMNS}, str(seeds)))
        line: Line = {"dataset": dataset, "method": one.model, "source": f"measured, experiment {one.experiment}"}
        line |= {"recipe": one.recipe, "seeds": seeds}
        for c in COLUMNS:
            line |= {c.key: means[c.key].mean, f"{c.key} ±": means[c.key].half}
        lines.append(line)
    return rows


def _number(value: float | None) -> float:
    return math.nan if value is None else value
