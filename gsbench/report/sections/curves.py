"""PSNR on the validation views while models train: mean curves, and the time to reach a quality."""

import math

import pandas as pd

from gsbench.report.frame import Results
from gsbench.report.section import Column, Figure, Section, section

STEPS = (2.0, 1.0, 0.5, 0.2, 0.1)  # dB between two targets
FEWEST_TARGETS = 3  # for one scene
WIDEST = 100.0  # dB from the lowest result, above which there is no target: more is no difference between models
CONFIGURATION = ["scene", "series", "model", "variant"]


def mean_curves(chapter: Results) -> pd.DataFrame:
    """Return the mean curve over seeds of each configuration on each scene, at the iterations that all seeds measured.

    A configuration whose seeds kept different lengths (`train.lengths`) has no mean curve.
    """
    runs = chapter.finished.runs
    lengths = runs.groupby(CONFIGURATION).iterations.transform(lambda values: values.nunique(dropna=False))
    runs = runs[runs.train_s.notna() & (lengths == 1)]
    points = chapter.curves.dropna(subset="psnr_val_db").drop_duplicates(["run", "iteration"], keep="last")
    points = points.merge(runs[CONFIGURATION], left_on="run", right_index=True, validate="many_to_one")
    means = points.groupby([*CONFIGURATION, "iteration"])[["train_s", "psnr_val_db"]].agg(["mean", "size"])
    seeds = runs.groupby(CONFIGURATION).size().reindex(means.index.droplevel("iteration")).to_numpy()
    means = means[means["train_s", "size"] == seeds].xs("mean", axis=1, level=1)
    return means.reset_index().astype({"iteration": int})


def targets(chapter: Results) -> pd.DataFrame:
    """Return the PSNR targets of every scene and the training seconds that each series needs to reach them.

    A series is a model, with its gates. Its seconds are the least after which the mean curve of one of its
    configurations reaches the target; infinite: it never does. Nothing is interpolated between measurements.
    """
    runs = chapter.finished.runs
    ends = runs.groupby(CONFIGURATION)[["train_s", "psnr_val_db"]].mean().dropna().reset_index()
    # Ends count too: a configuration of runs of several lengths has no mean curve.
    reached = pd.concat([ends, mean_curves(chapter).merge(ends[CONFIGURATION])], ignore_index=True)
    rows = []
    for scene, ends_of_scene in ends.groupby("scene"):
        psnr = reached[reached.scene == scene]
        for target in round_numbers(ends_of_scene.psnr_val_db.min(), ends_of_scene.psnr_val_db.max()):
            needed = psnr.train_s.where(psnr.psnr_val_db >= target, math.inf).groupby(psnr.series).min()
            rows.append({"scene": scene, "target": f"{target:g} dB", "dB": target} | needed.to_dict())
    return pd.DataFrame(rows, columns=["scene", "target", "dB", *sorted(ends.series.unique())])


def round_numbers(low: float, high: float) -> list[float]:
    """Return the values above `low` and up to `high` that are multiples of 2, 1, 0.5, 0.2 or 0.1 dB.

    The step is the largest that gives three values, else 0.1 dB. Round values favour no model.
    """
    high, values = min(high, low + WIDEST), []
    for step in STEPS:
        values = [round(i * step, 1) for i in range(math.floor(low / step) + 1, math.floor(high / step) + 1)]
        if len(values) >= FEWEST_TARGETS:
            break
    return values


@section()
def quality(chapter: Results, tests: pd.DataFrame) -> Section | None:
    """Make the table of the seconds to reach targets."""
    table = targets(chapter)
    if table.empty:
        return None
    models = [name for name in table if name not in ("scene", "target", "dB")]
    table = table.rename(columns={name: f"{name}, s" for name in models})
    text = (
        "Targets are round values of PSNR on val between the lowest and the highest run of a scene. Seconds are "
        "those after which the mean curve on val of a model's runs, of any length, first has the target; the runs go "
        "on after that."
    )
    columns = {f"{name}, s": Column(f"{name}, s", 1) for name in models} | {"dB": Column("dB", 2)}
    return Section("quality", "Time to quality", text, table, columns)


@section()
def curves(chapter: Results, tests: pd.DataFrame) -> Section | None:
    """Make the table and the figure of PSNR on val during training, with the settings that most runs share."""
    table = mean_curves(chapter.of(chapter.runs.main))
    if table.empty:
        return None
    text = (
        "Mean over seeds, of the runs whose settings most runs share. Do not read shorter trainings off these curves: "
        "schedules depend on length."
    )
    figure = Figure("PSNR on val while training", "curves", table)
    return Section("curves", "While training", text, table.drop(columns="series"), figures=(figure,))
