"""What time, view direction and AGR (the neural refinement of Gaussians) gain in PSNR, and what they cost."""

import pandas as pd

from gsbench.report import stats
from gsbench.report.frame import Results
from gsbench.report.section import Asked, Column, Figure, Section, section
from gsbench.report.sections.pairs import corrected, scope, verdict

FACTORS = ("time", "direction", "AGR")
HAS = ["effect_time", "effect_direction", "effect_refinement"]
PUBLISHED = ["3dgs", "4dgs", "6dgs", "7dgs_noagr", "7dgs"]  # preferred where two models have the same effects
NESTED = ["7dgs_nodir", "7dgs_nodir_agr"]  # 7dgs without direction; 4dgs differs from 7dgs in more
UNITS = {"psnr_db": ("dB", 2), "train_s": ("training s", 1), "frame_ms": ("ms a frame", 2), "model_mb": ("MB", 2)}


def asked(chapter: Results) -> Asked:
    """Return the effects and interactions to test, as weighted sums of models, for each quantity.

    Those named "nested" change if 7DGS without direction replaces 4DGS. `section` tests all of them, with Holm's
    correction for multiple comparisons.
    """
    cells, nested = models(chapter)
    sums = stats.factorial(cells, FACTORS)
    within = [
        (f"{name}, nested", weights)
        for name, weights in stats.factorial(nested, FACTORS)
        if any(model in NESTED for model, _ in weights)
    ]
    return [(quantity, name, weights) for quantity in UNITS for name, weights in sums + within]


def models(chapter: Results) -> tuple[dict[tuple[bool, ...], stats.Key], dict[tuple[bool, ...], stats.Key]]:
    """Return the model of each combination of effects; in the second dict, 7DGS without direction replaces 4DGS.

    Models whose Gaussians lack some effects are left out, and images that were rendered elsewhere.
    """
    runs = chapter.finished.runs
    runs = runs[~runs.rendered_elsewhere]
    ungated = runs[runs.main & ~runs.groupby(["model", "variant"]).on_demand.transform("any")]
    rank = {name: i for i, name in enumerate(PUBLISHED)}
    first = ungated.drop_duplicates(["model", "variant"]).sort_values("model")
    first = first.sort_values("model", key=lambda names: names.map(rank).fillna(len(rank)), kind="stable")
    keys = list(zip(first.model, first.variant, strict=True))
    has = [tuple(map(bool, row)) for row in first[HAS].to_numpy()]
    cells = dict(reversed(list(zip(has, keys, strict=True))))  # reversed: of several models, the first remains
    return cells, cells | {cell: key for cell, key in zip(has, keys, strict=True) if key[0] in NESTED}


@section(asked)
def effects(chapter: Results, tests: pd.DataFrame) -> Section | None:
    """Make the table of prices, with their intervals in dB, seconds, milliseconds and MB."""
    by_unit = {quantity: tests[tests.quantity == quantity].set_index("name") for quantity in UNITS}
    assert all(table.index.is_unique for table in by_unit.values())
    gains = by_unit["psnr_db"]
    is_of_several = gains.index.str.contains(" × |mean over")  # an interaction, or a mean over models
    gains = gains[(gains.scenes > 0) & ~(is_of_several & gains.index.str.endswith("nested"))]
    if gains.empty:
        return None
    table = pd.DataFrame({"effect": gains.index, "computed from": gains.weights.map(_words)})
    columns = {unit: Column(unit, digits, signed=True) for unit, digits in UNITS.values()}
    figures = []
    for quantity, (unit, _) in UNITS.items():
        priced = by_unit[quantity].loc[gains.index]
        priced = priced.assign(significant=[verdict(test) for test in priced.to_dict("records")])
        table[unit], table[f"{unit} ±"], table[f"{unit}: significant"] = (
            priced["mean"],
            priced["high"] - priced["mean"],
            priced.significant,
        )
        drawn = priced.drop(columns="weights").rename(columns={"mean": unit}).reset_index()
        if drawn[unit].notna().any():
            figures.append(Figure(f"in {unit}", "intervals", drawn, {"label": "name", "value": unit}))
    table["± over scenes"], table["scenes that gain"] = gains["± over scenes"], gains.gaining
    table["scenes that lose"] = [sum(mean < 0 for mean in means) for means in gains["by scene"]]
    text = (
        "The gain of an effect is the difference of two models with the same other effects; an interaction is the "
        "difference of two gains. Filled points are significant after Holm's correction for all comparisons of this "
        "report. “Nested” rows have 7dgs_nodir (7dgs without direction) in place of 4dgs, which also differs from "
        "7dgs_noagr in how it parametrises a Gaussian. “± over scenes”: half the interval for scenes like these."
    )
    notes = (scope(gains), corrected(gains, "dB"), *_absent(chapter))
    return Section(
        "effects", "The price of each effect", text, table.reset_index(drop=True), columns, tuple(figures), notes
    )


def _absent(chapter: Results) -> list[str]:
    """List which combinations of effects no model has, and which models are left out."""
    cells, nested = models(chapter)
    runs = chapter.finished.runs
    others = sorted(set(runs.model[runs.main]) - {model for model, _ in (*cells.values(), *nested.values())})
    notes = [f"{8 - len(cells)} of 8 combinations of effects were not run."] if len(cells) < 8 else []
    reason = "Left out, as another model has these effects or each Gaussian keeps what it needs"
    return [*notes, f"{reason}: {', '.join(others)}."] if others else notes


def _words(weights: stats.Weights) -> str:
    """Write a weighted sum of models, such as "7dgs − 7dgs_noagr"."""
    terms = sorted(weights.items(), key=lambda term: (-term[1], term[0][0]))
    words = " ".join(f"{'+' if weight > 0 else '−'} {model}" for (model, _), weight in terms).removeprefix("+ ")
    share = abs(terms[0][1])  # of all terms
    return words if share == 1 else f"{share:g} ({words})"
