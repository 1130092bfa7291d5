"""PSNR after trainings of several lengths, and after the length that `train.lengths` would keep on val."""

import pandas as pd

from gsbench.report import stats
from gsbench.report.frame import Results, without
from gsbench.report.section import Column, Section, section

FEWEST = 3  # lengths of a table


@section()
def lengths(chapter: Results, tests: pd.DataFrame) -> Section | None:
    """Make the table of models that differ in nothing but their lengths."""
    runs = chapter.finished.runs
    runs = runs[(runs.variant.map(lambda variant: without(variant, "iterations")) == "") & runs.iterations.notna()]
    table = by_length(runs)
    if len(table.columns) < FEWEST + 2 or table.empty:  # 2: "kept" and "tried"
        return None
    text = (
        "Each length is a training of its own. “kept”: the lengths are tried from the shortest until PSNR on val no "
        "longer rises, and the one before is kept, as `train.lengths` does. Mean over the seeds that have all lengths."
    )
    means = table.groupby(["scene", "model"]).mean().reset_index()
    columns = {name: Column(name, 2) for name in table} | {"tried": Column("iterations tried", 0)}
    ranks = stats.ranked_rows(means[[name for name in table if name not in ("kept", "tried")]]).filter(like=" rank")
    return Section("lengths", "How long to train", text, means.join(ranks), columns)


def by_length(runs: pd.DataFrame) -> pd.DataFrame:
    """Return PSNR of each scene, model and seed after each length, and after the length that val keeps ("kept").

    The column "tried" has the iterations of all trainings that `train.lengths` tries.
    """
    runs = runs.drop_duplicates(["scene", "model", "seed", "iterations"])
    wide = runs.pivot(index=["scene", "model", "seed"], columns="iterations", values=["psnr_db", "psnr_val_db"])
    if wide.empty:
        return pd.DataFrame()
    has_all = wide.notna().all(axis=1)
    psnr, val = wide.loc[has_all, "psnr_db"], wide.loc[has_all, "psnr_val_db"]
    # How many times PSNR on val rises from one length to the next, from the shortest on: the place of the kept length.
    rises = (val.diff(axis=1).iloc[:, 1:] > 0).cumprod(axis=1).sum(axis=1).astype(int)
    chosen_psnr = [psnr.iloc[i, rise] for i, rise in enumerate(rises)]
    tried = [sum(psnr.columns[: rise + 2]) for rise in rises]  # with the length after the kept one
    return psnr.rename(columns="{:,.0f}".format).rename_axis(columns=None).assign(kept=chosen_psnr, tried=tried)
