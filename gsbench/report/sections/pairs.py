"""The difference in PSNR of every two models, and whether it is significant."""

import itertools

import pandas as pd

from gsbench.report import stats
from gsbench.report.frame import Results, is_ablated
from gsbench.report.section import Asked, Column, Figure, Section, section

MOST_DRAWN = 28  # pairs, as many as eight models have


def asked(chapter: Results) -> Asked:
    """Return the differences of every two compared models; ablations are compared with full models only."""
    runs = chapter.finished.runs
    keys = runs[runs.compared][["model", "variant"]].drop_duplicates().sort_values(["model", "variant"])
    pairs = itertools.combinations(keys.itertuples(index=False, name=None), 2)
    return [("psnr_db", "", {a: 1.0, b: -1.0}) for a, b in pairs if not (is_ablated(a[1]) and is_ablated(b[1]))]


@section(asked)
def pairs(chapter: Results, tests: pd.DataFrame) -> Section | None:
    """Make the table of all pairs, the largest difference first."""
    tests = tests[tests.scenes > 0]
    if tests.empty:
        return None
    main, arrays = set(chapter.runs.variant[chapter.runs.main]), stats.grids(chapter)
    rows = []
    for test in tests.to_dict("records"):
        better, other = test["weights"] if test["mean"] >= 0 else reversed(test["weights"])  # its keys, two models
        low, high = sorted((test["low"], test["high"])) if test["mean"] >= 0 else sorted((-test["low"], -test["high"]))
        name = " − ".join(f"{m}" if v in main else f"{m} ({v or 'default'})" for m, v in (better, other))
        ahead = 100 * stats.improvement(arrays, better, other)
        rows.append(
            {
                "pair": name,
                "dB": abs(test["mean"]),
                "low": low,
                "high": high,
                "ahead": ahead,
                "p_holm": test["p_holm"],
                "significant": verdict(test),
            }
        )
    table = pd.DataFrame(rows).sort_values("dB", ascending=False, kind="stable").reset_index(drop=True)
    text = (
        "The runs of two models are paired by scene, seed and view. Significant, with a filled point: p is below 5 % "
        "after Holm's correction for all comparisons of this report. The intervals are not corrected, so an interval "
        "without zero may still be chance. “Ahead”: the probability that a run of the first model has a higher PSNR "
        "than a run of the second on the same view."
    )
    notes = [scope(tests), corrected(tests)]
    if len(table) > MOST_DRAWN:
        notes.append(f"The figure has the {MOST_DRAWN} largest of {len(table)} differences.")
    figure = Figure("Difference in PSNR, dB", "intervals", table.head(MOST_DRAWN), {"label": "pair", "value": "dB"})
    return Section("pairs", "Is it a difference?", text, table, COLUMNS, (figure,), tuple(notes))


COLUMNS = {"dB": Column("dB", 2, signed=True), "ahead": Column("ahead on % of views", 0)}


def verdict(test: dict[str, object]) -> str:
    """Return whether a difference is significant; a single seed does not say."""
    return "unknown" if test["p_holm"] != test["p_holm"] else "yes" if test["significant"] else "no"


def corrected(tests: pd.DataFrame, unit: str = "") -> str:
    """Say for how many comparisons p-values are corrected."""
    count = tests.comparisons.iloc[0]
    return f"Corrected for {count} comparison{'s' if count != 1 else ''}{unit and f' in {unit}'}."


def scope(tests: pd.DataFrame) -> str:
    """Say how many scenes are compared, and whether the intervals hold for other scenes."""
    fewest = tests.sort_values("scenes", kind="stable").iloc[0]
    these = f"{fewest.scenes} scene{'s' if fewest.scenes > 1 else ''}"
    if fewest.over == "scenes":
        return f"{these}: the intervals are for scenes like these."
    return (
        f"{these}: the intervals are for other {fewest.over} of these scenes."
        if fewest.over
        else f"{these}, one seed: no intervals."
    )
