"""Where the seconds of training go: the mean seconds of each model in each stage of a training step."""

import pandas as pd

from gsbench.report.frame import Results, covered
from gsbench.report.section import Column, Figure, Section, section

STAGES = ("slice", "raster", "loss", "backward", "density", "optimizer", "screen", "gate", "compare")
REST = "other"  # work between the stages, such as checks of values
LEAST_REST = 0.005  # share of the seconds below which the rest is not shown


@section()
def stages(chapter: Results, tests: pd.DataFrame) -> Section | None:
    """Make the table and the figure of the models with the settings that most runs share."""
    runs = chapter.finished.runs
    runs = runs[runs.main & runs.train_s.notna() & ~runs.rendered_elsewhere]
    scenes = covered(chapter.finished.runs[chapter.finished.runs.main], "model")
    runs = runs[runs.scene.isin(scenes)] if scenes else runs
    names = [stage for stage in STAGES if f"stage_{stage}" in runs and runs[f"stage_{stage}"].notna().any()]
    if not names or runs.empty:
        return None
    seconds = runs[[f"stage_{stage}" for stage in names]].astype(float).fillna(0.0).set_axis(names, axis=1)
    seconds = seconds.assign(total=runs.train_s)
    table = seconds.groupby([runs.model, runs.scene]).mean().groupby("model").mean()
    table[REST] = table.total - table[names].sum(axis=1)
    table = table[["total", *names, REST]]
    table = table[table.total > 0]
    if (table[REST] <= LEAST_REST * table.total).all():
        table = table.drop(columns=REST)
    table = table.reset_index()
    if table.empty:
        return None
    text = (
        "Mean over scenes and seeds, of the runs whose settings most runs share. “compare”: trainings of other models "
        "or lengths that were not kept; “other”: work between the stages, such as checks of values."
    )
    shown = [name for name in (*names, REST) if name in table]
    drawn = table.melt("model", shown, "part", "size")
    options = {"label": "model", "parts": shown, "title": "training seconds", "colours": "stage"}
    figure = Figure("Seconds of training by stage", "bars", drawn, options)
    columns = {name: Column(f"{name} s", 2) for name in ("total", *shown)}
    return Section("stages", "Where the seconds go", text, table, columns, (figure,))
