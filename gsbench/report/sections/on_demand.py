"""Which effects (time, view direction, AGR) models and their Gaussians keep, and what removing the others changed."""

import math
import re
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from gsbench.gates.messages import EFFECT_SETS, of_comparison
from gsbench.measure.record import Gate, Record
from gsbench.report import stats
from gsbench.report.frame import Results
from gsbench.report.intervals import Estimate, over_seeds
from gsbench.report.section import COLUMNS, Column, Figure, Section, section
from gsbench.report.sections.gallery import images

PICTURES = ("effect_sets.png", "classes.png")  # older runs have the second name
REMOVED = "removed"
DEGREES = [f"degree {i}" for i in range(4)]  # of spherical harmonics
MOST_BARS = 24
MOST_NOTES = 12
SHOWN = {
    "p": Column("largest p", 3), "free": Column("% free of the camera", 0), "screen_s": Column("screen s", 1),
    "before": Column("Gaussians before", 0), REMOVED: Column("removed", 0),
    "asleep": Column("% of AGR left out of a frame", 0),
    **{name: Column(title, 0) for name, title in EFFECT_SETS.items()}, **{name: Column(name, 0) for name in DEGREES},
    "predicted": Column("predicted dB", 3, signed=True), "dB": Column("PSNR dB", 3, signed=True),
    "ms_before": Column("ms before", 2), "ms": Column("ms", 2, signed=True),
    "mb_before": Column("MB before"), "mb": COLUMNS["model_mb"],
}  # fmt: skip


@section()
def on_demand(chapter: Results, tests: pd.DataFrame) -> Section | None:
    """Make the table and the figures; None if no run chose effects."""
    runs = chapter.finished.runs
    runs = runs[runs.on_demand]
    if runs.empty:
        return None
    groups = runs.groupby(["scene", "model", "variant"], sort=True)
    rows = [dict(zip(("scene", "model", "variant"), key, strict=True)) | _mean(of) for key, of in groups]
    table = pd.DataFrame(rows)
    names = table.model if table.variant.nunique() == 1 else (table.model + " " + table.variant).str.rstrip()
    drawn = table.assign(label=table.scene + ", " + names)[table.gated > 0].head(MOST_BARS)
    figures = () if drawn.empty else (
        _figure("Gaussians before the gates, by effect set, %", drawn, [*EFFECT_SETS, REMOVED], "effect set"),
        _figure("Gaussians left, by degree of harmonics, %", drawn, DEGREES, "degree"),
    )  # fmt: skip
    text = (
        "Each Gaussian keeps the effects that it needs (docs/effects.md). Numbers are means over seeds; changes of "
        "PSNR and ms are those of the gate after training. A gate during training changes the training too: compare "
        "runs with and without gates in “What accuracy costs”."
    )
    where = [(f"{scene}, {model}", of.path) for (scene, model, _), of in groups]
    pictures = [(caption, _picture(paths)) for caption, paths in where]
    notes, shown = tuple(_notes(runs)), tuple(images(pictures))
    return Section("on_demand", "Effects on demand", text, table, SHOWN, figures, notes, images=shown)


def _mean(runs: pd.DataFrame) -> dict[str, Any]:
    """Return the row of a model on a scene: means over the seeds that have a number."""
    of = pd.DataFrame(
        [_run(r, r.provenance.machine == timed) for r, timed in zip(runs.record, runs.timed_on, strict=True)]
    )
    evaluated = of.dB_evaluated[of.ends].notna().all()
    of["dB"] = of.dB_evaluated if evaluated else of.dB_checked
    screens = [r.on_demand.screen for r in runs.record if r.on_demand.screen]
    decisions = Counter(screen.decision for screen in screens)
    comparison = next((r.on_demand.comparison for r in runs.record if r.on_demand.comparison), None)
    estimates = {name: _estimate(of[name]) for name in SHOWN}
    numbers = {name: estimate.mean for name, estimate in estimates.items()}
    halves = {f"{name} ±": estimates[name].half for name in ("dB", "ms")}
    split = of.split if evaluated else of.checked_on
    texts = {
        "seeds": len(runs),
        "screen": ", ".join(f"{decision} {n}" for decision, n in sorted(decisions.items())),
        "why": screens[0].reason if screens else "",
        "compared": of_comparison(comparison) if comparison else "",
        "gated": int(of.before.notna().sum()),
        "measured on": next(
            (value for value, ends in zip(split, of.ends, strict=True) if ends and isinstance(value, str)), ""
        ),
    }
    order = [*texts, *(c for name in SHOWN for c in (name, f"{name} ±") if c in numbers or c in halves)]
    return {name: (texts | numbers | halves)[name] for name in order} | {"p": of.p.max()}


def _estimate(values: pd.Series) -> Estimate:
    """Estimate a mean over the seeds that have a number."""
    known = values[np.isfinite(values.to_numpy(float))].tolist()
    return over_seeds(known) if known else stats.NOTHING


def _run(r: Record, is_timed: bool) -> dict[str, Any]:
    """Return the numbers of a run; what it lacks, or took on another machine, is NaN."""
    assert r.on_demand is not None
    gates, screen = r.on_demand.gates, r.on_demand.screen
    row: dict[str, Any] = {
        "ends": bool(gates) and gates[-1].step is None,
        "split": r.protocol.get("eval_split"),
        "checked_on": "",
    }
    row |= dict.fromkeys([*SHOWN, "dB_evaluated", "dB_checked"], math.nan)
    if screen:
        row |= {"p": _number(screen.p), "free": 100 * _number(screen.free)}
        row |= {"screen_s": screen.seconds if is_timed else math.nan}
    if gates:
        last = gates[-1]
        row |= {name: max(0, last.rows.get(name, 0)) for name in EFFECT_SETS}
        row |= {REMOVED: sum(max(0, gate.rows.get(REMOVED, 0)) for gate in gates)}
        row |= {"before": sum(row[name] for name in (*EFFECT_SETS, REMOVED))}
        row |= {name: _of_degree(last, name) for name in DEGREES}
        row |= {"mb_before": gates[0].bytes_before / 1e6, "mb": last.bytes / 1e6}
    if row["ends"]:
        row |= {
            "dB_evaluated": -_number(last.eval_loss_db),
            "dB_checked": -last.measured_db,
            "checked_on": last.checked_on,
        }
        row |= {"predicted": -last.predicted_db, "asleep": 100 * (last.asleep or 0.0)}
        if is_timed and last.frame_ms is not None:
            row |= {"ms_before": _number(last.frame_ms_before), "ms": last.frame_ms - _number(last.frame_ms_before)}
    return row


def _number(value: float | None) -> float:
    return math.nan if value is None else value


def _of_degree(gate: Gate, degree: str) -> int:
    """Count the Gaussians whose colours have harmonics of a degree, whether or not the colours change with time."""
    return sum(max(0, n) for name, n in gate.orders.items() if re.match(rf"{degree}\b", name))


def _figure(caption: str, table: pd.DataFrame, parts: Sequence[str], colours: str) -> Figure:
    """Return stacked bars of the shares of some columns."""
    total = table[list(parts)].sum(axis=1)
    shares = table[list(parts)].div(total.where(total > 0), axis=0).fillna(0) * 100
    titles = [SHOWN[name].title for name in parts]
    drawn = shares.set_axis(titles, axis=1).assign(label=table.label).melt("label", titles, "part", "size")
    return Figure(caption, "bars", drawn, {"label": "label", "parts": titles, "title": "%", "colours": colours})


def _notes(runs: pd.DataFrame) -> list[str]:
    """List what the choice of effects could not decide, with the seeds that say so."""
    seeds: dict[str, list[str]] = {}
    for run in runs.itertuples():
        for note in run.record.on_demand.notes:
            seeds.setdefault(f"{run.scene}, {run.label}: {note}", []).append(str(run.seed))
    notes = [f"{note} (seed {', '.join(some[:5])})" for note, some in seeds.items()]
    return notes[:MOST_NOTES] + [f"{len(notes) - MOST_NOTES} more notes are in the records."] * (
        len(notes) > MOST_NOTES
    )


def _picture(paths: pd.Series) -> Any:
    """Return the first picture of the effect sets beside some records."""
    return next((file for path in paths for name in PICTURES if (file := path.parent / name).is_file()), None)
