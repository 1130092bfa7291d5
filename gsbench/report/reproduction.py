"""Compare the runs in two folders, and judge for each model on a scene whether the second folder's runs are reproduced.

Runs are compared if their model, scene, data, training settings and evaluation settings are equal. Equal code with
equal seeds gives equal bits. If all runs of a model on a scene whose seed both folders have are bit-equal, quality and
size agree, and no statistics are needed.

Other code or another device rounds floating-point numbers differently, and different rounding changes the result of a
training as much as another seed does. Therefore the other runs of one model on one scene form two samples, one for each
folder. Student's t compares the two means, and Holm's method adjusts the p-values for all models and scenes.

A few seeds do not give a reliable variance. Therefore the variance of the compared runs is averaged with the variance
pooled over the models and scenes of an experiment, which counts as `POOLED_RUNS` runs (a moderated t: Smyth 2004). With
it, even one run in one folder can be compared with three runs in the other: the interval of the difference is then the
prediction interval, in which one more run of the other folder would lie.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import stdtr, stdtrit

from gsbench.config_roles import listed, training_differences
from gsbench.errors import printable
from gsbench.report.frame import Results, names_of
from gsbench.report.intervals import LEVEL, holm
from gsbench.report.section import Column, Section

ROW = ["experiment", "dataset", "scene", "model", "variant"]  # what two runs that are compared have in common
SIDES = ["new", "reference"]  # the two folders: that of the report, and that of --against
AGREES, DIFFERS, UNDECIDED = "agrees", "differs", "undecided"
# Settings of an evaluation.
MEASURING = ("eval_split", "quantise", "resolution", "background", "downscale", "resize", "images", "reduced")
TIMES = ["train_s", "frame_ms"]
SIZES = ["runs_new", "runs_reference"]  # of the two samples of a quantity
BITS = ["psnr_db", "gaussians", "model_mb"]  # equal if the trained Gaussians are bit-equal
POOLED_RUNS = 4  # degrees of freedom of the pooled variance, beside those of the row itself
SAME_LOAD = 0.5  # if the mean loads of two machines differ more, times are not compared
# Means whose difference is at most `equal` agree. A larger difference that is not significant agrees too, but only if
# its 95 % interval is no wider than ± `widest`; if one folder has a single run, the difference itself must be at most
# `widest`. If `relative`, both are fractions of the mean of the reference.
LIMITS = pd.DataFrame(
    {
        "psnr_db": ("PSNR, dB", 0.01, 1.0, False),
        "train_s": ("seconds, %", 0.25, 0.5, True),
        "frame_ms": ("ms a frame, %", 0.25, 0.5, True),
        "gaussians": ("Gaussians, %", 0.1, 0.25, True),
        "model_mb": ("MB, %", 0.1, 0.25, True),
    },
    index=["title", "equal", "widest", "relative"],
).T.astype({"equal": float, "widest": float, "relative": bool})
TITLES: dict[str, str] = LIMITS.pop("title").to_dict()
RULE = (
    "Rule: runs of a model on a scene are compared where training, data and measuring are equal; seconds and ms only "
    "of one machine with one load (within 0.5). PSNR, Gaussians and MB agree where every run is bit-equal with the "
    "reference run of its seed. A row also agrees where the means are within 0.01 dB, 25 % of seconds or ms, 10 % of "
    "Gaussians or MB. Otherwise it differs where p < 0.05 after Holm over all rows. Otherwise it agrees where the 95 % "
    "interval over seeds is no wider than ± 1 dB, 50 %, 25 %, or, if a folder has a single run, where the means are as "
    "near; else it is undecided. The spread over seeds is that of the row, averaged with that of all rows, which "
    "counts as four runs. The verdict of the whole is that of PSNR: it differs where one row does, and agrees where "
    "all rows do."
)


@dataclass(frozen=True)
class Reproduction:
    """The comparison of new runs with reference runs.

    `table` has a row for each quantity of a model on a scene: the columns ROW and "quantity", the means "new" and
    "reference", their "difference" with the interval "low" to "high", "p_holm", "bit_equal", the "verdict", and the
    "reason" why it is undecided. `seeds` has a row for each pair of finished runs with one seed, with "bit_equal".
    `unmatched` has a row for each model on a scene that only one folder has, with the "reason".
    """

    table: pd.DataFrame
    seeds: pd.DataFrame
    unmatched: pd.DataFrame

    def of(self, quantity: str, verdict: str | None = None) -> pd.DataFrame:
        """Return the rows of a quantity, or only those with a verdict."""
        rows = self.table[self.table.quantity == quantity]
        return rows if verdict is None else rows[rows.verdict == verdict]

    @property
    def verdict(self) -> str:
        """Return the verdict of the whole, which is that of PSNR."""
        verdicts = self.of("psnr_db").verdict
        if (verdicts == DIFFERS).any():
            return DIFFERS
        return AGREES if len(verdicts) and (verdicts == AGREES).all() else UNDECIDED


def compare(new: Results, reference: Results) -> Reproduction:
    """Compare new runs with reference runs for each model and scene that both have."""
    runs = pd.concat([_with_bits(new).assign(side="new"), _with_bits(reference).assign(side="reference")])
    rows: list[dict[str, Any]] = []
    seeds = [_shared_seeds(runs[:0], runs[:0]).astype({"bit_equal": bool})]  # columns, if no row follows
    unmatched: list[dict[str, Any]] = []
    for key, matching in runs.groupby(ROW):
        row = dict(zip(ROW, key, strict=True))
        if matching.side.nunique() == 1:
            unmatched.append(row | {"reason": _why_unmatched(matching, runs)})
            continue
        new_runs, reference_runs = (matching[(matching.side == side) & (matching.status == "ok")] for side in SIDES)
        reason = _incomparable(new_runs, reference_runs)
        times_reason = reason or _other_machine(new_runs, reference_runs)
        why = dict.fromkeys(LIMITS.index, reason) | dict.fromkeys(TIMES, times_reason)
        shared = _shared_seeds(new_runs, reference_runs)
        if not reason:
            seeds.append(shared)
        repeats = len(shared) > 0 and bool(shared.bit_equal.all())
        rows += [row | _samples(new_runs, reference_runs, name, why[name], repeats) for name in LIMITS.index]
    table = pd.DataFrame(rows, columns=[*ROW, *_samples(runs[:0], runs[:0], "psnr_db", "", False)])  # if no row too
    table = table.astype({"bit_equal": bool} | dict.fromkeys([*SIDES, "squares", "freedom", *SIZES], float))
    missing = pd.DataFrame(unmatched, columns=[*ROW, "reason"])
    return Reproduction(_judged(_differences(table)), pd.concat(seeds, ignore_index=True), missing)


def _with_bits(results: Results) -> pd.DataFrame:
    """Return the runs with the text `bits`, which is equal in two runs if their trained Gaussians are bit-equal.

    A record does not hold the Gaussians. A training that differs in one bit ends with another PSNR of every view.
    """
    views = results.views
    scores = (views.view + " " + views.psnr_db.map(repr)).groupby(views.run).agg("\n".join)
    ends = [f"{scores.get(run)} {values}" for run, *values in results.runs[BITS].itertuples(name=None)]
    return results.runs.assign(bits=pd.Series(ends, results.runs.index, dtype=object))


def _shared_seeds(new: pd.DataFrame, reference: pd.DataFrame) -> pd.DataFrame:
    """Return a row for each seed that both sets of finished runs have, with the column "bit_equal"."""
    names = [*ROW, "seed"]
    shared = new[[*names, "bits"]].merge(reference[[*names, "bits"]], on=names, validate="one_to_one")
    return shared[names].assign(bit_equal=shared.bits_x == shared.bits_y)


def _why_unmatched(unmatched: pd.DataFrame, runs: pd.DataFrame) -> str:
    """Return why runs of a model on a scene have no counterpart, by the nearest training that the other folder has."""
    first = unmatched.iloc[0]
    others = runs[(runs[ROW[:-1]] == first[ROW[:-1]]).all(axis=1) & (runs.side != first.side)]  # of any variant
    if first.side == "reference" or others.empty:  # what differs stands beside the new runs
        return f"only the {first.side} folder has it"
    smallest = min((other_settings(config, first.config) for config in others.config), key=len)
    return f"another training: {printable(listed(smallest)) or 'another variant'}"


def other_settings(there: dict[str, Any], here: dict[str, Any]) -> list[str]:
    """Describe the settings of two trainings that differ, except the seed."""
    return training_differences({**there, "seed": None}, {**here, "seed": None})


def _incomparable(new: pd.DataFrame, reference: pd.DataFrame) -> str:
    """Return the reason why two sets of finished runs cannot be compared at all, or "" if they can."""
    if new.empty or reference.empty:
        return f"no {'new' if new.empty else 'reference'} run finished"
    runs = pd.concat([reference, new])
    for config in runs.config:
        if differing := other_settings(runs.config.iloc[0], config):
            return f"another training: {printable(listed(differing))}"
    if runs.data_hash.nunique() > 1:
        return "other data"
    for name in (name for name in MEASURING if f"protocol_{name}" in runs):
        values = [None if value != value else value for value in runs[f"protocol_{name}"]]
        other = [value for value in values if value != values[0]]
        if other:
            return f"measured otherwise: {name} {printable(other[0])} instead of {printable(values[0])}"
    return ""


def _other_machine(new: pd.DataFrame, reference: pd.DataFrame) -> str:
    """Return the reason why the times of two sets of runs cannot be compared, or "" if they can."""
    machines = [sorted(set(runs.machine)) for runs in (new, reference)]
    if machines[0] != machines[1] or len(machines[0]) > 1:
        named = [printable("; ".join(names))[:200] for names in machines]
        return f"other machines: {named[0]} instead of {named[1]}"
    loads = new.load.mean(), reference.load.mean()
    if math.isnan(sum(loads)):
        return "the load of the machine is not known"
    if abs(loads[0] - loads[1]) > SAME_LOAD:
        return f"the machine had other work: load {loads[0]:.1f} instead of {loads[1]:.1f}"
    return ""


def _samples(new: pd.DataFrame, reference: pd.DataFrame, quantity: str, reason: str, repeats: bool) -> dict[str, Any]:
    """Return the two samples of a quantity: means, sizes, squared deviations ("squares") and degrees of freedom.

    Args:
        new: the finished new runs of a model on a scene.
        reference: the finished reference runs.
        quantity: a key of LIMITS.
        reason: why they cannot be compared; "" if they can.
        repeats: whether the runs of each seed of both are bit-equal. They count once.
    """
    samples = [runs[quantity].dropna() for runs in (new, reference)]
    if not reason and not all(map(len, samples)):
        reason = f"not measured in the {'new' if samples[0].empty else 'reference'} runs"
    bit_equal = repeats and not reason and quantity in BITS
    counted = samples[1:] if bit_equal else samples
    return {
        "quantity": quantity,
        "new": samples[0].mean(),
        "reference": samples[1].mean(),
        "runs_new": len(samples[0]),
        "runs_reference": len(samples[1]),
        "squares": float(sum(((x - x.mean()) ** 2).sum() for x in counted)),
        "freedom": sum(max(len(x) - 1, 0) for x in counted),
        "bit_equal": bit_equal,
        "reason": reason,
    }


def _differences(table: pd.DataFrame) -> pd.DataFrame:
    """Add the difference of the means, its interval, and p after Holm for each quantity (NaN: no spread is known).

    The variance over seeds is the mean of that of the row and of that pooled over the rows of its experiment, weighted
    by degrees of freedom; the pooled one has at most `POOLED_RUNS`, as models and scenes differ in spread.
    """
    table = table.join(LIMITS, on="quantity")
    table["unit"] = table.reference.abs().where(table.relative & (table.reference != 0), 1.0)  # of LIMITS
    is_compared = table.reason == ""
    squares = (table.squares / table.unit**2).where(is_compared, 0.0)
    freedom = table.freedom.where(is_compared, 0)
    pool = [table[name] for name in ("experiment", "dataset", "quantity")]
    pooled, pooled_freedom = squares.groupby(pool).transform("sum"), freedom.groupby(pool).transform("sum")
    weight = pooled_freedom.clip(upper=POOLED_RUNS)  # of the pooled variance, in degrees of freedom
    moderated = (weight * pooled / pooled_freedom.where(pooled_freedom > 0) + squares) / (weight + freedom)
    error = np.sqrt(moderated * (1 / table.runs_new + 1 / table.runs_reference)) * table.unit
    table["difference"] = (table.new - table.reference).where(is_compared).where(~table.bit_equal, 0.0)
    error = error.where(is_compared & ~table.bit_equal)
    half = stdtrit((weight + freedom).astype(float), (1 + LEVEL) / 2) * error
    p = 2 * stdtr((weight + freedom).astype(float), -(table.difference.abs() / error.where(error > 0)))
    p = p.where(error != 0, (table.difference == 0).astype(float))  # all seeds alike: 1 or 0
    table["low"], table["high"] = table.difference - half, table.difference + half
    table["p_holm"] = p.groupby(table.quantity).transform(lambda values: holm(values.tolist()))
    return table


def _judged(table: pd.DataFrame) -> pd.DataFrame:
    """Add the verdicts by RULE, and the reasons of those that are undecided."""
    size, half = table.difference.abs(), (table.high - table.low) / 2
    has_one = table[SIZES].min(axis=1) == 1
    is_wide = size.where(has_one, half) > table.widest * table.unit
    cases = [
        (table.reason != "", UNDECIDED, table.reason),
        (table.bit_equal | (size <= table.equal * table.unit), AGREES, ""),
        (table.p_holm.isna(), UNDECIDED, "one run of each model on both sides: no spread over seeds is known"),
        (table.p_holm < 1 - LEVEL, DIFFERS, ""),
        (is_wide, UNDECIDED, "the interval is too wide: more seeds are needed"),
    ]
    conditions = [condition.to_numpy(bool) for condition, _, _ in cases]
    table["verdict"] = np.select(conditions, [verdict for _, verdict, _ in cases], AGREES).astype(object)
    table["reason"] = np.select(conditions, [reason for _, _, reason in cases], "").astype(object)
    return table.drop(columns=["squares", "freedom", "equal", "widest", "relative", "unit"])


def in_shown_unit(table: pd.DataFrame) -> pd.Series:
    """Return the differences in the unit of TITLES: dB, or per cent of the reference."""
    return table.difference.where(
        table.quantity == "psnr_db", 100 * table.difference / table.reference.where(table.reference != 0)
    )


def summary(result: Reproduction) -> pd.DataFrame:
    """Count the verdicts of each quantity over models on scenes, and name the largest difference."""
    counts = pd.crosstab(result.table.quantity, result.table.verdict)
    counts = counts.reindex(index=list(TITLES), columns=[AGREES, DIFFERS, UNDECIDED], fill_value=0)
    table = counts.assign(**{"bit-equal": result.table.groupby("quantity").bit_equal.sum()}).fillna(0).astype(int)
    rows = result.table.assign(
        largest=in_shown_unit(result.table), on=names_of(result.table) + " on " + result.table.scene
    )
    largest = rows.sort_values("largest", key=abs).dropna(subset="largest").drop_duplicates("quantity", keep="last")
    return table.join(largest.set_index("quantity")[["largest", "on"]]).reset_index(names="quantity")


def reasons(result: Reproduction) -> pd.DataFrame:
    """Count for each reason the models on scenes that are undecided or not compared."""
    undecided = result.table[result.table.reason != ""].assign(quantities=lambda rows: rows.quantity.map(TITLES))
    rows = pd.concat([undecided, result.unmatched.assign(quantities="all")])
    rows = rows.assign(on=names_of(rows) + " on " + rows.scene)
    groups = rows.groupby("reason", sort=False)
    join = lambda values: ", ".join(dict.fromkeys(values))  # noqa: E731
    table = pd.DataFrame(
        {
            "quantities": groups.quantities.agg(join),
            "models on scenes": groups.on.nunique(),
            "which": groups.on.agg(join),
        }
    )
    return table.sort_values("models on scenes", ascending=False, kind="stable").reset_index()


def sections(result: Reproduction, reference: str) -> list[Section]:
    """Return the comparison with a reference folder: each model on a scene, what is undecided, and the summary."""
    psnr = result.of("psnr_db").set_index(ROW)
    table = psnr[[*SIDES, "difference", "verdict"]].assign(**{"difference ±": psnr.high - psnr.difference})
    for quantity in list(TITLES)[1:]:
        rows = result.of(quantity).set_index(ROW)
        table[quantity] = in_shown_unit(rows)
    differing = result.table[result.table.verdict == DIFFERS]
    table["differs in"] = differing.quantity.map(TITLES).groupby([differing[name] for name in ROW]).agg(", ".join)
    bits = result.seeds.groupby(ROW).bit_equal
    table["seeds"], table["bit-equal"] = bits.size(), bits.sum()
    table = table.fillna({"seeds": 0, "bit-equal": 0}).reset_index()
    table["model"] = names_of(table)
    named = [*(["dataset"] if table.dataset.nunique() > 1 else []), "scene", "model", "seeds", "bit-equal"]
    table = table[[*named, *SIDES, "difference", "difference ±", "verdict", *list(TITLES)[1:], "differs in"]]
    columns = {
        "difference": Column("dB", signed=True),
        "new": Column("new PSNR"),
        "reference": Column("reference PSNR"),
    }
    columns |= {name: Column(TITLES[name], 1, signed=True) for name in list(TITLES)[1:]}
    counts = summary(result).assign(quantity=list(TITLES.values()))
    titles = {"largest": Column("largest difference", 2, signed=True)}
    shown = [Section("against", f"Against {printable(reference)}", RULE, table, columns)]
    if len(why := reasons(result)):
        shown.append(Section("undecided", "What is undecided or not compared", "", why))
    return [*shown, Section("verdict", f"PSNR {result.verdict}, against {printable(reference)}", "", counts, titles)]


def content(result: Reproduction, new: Results, reference: Results) -> dict[str, Any]:
    """Return a comparison, and the runs of both folders that it compares, as plain values for JSON."""
    columns = [*ROW, "seed", "status", *LIMITS.index, "machine"]
    compared = result.table[ROW].drop_duplicates()
    sides = zip(SIDES, (new.runs, reference.runs), strict=True)
    runs = {side: runs[columns].merge(compared, validate="many_to_one") for side, runs in sides}
    tables = {"summary": summary(result), "rows": result.table, "seeds": result.seeds, "unmatched": result.unmatched}
    return {
        "verdict": result.verdict,
        "rule": RULE,
        **{name: table.to_dict("records") for name, table in tables.items()},
        "runs": {side: table.to_dict("records") for side, table in runs.items()},
    }
