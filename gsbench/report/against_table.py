"""Show a comparison of two folders of run records as a table for the terminal and the report, and as plain values."""

import math
from typing import Any

from gsbench.errors import printable
from gsbench.measure.record import Record
from gsbench.report import against_lines
from gsbench.report.against import LIMITS, RULE, ComparedRuns, Comparison, Judged, value
from gsbench.report.layout import EMPTY, QuantityColumn, Row, Section, Table

COLUMNS = [
    QuantityColumn("psnr", "PSNR dB", 2),
    QuantityColumn("seconds", "training s", 1),
    QuantityColumn("ms", "ms a frame", 2),
    QuantityColumn("gaussians", "Gaussians", 0),
    QuantityColumn("mb", "MB", 2),
]


def tables(of: Comparison) -> list[Table]:
    """Make a table that compares the runs of two folders, with one section for each scene.

    A section has one row for each model and seed with the values of both folders. Two further rows give each model's
    mean difference and the verdict.
    """
    scenes = sorted({(row.experiment, row.dataset, row.scene) for row in of.rows})
    several = len({scene[:2] for scene in scenes}) > 1
    sections = []
    for scene in scenes:
        rows = [row for row in of.rows if (row.experiment, row.dataset, row.scene) == scene]
        title = ", ".join(map(printable, scene)) if several else printable(scene[2])
        sections.append(Section(title, [line for row in rows for line in lines(row)], _reasons(rows)))
    footnotes = [RULE]
    for difference, names in of.otherwise.items():
        footnotes.append(
            f"trained otherwise than in {of.theirs}, so not compared: {difference} ({len(names)} models on scenes)"
        )
    for folder, missing in ((of.ours, of.only_ours), (of.theirs, of.only_theirs)):
        more = f" and {len(missing) - 10} more" if len(missing) > 10 else ""
        footnotes += [f"only in {folder}: {printable(', '.join(missing[:10]))}{more}"] if missing else []
    return [Table(f"{of.ours} / {of.theirs}", COLUMNS, sections, [], footnotes)]


def lines(row: ComparedRuns) -> list[Row]:
    """Make the table rows for a model on a scene: one for each seed, one with differences and one with verdicts."""
    made = []
    for seed in sorted(row.ours.keys() | row.theirs.keys()):
        pair = row.ours.get(seed), row.theirs.get(seed)
        cells = {c.key: " / ".join(_shown(record, c) for record in pair) for c in COLUMNS}
        made.append(Row(f"{printable(row.model)} seed {seed}", cells))
    made.append(Row(f"{printable(row.model)} difference", {c.key: _difference(row.judged[c.key], c) for c in COLUMNS}))
    made.append(Row(f"{printable(row.model)} verdict", {c.key: row.judged[c.key].verdict for c in COLUMNS}))
    return made


def _shown(record: Record | None, column: QuantityColumn) -> str:
    return EMPTY if record is None or record.status != "ok" else column.show(value(record, column.key))


def _difference(found: Judged, column: QuantityColumn) -> str:
    """Format a difference of means, followed by half the width of its interval if this is known."""
    if found.is_bit_equal:
        return "bit-equal"
    mean, half = found.difference.mean, found.difference.half
    if math.isnan(mean):
        return EMPTY
    width = "" if math.isnan(half) else f" ± {half:.{column.digits}f}"
    return f"{mean:+.{column.digits}f}{width}"


def _reasons(rows: list[ComparedRuns]) -> list[str]:
    """List the reasons why quantities cannot be judged; all models with the same reason share one line."""
    titles = {c.key: c.title for c in COLUMNS}
    why: dict[str, dict[str, list[str]]] = {}
    for row in rows:
        for quantity, found in row.judged.items():
            if found.reason:
                why.setdefault(found.reason, {}).setdefault(titles[quantity], []).append(printable(row.model))
    said = []
    for reason, of in why.items():
        models = sorted({model for named in of.values() for model in named})
        named = "" if len(models) == len(rows) else f" of {', '.join(models)}"
        said.append(f"{', '.join(of)}{named} cannot be told: {reason}")
    return said


def content(of: Comparison) -> dict[str, Any]:
    """Return a comparison of two folders of run records as plain values for JSON."""
    return {
        "ours": of.ours,
        "theirs": of.theirs,
        "verdict": of.verdict,
        "lines": against_lines.compared(of),
        "rule": RULE,
        "rows": [_plain(row) for row in of.rows],
        "only_ours": of.only_ours,
        "only_theirs": of.only_theirs,
        "otherwise": of.otherwise,
    }


def _plain(row: ComparedRuns) -> dict[str, Any]:
    named = {name: getattr(row, name) for name in ("experiment", "dataset", "scene", "model")}
    runs = [
        {"seed": seed, "ours": _run(row.ours.get(seed)), "theirs": _run(row.theirs.get(seed))}
        for seed in sorted(row.ours.keys() | row.theirs.keys())
    ]
    judged = {
        quantity: {
            "verdict": found.verdict,
            "reason": found.reason or None,
            "bit_equal": found.is_bit_equal,
            "difference": found.difference.mean,
            "low": found.difference.low,
            "high": found.difference.high,
            "p_holm": found.p_holm,
        }
        for quantity, found in row.judged.items()
    }
    return {**named, "runs": runs, "judged": judged}


def _run(record: Record | None) -> dict[str, Any] | None:
    if record is None:
        return None
    numbers = {quantity: value(record, quantity) for quantity in LIMITS}
    return {"status": record.status, **numbers, "machine": record.provenance.machine}
