"""The result table of an experiment: each model on each scene, averages, runs that failed, and the paper's rows."""

from collections.abc import Iterator, Sequence

import pandas as pd

from gsbench.errors import printable
from gsbench.measure.record import Renders
from gsbench.report import paper, stats
from gsbench.report.frame import TIMES, Results, covered, names_of, row, title_of, without
from gsbench.report.section import COLUMNS, Column, Section, number, section

SHOWN = (
    "psnr_db",
    "psnr_moving_db",
    "psnr_object_db",
    "ssim",
    "lpips_alex",
    "train_min",
    "fps",
    "gaussians",
    "lpips_vgg",
    "flicker",
    "static_drift",
    "flicker_truth",
    "psnr_best_on_test_db",
)
WITH_TRAIN = (SHOWN[0], "psnr_train_db", *SHOWN[1:])  # for --train
# Columns that are shown even if no run has them.
ALWAYS = ("psnr_db", "psnr_train_db", "ssim", "lpips_alex", "train_min", "fps", "gaussians")
ORIGIN = ["contributor", "machine", "git_commit"]  # in a merged set, all runs of a row have the same
TEXT = (
    "Mean over seeds ± half the width of the 95 % interval over seeds. Bold: the best mean of a scene and every mean "
    "that does not differ from it: the interval of their paired difference contains zero, or they look equal."
)
PAPER, STAND_IN = "paper", "paper, other data"  # rows, and what the text says of them
OF_ROWS = {
    PAPER: " “paper”: Table 1 of the 7DGS paper, whose PSNR is the best on test (leaks), whose times are of a V100, "
    "and whose LPIPS does not name its network.",
    STAND_IN: " “paper, other data”: Table 1 of the 7DGS paper; the scene here is a stand-in of the same name, so "
    "the two rows cannot be compared.",
}
MERGED = (
    "Mean over the seeds of one contributor, machine and commit ± half the width of the 95 % interval over seeds. "
    "Bold: the best mean of a scene and every mean that does not differ from it. Minutes and FPS are those of the "
    "row's machine and not ranked: compare them within one machine. Averages are of rows with all scenes."
)


@section(in_terminal=True, in_latex=True)
def experiment(chapter: Results, tests: pd.DataFrame) -> Section:
    """Make the table; averages are over the scenes that every model has finished."""
    return table(chapter, [])


def table(chapter: Results, asked: Sequence[str]) -> Section:
    """Make the table with the given columns of `runs`, or with those that the runs have if none is given.

    In a merged set (gsbench.report.merge) a row is of one contributor, machine and commit, and has its own times.
    """
    runs, ok = _by_row(chapter.runs), _by_row(chapter.finished.runs)
    origin = [name for name in ORIGIN if "contributor" in runs]
    is_all = set(asked) in (set(), set(WITH_TRAIN))  # no --select column=..
    names = [n for n in asked or SHOWN if not (is_all and n not in ALWAYS and ok[n].isna().all())]
    by_scene = [_means(ok[ok.scene == scene], names).assign(scene=scene) for scene in sorted(ok.scene.unique())]
    failed = runs[runs.status != "ok"]
    labels = failed.label + " seed " + failed.seed.astype(str) + ": " + failed.status
    by_scene.append(pd.DataFrame({"scene": failed.scene, "label": labels}))
    averaged = ok[ok.groupby("row").scene.transform("nunique") == runs.scene.nunique()] if origin else ok
    scenes = covered(averaged if origin else runs)
    if runs.scene.nunique() > 1 and scenes:
        where = f"average over {len(scenes)} of {runs.scene.nunique()} scenes"
        by_scene.append(_means(averaged[averaged.scene.isin(scenes)], names).drop(columns="seeds").assign(scene=where))
    rows = pd.concat(by_scene, ignore_index=True)
    if not origin:
        rows = pd.concat([rows, *_paper_rows(rows, runs, scenes)]).sort_index(kind="stable")
    shown = [c for name in names for c in (name, f"{name} ±", f"{name} rank") if c in rows]
    order = ["scene", "label", *origin[:1], *shown, "seeds", *origin[1:]]
    rows = rows.reindex(columns=order).rename(columns={"label": "model"}).reset_index(drop=True)
    title, notes = f"Results: {title_of(runs)}", tuple(_notes(chapter))
    words = (
        MERGED if origin else TEXT + "".join(sentence for name, sentence in OF_ROWS.items() if name in set(rows.model))
    )
    columns = {"git_commit": Column("commit")}
    return Section("experiment", title, words, rows, columns, notes=notes, sortable=bool(origin))


def _by_row(runs: pd.DataFrame) -> pd.DataFrame:
    """Add what names a row: the label; in a merged set also the origin, and times that `Results.chapters` removed."""
    if "contributor" not in runs:
        return runs.assign(row=runs.label)
    times = pd.DataFrame([row(record) for record in runs.record], runs.index, TIMES, dtype=float)
    variant = runs.variant.map(lambda text: without(text, "from"))
    label = names_of(runs.assign(variant=variant)) if variant.nunique() > 1 else runs.model
    runs = runs.assign(**times, is_timed=True, label=label, git_commit=runs.git_commit.str[:12])
    return runs.assign(row=runs[["label", *ORIGIN]].agg("\n".join, axis=1))


def _means(runs: pd.DataFrame, names: list[str]) -> pd.DataFrame:
    """Return the means of each row of the table with their ranks; times of several machines have none."""
    rows = stats.means(runs, ["row"], names)
    for name in names:
        column = COLUMNS.get(name) or Column(name)
        if column.better and not (name in TIMES and "contributor" in runs):
            ranks = stats.ranks(runs, "row", name, column.better == "higher", column.show)
            rows[f"{name} rank"] = rows.row.map(ranks)
    named = [name for name in ("label", *ORIGIN) if name in runs]
    return rows.merge(runs.drop_duplicates("row")[["row", *named]], validate="one_to_one")


def _paper_rows(rows: pd.DataFrame, runs: pd.DataFrame, averaged: list[str]) -> Iterator[pd.DataFrame]:
    """Yield the 7DGS paper's rows, each with the index of the measured row of the same scenes and model above it."""
    runs = runs[runs.model.isin(list(paper.MODELS)) & (runs.effect_refinement == runs.model.map(paper.MODELS))]
    first = runs.drop_duplicates(["scene", "label"]).set_index(["scene", "label"])
    for i, scene, label in zip(rows.index, rows.scene, rows.label, strict=True):
        scenes = [scene] if scene in set(runs.scene) else averaged
        if not scenes or not all((name, label) in first.index for name in scenes):
            continue  # a failed run, or a model of the same name that differs from the paper's in AGR
        measured = first.loc[[(name, label) for name in scenes]]
        named = measured.protocol_paper_dataset.iloc[0] if "protocol_paper_dataset" in measured else None
        numbers = paper.average(str(named), scenes, measured.model.iloc[0])
        if len(numbers):
            title = PAPER if (measured.dataset == named).all() else STAND_IN
            yield pd.DataFrame([numbers.to_dict() | {"scene": scene, "label": title}], index=[i])


def _notes(chapter: Results) -> Iterator[str]:
    """Yield why runs failed and metrics are missing, what was rendered elsewhere, and the pixels of regions."""
    for run in chapter.runs[chapter.runs.status != "ok"].itertuples():
        yield printable(f"{run.scene}, {run.label} seed {run.seed} {run.status}: {run.reason}")
    ok = chapter.finished.runs
    lacks = pd.DataFrame(
        [(metric, why, run.scene) for run in ok.itertuples() for metric, why in run.missing.items()],
        columns=["metric", "why", "scene"],
    )
    titles: dict[str, list[str]] = {}  # of the metrics that lack for a reason in some scenes
    for (metric, why), rows in lacks.groupby(["metric", "why"]):
        column = COLUMNS.get(metric) or COLUMNS.get(f"{metric}_db")
        scenes = "" if set(rows.scene) == set(ok.scene) else f" ({', '.join(sorted(set(rows.scene)))})"
        titles.setdefault(f"{why}{scenes}", []).append(column.title if column else metric)
    yield from (printable(f"{', '.join(metrics)}: {reason}") for reason, metrics in titles.items())
    for (scene, label), runs in ok[ok.rendered_elsewhere].groupby(["scene", "label"]):
        renders: Renders = runs.record.iloc[0].rendered_elsewhere
        reduced = f", reduced from {renders.resized_from}" if renders.resized_from else ""
        matched = f"{renders.kind}, matched to the views by {renders.matched}{reduced}"
        yield printable(f"{scene}, {label}: rendered elsewhere; {matched}")
    for scene, runs in ok.groupby("scene"):
        regions = {name: region for record in runs.record if record for name, region in record.regions.items()}
        for name, region in sorted(regions.items()):
            share = number(100 * region.share, 1)
            metric = "flicker" if name == "static" else f"PSNR {name}"
            yield printable(
                f"{scene}: {metric} is over {share} % of the pixels of {region.views} views, from {region.source}"
            )
