"""PSNR against seconds, milliseconds and MB: the best model within each budget, and the frontier of each model."""

import math

import pandas as pd

from gsbench.report import stats
from gsbench.report.frame import Results, covered
from gsbench.report.section import Asked, Column, Figure, Section, section

COSTS = {"train_s": "training s", "frame_ms": "ms a frame", "model_mb": "MB"}
BUDGETS = {
    "10 s of training": ("train_s", 10.0),
    "1 min of training": ("train_s", 60.0),
    "10 min of training": ("train_s", 600.0),
    "60 frames a second": ("frame_ms", 1000 / 60),
}
MOST_SINGLE = 300  # single runs that a figure draws
BUSY = 0.5  # load by other work from which a run counts as measured beside it


def points(chapter: Results, scenes: list[str]) -> pd.DataFrame:
    """Return a row for each configuration that finished `scenes`: PSNR with its interval, PSNR on val, and costs."""
    runs = chapter.finished.runs
    configuration = ["series", "model", "variant"]
    table = stats.means(runs[runs.scene.isin(scenes)], configuration, ["psnr_db", "psnr_val_db", *COSTS])
    return table[(table.scenes == len(scenes)) & table.psnr_db.notna()].reset_index(drop=True)


def basis(chapter: Results) -> list[str]:
    """Return the scenes of averages: those that all models finished with the main settings, else the one of most."""
    ok = chapter.finished.runs
    counts = ok.drop_duplicates(["scene", "model", "variant"]).scene.value_counts().sort_index()
    return covered(ok[ok.main], "model") or ([counts.idxmax()] if len(counts) else [])  # of most configurations


def contests(chapter: Results) -> dict[str, pd.DataFrame]:
    """Return for each budget the best configuration of each model within it, the best first, chosen on val.

    Where a run has no PSNR on val, all are chosen on the evaluated views. Images that were rendered elsewhere, which
    have none, are left out.
    """
    table = points(chapter.of(~chapter.runs.rendered_elsewhere), basis(chapter))
    chosen_by = "psnr_db" if table.psnr_val_db.isna().any() else "psnr_val_db"
    ordered = table.sort_values(chosen_by, ascending=False, kind="stable")
    return {name: ordered[ordered[cost] <= most].drop_duplicates("series") for name, (cost, most) in BUDGETS.items()}


def asked(chapter: Results) -> Asked:
    """Return for each budget the differences of the best model and each other model within it."""
    pairs = []
    for budget, table in contests(chapter).items():
        keys = list(table[["model", "variant"]].itertuples(index=False, name=None))
        pairs += [("psnr_db", budget, {keys[0]: 1.0, other: -1.0}) for other in keys[1:]]
    return pairs


@section(asked)
def budgets(chapter: Results, tests: pd.DataFrame) -> Section:
    """Make the table of the best model within each budget; a budget without a model has an empty row."""
    counts = (
        pd.DataFrame(
            {
                "better than": tests.significant & (tests["mean"] > 0),
                "undecided": ~tests.significant & tests.p_holm.notna(),
                "worse than": tests.significant & (tests["mean"] < 0),
                "untested": tests.p_holm.isna(),
            }
        )
        .groupby(tests.name)
        .sum()
    )
    best = {budget: table.head(1).reset_index(drop=True) for budget, table in contests(chapter).items()}
    table = pd.concat([first.reindex([0]).assign(budget=budget) for budget, first in best.items()], ignore_index=True)
    table = table.join(counts, on="budget").fillna(dict.fromkeys(counts, 0))
    table.loc[table.model.isna(), list(counts)] = math.nan
    text = (
        "The model with the highest PSNR on val of those within the budget, and its PSNR on the evaluated views, which "
        "choose too where val is missing or evaluated. The last columns count the other models within the budget that "
        "it differs from significantly, after Holm's correction for all comparisons of this report, or not."
    )
    runs, scenes = chapter.finished.runs, basis(chapter)
    notes = [f"Mean over {', '.join(scenes)}." if scenes else "No run has finished."]
    if beside := int(is_beside_others(runs).sum()):
        notes.append(f"{beside} of {len(runs)} runs were measured beside other work, which makes times longer.")
    columns = {name: Column(name, 0) for name in counts}
    order = ["budget", "model", "variant", "psnr_db", "psnr_db ±", *COSTS, *counts]
    return Section("budgets", "Which model to use", text, table.reindex(columns=order), columns, notes=tuple(notes))


def is_beside_others(runs: pd.DataFrame) -> pd.Series:
    """Tell of each run whether the machine had other work in its training: its load without the run's own is high."""
    of_run = (runs.train_cpu_s / runs.train_s.where(runs.train_s > 0)).fillna(runs.threads)
    return runs.load - of_run > BUSY


@section()
def frontier(chapter: Results, tests: pd.DataFrame) -> Section | None:
    """Make the table and the figures of all configurations, over the mean of scenes and on each scene."""
    names, scenes = sorted(chapter.finished.runs.scene.unique()), basis(chapter)
    by_scenes = [_frontier(chapter, scenes)] + [_frontier(chapter, [name]) for name in names if [name] != scenes]
    table = pd.concat(by_scenes, ignore_index=True)
    if table.empty:
        return None
    drawn = pd.concat([table.assign(kind="mean"), *_single_runs(chapter)], ignore_index=True)
    bests = [f"best {cost}" for cost in COSTS]
    drawn[bests] = drawn[bests] == True  # noqa: E712  # False where a row is no mean
    figures = tuple(
        Figure(f"PSNR against {title}", "frontier", drawn, {"x": cost, "title": title})
        for cost, title in COSTS.items()
        if drawn[cost].notna().any()
    )
    order = ["scene", "model", "variant", "seeds", "psnr_db", "psnr_db ±", "psnr_val_db", *COSTS, "dominated"]
    text = (
        "A point is the mean over seeds; its interval is over seeds, on these scenes and views. The line of a model "
        "joins its filled points, which no cheaper configuration of the model reaches. Small points are single runs. "
        "Dominated: another mean has at least the PSNR in at most the seconds, which may be chance; “Is it a "
        "difference?” tests pairs."
    )
    return Section("frontier", "What accuracy costs", text, table[order], figures=figures)


def _frontier(chapter: Results, scenes: list[str]) -> pd.DataFrame:
    """Return the points of some scenes, which of them are dominated, and which are on the frontier of their model."""
    table = points(chapter, scenes)
    name = scenes[0] if len(scenes) == 1 else f"mean of {len(scenes)} scenes"
    series = [line for _, line in table.groupby("series")]
    for cost in COSTS:
        table[f"best {cost}"] = pd.concat([stats.is_on_frontier(line, cost) for line in series] or [pd.Series()])
    return table.assign(scene=name, dominated=stats.is_dominated(table, "train_s"))


def _single_runs(chapter: Results) -> list[pd.DataFrame]:
    """Return the single runs as points, if there are several of a configuration and not too many for a figure."""
    runs = chapter.finished.runs
    several = runs.groupby(["scene", "series"]).variant.agg(["size", "nunique"])
    is_drawn = len(runs) <= MOST_SINGLE * runs.scene.nunique() and (several["size"] > several["nunique"]).any()
    names = ["scene", "series", "model", "variant", "psnr_db", *COSTS]
    return [runs[names].assign(kind="run", seeds="seed " + runs.seed.astype(str))] if is_drawn else []
