"""Which effects (time, view direction, AGR) models and their Gaussians keep, and what removing the others changed."""

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from gsbench.gates.messages import EFFECT_SETS
from gsbench.measure.record import Gate, Record
from gsbench.report.frame import Results, names_of
from gsbench.report.intervals import over_seeds
from gsbench.report.section import COLUMNS, Column, Figure, Section, section
from gsbench.report.sections.gallery import images

PICTURE = "effect_sets.png"
REMOVED = "removed"
# Older runs also have Gaussians that are independent of only time, or only direction.
SETS = {x: EFFECT_SETS.get(x, f"{x} frozen") for x in ("refined", "conditioned", "time", "direction", "static")}
DEGREES = [f"degree {i}" for i in range(4)]  # of spherical harmonics
MOST_BARS = 24
MOST_NOTES = 12
SHOWN = {
    "p": Column("largest p", 3),
    "free": Column("% free of the camera", 0),
    "screen_s": Column("screen s", 1),
    "before": Column("Gaussians before", 0),
    REMOVED: Column("removed", 0),
    "asleep": Column("% of AGR left out of a frame", 0),
    **{name: Column(title, 0) for name, title in SETS.items()},
    **{name: Column(name, 0) for name in DEGREES},
    "predicted": Column("predicted dB", 3, signed=True),
    "dB": Column("PSNR dB", 3, signed=True),
    "ms_before": Column("ms before", 2),
    "ms": Column("ms", 2, signed=True),
    "mb_before": Column("MB before"),
    "mb": COLUMNS["model_mb"],
}
TEXTS = ["decision", "why", "split", "checked_on"]  # of a run, beside SHOWN
LOSSES = ["predicted", "evaluated", "checked"]  # dB: predicted, on the evaluated views, and on those of the check


@section()
def on_demand(chapter: Results, tests: pd.DataFrame) -> Section | None:
    """Make the table and the figures; None if no run chose effects."""
    runs = chapter.finished.runs
    runs = runs[runs.on_demand]
    if runs.empty:
        return None
    table = _means(runs)
    names = table.model if table.variant.nunique() == 1 else names_of(table)
    drawn = table.assign(label=table.scene + ", " + names)[table.gated > 0].head(MOST_BARS)
    figures = (
        ()
        if drawn.empty
        else (
            _figure("Gaussians before the gates, by effect set, %", drawn, [*SETS, REMOVED], "effect set"),
            _figure("Gaussians left, by degree of harmonics, %", drawn, DEGREES, "degree"),
        )
    )
    text = (
        "Each Gaussian keeps the effects that it needs (docs/effects.md). Numbers are means over seeds; changes of "
        "PSNR and ms are those of the gate after training. A gate during training changes the training too: compare "
        "runs with and without gates in “What accuracy costs”."
    )
    groups = runs.groupby(["scene", "model", "variant"])
    pictures = [(f"{scene}, {model}", _picture(runs_of_group.path)) for (scene, model, _), runs_of_group in groups]
    notes, shown = tuple(_notes(runs)), tuple(images(pictures))
    return Section("on_demand", "Effects on demand", text, table, SHOWN, figures, notes, images=shown)


def _means(runs: pd.DataFrame) -> pd.DataFrame:
    """Return a row for each configuration on a scene: means over the seeds that have a number, and the largest p.

    The change of PSNR is that on the evaluated views, or on the views of the gate's check if a run lacks the first.
    """
    rows = [_numbers(run.record, is_timed=run.is_timed) for run in runs.itertuples()]
    names = [*SHOWN, "evaluated", "checked"]
    numbers = pd.DataFrame(rows, runs.index).reindex(columns=["gated_at_end", *TEXTS, *names])
    numbers = numbers.astype(dict.fromkeys(names, float) | dict.fromkeys(TEXTS, object))
    numbers[["free", "asleep"]] *= 100  # shares, in per cent
    numbers[LOSSES] *= -1  # as changes
    numbers["ms"] -= numbers.ms_before
    key = [runs[name] for name in ("scene", "model", "variant")]
    # Views of one kind for all seeds of a configuration. A run that was not gated at its end has neither number.
    is_evaluated = (numbers.evaluated.notna() | ~numbers.gated_at_end).groupby(key).transform("all")
    numbers["dB"] = numbers.evaluated.where(is_evaluated, numbers.checked)
    numbers["measured on"] = numbers.split.where(is_evaluated, numbers.checked_on).where(numbers.gated_at_end)
    groups = numbers.groupby(key)
    table = pd.DataFrame(
        {
            "seeds": groups.size(),
            "screen": groups.decision.agg(_counted),
            "why": groups.why.first(),
            "gated": groups.before.count(),
            "measured on": groups["measured on"].first(),
        }
    )
    table = table.join(groups[list(SHOWN)].mean()).assign(p=groups.p.max())
    for name in ("dB", "ms"):
        half = groups[name].agg(lambda values: over_seeds(values.dropna()).half if values.notna().any() else math.nan)
        table.insert(table.columns.get_loc(name) + 1, f"{name} ±", half)
    return table.reset_index()


def _counted(decisions: pd.Series) -> str:
    """Count the decisions of time screens, such as "off 1, on 2"."""
    return ", ".join(f"{decision} {n}" for decision, n in decisions.value_counts().sort_index().items())


def _numbers(r: Record, *, is_timed: bool) -> dict[str, Any]:
    """Return numbers and texts of a run as its record has them; times of another machine are left out."""
    assert r.on_demand is not None
    gates, screen = r.on_demand.gates, r.on_demand.screen
    row: dict[str, Any] = {"gated_at_end": bool(gates) and gates[-1].step is None}
    if screen:
        row |= {"decision": screen.decision, "why": screen.reason, "p": screen.p, "free": screen.free}
        row |= {"screen_s": screen.seconds} if is_timed else {}
    if gates:
        last = gates[-1]
        row |= {name: max(0, last.rows.get(name, 0)) for name in SETS}  # a record may have any numbers
        row |= {REMOVED: sum(max(0, gate.rows.get(REMOVED, 0)) for gate in gates)}
        row |= {"before": sum(row[name] for name in (*SETS, REMOVED))}
        row |= {name: _of_degree(last, name) for name in DEGREES}
        row |= {"mb_before": gates[0].bytes_before / 1e6, "mb": last.bytes / 1e6}
    if row["gated_at_end"]:
        row |= {"evaluated": last.eval_loss_db, "checked": last.measured_db, "predicted": last.predicted_db}
        row |= {"asleep": last.asleep or 0.0, "split": r.protocol.get("eval_split"), "checked_on": last.checked_on}
        if is_timed and last.frame_ms is not None:
            row |= {"ms_before": last.frame_ms_before, "ms": last.frame_ms}
    return row


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
    notes = [f"{note} (seed {', '.join(of_note[:5])})" for note, of_note in seeds.items()]
    more = [f"{len(notes) - MOST_NOTES} more notes are in the records."] if len(notes) > MOST_NOTES else []
    return notes[:MOST_NOTES] + more


def _picture(paths: pd.Series) -> Path | None:
    """Return the first picture of the effect sets beside some records."""
    return next((file for path in paths if (file := path.parent / PICTURE).is_file()), None)
