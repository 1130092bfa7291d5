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
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import stdtr, stdtrit

from gsbench.config_roles import listed, training_differences
from gsbench.errors import printable
from gsbench.report.frame import Results
from gsbench.report.intervals import LEVEL, holm
from gsbench.report.section import Column, Section

ROW = ["experiment", "dataset", "scene", "model", "variant"]  # what two runs that are compared have in common
AGREES, DIFFERS, UNDECIDED = "agrees", "differs", "undecided"
MEASURING = ("eval_split", "quantise", "resolution", "background", "downscale", "resize")  # settings of an evaluation
TIMES = ["train_s", "frame_ms"]
RUNS = ["runs_ours", "runs_theirs"]  # the sizes of the two samples of a quantity
BITS = ["psnr_db", "gaussians", "model_mb"]  # equal if the trained Gaussians are bit-equal
POOLED_RUNS = 4  # degrees of freedom of the pooled variance, beside those of the row's own
SAME_LOAD = 0.5  # if the mean loads of two machines differ more, times are not compared
# Means whose difference is at most `equal` agree. A larger difference that is not significant agrees too, but only if
# its 95 % interval is no wider than ± `widest`; if one folder has a single run, the difference itself must be at most
# `widest`. If `relative`, both are fractions of the mean in the second folder.
LIMITS = pd.DataFrame(
    {"psnr_db": (0.01, 1.0, False), "train_s": (0.25, 0.5, True), "frame_ms": (0.25, 0.5, True),
     "gaussians": (0.1, 0.25, True), "model_mb": (0.1, 0.25, True)}, index=["equal", "widest", "relative"],
).T  # fmt: skip
TITLES = {"psnr_db": "PSNR", "gaussians": "Gaussians", "model_mb": "MB", "train_s": "seconds", "frame_ms": "ms a frame"}
RULE = (
    "Rule: runs of a model on a scene are compared where training, data and measuring are equal; seconds and ms only "
    "of one machine with one load (within 0.5). PSNR, Gaussians and MB agree where every run is bit-equal with the "
    "other folder's run of its seed. A row also agrees where the means are within 0.01 dB, 25 % of seconds or ms, 10 % "
    "of Gaussians or MB. Otherwise it differs where p < 0.05 after Holm over all rows. Otherwise it agrees where the "
    "95 % interval over seeds is no wider than ± 1 dB, 50 %, 25 %, or, if a folder has a single run, where the means "
    "are as near; else it is undecided. The spread over seeds is the row's own, averaged with that of all rows, which "
    "counts as four runs. The verdict of the whole is that of PSNR: it differs where one row does, and agrees where "
    "all rows do."
)
LONGEST = 100  # characters of a line
LONGEST_FOLDER = 40  # characters of a folder's name in a line
MOST_SEEDS = 3  # seeds that are named; more are counted


@dataclass(frozen=True)
class Reproduction:
    """The comparison of the runs in two folders; it also lists the models and scenes that only one folder has.

    `table` has a row for each quantity of a model on a scene: the columns ROW and "quantity", the means "ours" and
    "theirs", their "difference" with the interval "low" to "high", "p_holm", "bit_equal", the "verdict", and the
    "reason" why there is none. `seeds` has a row for each pair of finished runs with one seed, with "bit_equal".
    """

    ours: str  # the folder
    theirs: str
    table: pd.DataFrame
    seeds: pd.DataFrame
    only_ours: list[str]  # models on scenes that the other folder lacks
    only_theirs: list[str]
    otherwise: dict[str, list[str]]  # those of `only_ours` that the other folder trained otherwise, by the difference

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


def compare(ours: Results, theirs: Results, names: tuple[str, str]) -> Reproduction:
    """Compare the runs of two folders for each model and scene that both folders have.

    Args:
        ours: the tables of the first folder.
        theirs: the tables of the second folder.
        names: the names of the two folders, for messages.
    """
    here, there = (dict(iter(_with_bits(side).groupby(ROW))) for side in (ours, theirs))
    rows: list[dict[str, Any]] = []
    seeds: list[dict[str, Any]] = []
    for key in sorted(here.keys() & there.keys()):
        pair = [runs[runs.status == "ok"] for runs in (here[key], there[key])]
        row = dict(zip(ROW, key, strict=True))
        reason = _incomparable(*pair)
        bits = [runs.set_index("seed").bits for runs in pair]
        shared = [] if reason else sorted(set(bits[0].index) & set(bits[1].index))
        equal = [bool(bits[0][seed] == bits[1][seed]) for seed in shared]
        seeds += [row | {"seed": seed, "bit_equal": same} for seed, same in zip(shared, equal, strict=True)]
        late = reason or _other_machine(*pair)
        for quantity in LIMITS.index:
            why = late if quantity in TIMES else reason
            rows.append(row | _samples(pair[0], pair[1], quantity, why, bool(equal) and all(equal)))
    table = pd.DataFrame(rows, columns=[*ROW, *_samples(ours.runs[:0], theirs.runs[:0], "psnr_db", "", False)])
    table = table.astype({"bit_equal": bool} | dict.fromkeys(["ours", "theirs", "squares", "freedom", *RUNS], float))
    pairs = pd.DataFrame(seeds, columns=[*ROW, "seed", "bit_equal"]).astype({"bit_equal": bool})
    only_ours, only_theirs = (
        [_name(key) for key in sorted(keys)] for keys in (here.keys() - there, there.keys() - here)
    )
    judged = _judged(_differences(table))
    return Reproduction(names[0], names[1], judged, pairs, only_ours, only_theirs, _otherwise(here, there))


Runs = dict[tuple[str, ...], pd.DataFrame]  # by ROW


def _with_bits(results: Results) -> pd.DataFrame:
    """Return the runs with the column `bits`, which is equal in two runs if their trained Gaussians are bit-equal.

    A record does not hold the Gaussians. A training that differs in one bit ends with another PSNR of every view.
    """
    views = results.views.fillna({"psnr_db": math.inf})
    scores = {run: tuple(zip(of.view, of.psnr_db, strict=True)) for run, of in views.groupby("run")}
    bits = [(scores.get(run), *values) for run, *values in results.runs[BITS].itertuples(name=None)]
    return results.runs.assign(bits=pd.Series(bits, results.runs.index, dtype=object))


def _name(key: tuple[str, ...]) -> str:
    _, _, scene, model, variant = key
    return f"{model} {variant}".rstrip() + f" on {scene}"


def _otherwise(ours: Runs, theirs: Runs) -> dict[str, list[str]]:
    """List the models on scenes that the second folder has with other settings, by the smallest difference in these."""
    named: dict[str, list[str]] = {}
    for key in sorted(ours.keys() - theirs.keys()):
        config = ours[key].config.iloc[0]
        others = [runs.config.iloc[0] for other, runs in theirs.items() if other[:4] == key[:4]]
        if others:
            smallest = min((_differing(other, config) for other in others), key=len)
            named.setdefault(printable(listed(smallest)) or "another variant", []).append(_name(key))
    return named


def _differing(there: dict[str, Any], here: dict[str, Any]) -> list[str]:
    """Describe the settings of two trainings that differ, except the seed."""
    return training_differences({**there, "seed": None}, {**here, "seed": None})


def _incomparable(ours: pd.DataFrame, theirs: pd.DataFrame) -> str:
    """Return the reason why two sets of finished runs cannot be compared at all, or "" if they can."""
    if ours.empty or theirs.empty:
        return f"no run finished {'here' if ours.empty else 'there'}"
    runs = pd.concat([theirs, ours])
    for config in runs.config:
        if differing := _differing(runs.config.iloc[0], config):
            return f"another training: {printable(listed(differing))}"
    if runs.data_hash.nunique() > 1:
        return "other data"
    for name in (name for name in MEASURING if f"protocol_{name}" in runs):
        values = [None if value != value else value for value in runs[f"protocol_{name}"]]
        other = [value for value in values if value != values[0]]
        if other:
            return f"measured otherwise: {name} {printable(values[0])} there, {printable(other[0])}"
    return ""


def _other_machine(ours: pd.DataFrame, theirs: pd.DataFrame) -> str:
    """Return the reason why the times of two sets of runs cannot be compared, or "" if they can."""
    here, there = set(ours.machine), set(theirs.machine)
    if here != there or len(here) > 1:
        named = [printable("; ".join(sorted(machines)))[:200] for machines in (here, there)]
        return f"other machines: {named[0]} here, {named[1]} there"
    loads = ours.load.mean(), theirs.load.mean()
    if math.isnan(sum(loads)):
        return "the load of the machine is not known"
    if abs(loads[0] - loads[1]) > SAME_LOAD:
        return f"the machine had other work: load {loads[0]:.1f} here, {loads[1]:.1f} there"
    return ""


def _samples(ours: pd.DataFrame, theirs: pd.DataFrame, quantity: str, reason: str, repeats: bool) -> dict[str, Any]:
    """Return the two samples of a quantity as their means, sizes, squares and degrees of freedom.

    Args:
        ours: the finished runs of a model on a scene in the first folder.
        theirs: those in the second folder.
        quantity: a key of LIMITS.
        reason: why they cannot be compared; "" if they can.
        repeats: whether all runs with one seed are bit-equal. They count once.
    """
    samples = [runs[quantity].dropna() for runs in (ours, theirs)]
    if not reason and not all(map(len, samples)):
        reason = f"{'here' if samples[0].empty else 'there'} it was not measured"
    bit_equal = repeats and not reason and quantity in BITS
    counted = samples[1:] if bit_equal else samples
    return {
        "quantity": quantity, "ours": samples[0].mean(), "theirs": samples[1].mean(),
        "runs_ours": len(samples[0]), "runs_theirs": len(samples[1]),
        "squares": float(sum(((x - x.mean()) ** 2).sum() for x in counted)),
        "freedom": sum(max(len(x) - 1, 0) for x in counted), "bit_equal": bit_equal, "reason": reason,
    }  # fmt: skip


def _differences(table: pd.DataFrame) -> pd.DataFrame:
    """Add the difference of the means, its interval, and p after Holm for each quantity (NaN: no spread is known).

    The variance over seeds is the mean of that of the row and of that pooled over the rows of its experiment, weighted
    by degrees of freedom; the pooled one has at most `POOLED_RUNS`, as models and scenes differ in spread.
    """
    table = table.join(LIMITS.astype({"equal": float, "widest": float, "relative": bool}), on="quantity")
    table["unit"] = table.theirs.abs().where(table.relative & (table.theirs != 0), 1.0)
    is_compared = table.reason == ""
    squares = (table.squares / table.unit**2).where(is_compared, 0.0)
    freedom = table.freedom.where(is_compared, 0)
    pool = [table[name] for name in ("experiment", "dataset", "quantity")]
    pooled, known = squares.groupby(pool).transform("sum"), freedom.groupby(pool).transform("sum")
    shared = known.clip(upper=POOLED_RUNS)
    moderated = (shared * pooled / known.where(known > 0) + squares) / (shared + freedom)
    error = np.sqrt(moderated * (1 / table.runs_ours + 1 / table.runs_theirs)) * table.unit
    table["difference"] = (table.ours - table.theirs).where(is_compared).where(~table.bit_equal, 0.0)
    error = error.where(is_compared & ~table.bit_equal)
    half = stdtrit((shared + freedom).astype(float), (1 + LEVEL) / 2) * error
    p = 2 * stdtr((shared + freedom).astype(float), -(table.difference.abs() / error.where(error > 0)))
    p = p.where(error != 0, (table.difference == 0).astype(float))
    table["low"], table["high"] = table.difference - half, table.difference + half
    table["p_holm"] = p.groupby(table.quantity).transform(lambda of: holm(of.tolist()))
    return table


def _judged(table: pd.DataFrame) -> pd.DataFrame:
    """Add the verdicts by RULE, and the reasons of those that are undecided."""
    size, half = table.difference.abs(), (table.high - table.low) / 2
    has_one = table[RUNS].min(axis=1) == 1
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


def section(of: Reproduction) -> Section:
    """Return the comparison as a table with a row for each model on a scene."""
    values = ["ours", "theirs", "difference", "high", "verdict"]
    wide = of.table.pivot(index=ROW, columns="quantity", values=values)
    wide = wide.reindex(columns=pd.MultiIndex.from_product([values, LIMITS.index], names=[None, "quantity"]))
    psnr = wide.xs("psnr_db", axis=1, level="quantity")
    models = [f"{model} {variant}".rstrip() for *_, model, variant in wide.index]
    several = wide.index.droplevel(["scene", "model", "variant"]).nunique() > 1
    table = pd.DataFrame({"dataset": wide.index.get_level_values("dataset")}) if several else pd.DataFrame()
    table["scene"], table["model"] = wide.index.get_level_values("scene"), models
    counts = of.seeds.groupby(ROW).bit_equal.agg(["sum", "count"]).reindex(wide.index, fill_value=0)
    table["bit-equal"] = [f"{equal} of {shared}" for equal, shared in counts.itertuples(index=False)]
    for name in ("ours", "theirs", "difference"):
        table[name] = psnr[name].to_numpy(float)
    table["difference ±"] = (psnr.high - psnr.difference).to_numpy(float)
    table["verdict"] = psnr.verdict.to_numpy()
    columns = {"ours": Column("here"), "theirs": Column("there"), "difference": Column("dB", signed=True)}
    for quantity, name in list(TITLES.items())[1:]:
        means = wide.xs(quantity, axis=1, level="quantity")
        table[quantity] = (100 * means.difference.astype(float) / means.theirs.astype(float)).to_numpy()
        columns[quantity] = Column(f"{name} %", 1, signed=True)
    differing = of.table[of.table.verdict == DIFFERS].groupby(ROW).quantity.agg(list).reindex(wide.index)
    table["differs in"] = [", ".join(TITLES[name] for name in names) if names == names else "" for names in differing]
    notes = _reasons(of)
    for why, names in of.otherwise.items():
        notes.append(f"trained otherwise than in {of.theirs}, so not compared: {why} ({len(names)} models on scenes)")
    for folder, names in ((of.ours, of.only_ours), (of.theirs, of.only_theirs)):
        notes += [f"only in {folder}: {_listed(names)}"] if names else []
    title = f"Against {of.theirs}"
    return Section("reproduction", title, RULE, table, columns, notes=tuple(notes))


def _listed(names: list[str]) -> str:
    return printable(", ".join(names[:10])) + (f" and {len(names) - 10} more" if len(names) > 10 else "")


def _reasons(of: Reproduction) -> list[str]:
    """List the reasons why quantities are undecided; all models with the same reason share one line."""
    rows = of.table[of.table.reason != ""]
    lines = []
    for reason, same in rows.groupby("reason", sort=False):
        quantities = ", ".join(TITLES[name] for name in same.quantity.unique())
        names = sorted({f"{model} on {scene}" for model, scene in zip(same.model, same.scene, strict=True)})
        every = len(same[ROW].drop_duplicates()) == len(of.table[ROW].drop_duplicates())
        lines.append(f"{quantities}{'' if every else f' of {_listed(names)}'} undecided: {reason}")
    return lines


def lines(of: Reproduction, runs: pd.DataFrame, page: Path) -> list[str]:
    """Return what was trained, whether it agrees with the other folder, and where the report is: six lines at most.

    Args:
        of: the comparison of `runs` with another folder.
        runs: all runs of the first folder, at least one.
        page: the path of the HTML report, which is the only line that may be long.
    """
    return [_short(trained(runs)), *compared(of), f"Report: {printable(page)}"]


def trained(runs: pd.DataFrame) -> str:
    """Return how many runs of which models, scenes, seeds and lengths there are, and how long they trained in all."""
    finished = runs[runs.status == "ok"]
    possible = sum(len(of[["model", "variant"]].drop_duplicates()) * of.scene.nunique() * of.seed.nunique()
                   for _, of in runs.groupby(["experiment", "dataset"]))  # fmt: skip
    seeds, lengths = sorted(set(runs.seed)), sorted(set(runs.iterations.dropna().astype(int)))
    scenes = len(runs[["dataset", "scene"]].drop_duplicates())
    least = f"{lengths[0]:,} to " if len(lengths) > 1 else ""
    named = f"seed{'s' * (len(seeds) > 1)} {', '.join(map(str, seeds))}"
    parts = [
        f"{_count(runs.model.nunique(), 'model')} on {_count(scenes, 'scene')}",
        named if len(seeds) <= MOST_SEEDS else _count(len(seeds), "seed"),
        f"{least}{_count(lengths[-1], 'iteration')}" if lengths else "",
        f"{len(runs) - len(finished)} failed" if len(finished) < len(runs) else "",
        f"{duration(finished.train_s.sum())} of training in all",
    ]
    combinations = f" of {possible:,} combinations" if len(runs) < possible else ""
    return f"{_count(len(runs), 'run')}{combinations}: {', '.join(filter(None, parts))}"


def compared(of: Reproduction) -> list[str]:
    """Return whether the runs agree with those of the other folder, in at most four lines without full stops."""
    texts = [_bits(of), _psnr(of)] if len(of.table) else []
    if of.otherwise:
        differing = {difference: len(names) for difference, names in of.otherwise.items()}
        texts.append(f"Cannot be compared: {_most(differing)}")
    reasons = Counter(of.of("psnr_db", UNDECIDED).reason)
    notes = [f"undecided: {_most(reasons)}"] if reasons else []
    for quantity, title in list(TITLES.items())[1:]:
        notes += [f"{title} differ in {n}"] if (n := len(of.of(quantity, DIFFERS))) else []
    text = "; ".join(notes)
    texts += [text[:1].upper() + text[1:]] if text else []
    return [_short(line) for line in texts or [f"Cannot be compared: no model and scene is also in {_folder(of)}"]]


def _bits(of: Reproduction) -> str:
    """Return how many of the runs whose seed both folders have are bit-equal."""
    if of.seeds.empty:
        return f"Bit-equal: no run has the seed of one in {_folder(of)}"
    equal = int(of.seeds.bit_equal.sum())
    return f"Bit-equal with the run of the same seed in {_folder(of)}: {equal} of {_count(len(of.seeds), 'run')}"


def _psnr(of: Reproduction) -> str:
    """Return in how many models and scenes PSNR agrees or differs, and where the difference is largest."""
    rows = of.of("psnr_db")
    agree, differ = int((rows.verdict == AGREES).sum()), int((rows.verdict == DIFFERS).sum())
    pairs = "1 model on a scene" if len(rows) == 1 else f"{len(rows)} models on scenes"
    text = f"PSNR differs in {differ} of {pairs}, agrees in {agree}" if differ else f"PSNR agrees in {agree} of {pairs}"
    if rows.difference.isna().all():
        return text
    largest = rows.loc[rows.difference.abs().idxmax()]
    if round(largest.difference, 2) == 0:
        return f"{text}; largest difference 0.00 dB"
    name = printable(f"{largest.model} {largest.variant}".rstrip() + f" on {largest.scene}")
    return f"{text}; largest difference {largest.difference:+.2f} dB, {name}"


def _most(reasons: Mapping[str, int]) -> str:
    """Return the most frequent reason, and how many models on scenes have it or another one."""
    reason = max(reasons, key=lambda text: reasons[text])
    others = sum(reasons.values()) - reasons[reason]
    return f"{reason} (in {reasons[reason]}{f', others in {others}' if others else ''})"


def _folder(of: Reproduction) -> str:
    name, half = printable(of.theirs), LONGEST_FOLDER // 2
    return name if len(name) <= LONGEST_FOLDER else f"{name[: half - 1]}…{name[-half:]}"


def _short(line: str) -> str:
    return line if len(line) <= LONGEST else f"{line[: LONGEST - 1]}…"


def _count(number: int, what: str) -> str:
    return f"{number:,} {what}{'' if number == 1 else 's'}"


def duration(seconds: float) -> str:
    """Format a time, such as "8.3 s" or "2.5 h"."""
    if seconds < 100:
        return f"{seconds:.1f} s"
    return f"{seconds / 60:.1f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def content(of: Reproduction, ours: pd.DataFrame, theirs: pd.DataFrame) -> dict[str, Any]:
    """Return a comparison, and the runs of both folders that it compares, as plain values for JSON."""
    columns = [*ROW, "seed", "status", *LIMITS.index, "machine"]
    both = of.table[ROW].drop_duplicates()
    sides = {
        name: runs[columns].merge(both, validate="many_to_one") for name, runs in (("ours", ours), ("theirs", theirs))
    }
    return {
        "ours": of.ours, "theirs": of.theirs, "verdict": of.verdict, "lines": compared(of), "rule": RULE,
        "rows": of.table.to_dict("records"), "seeds": of.seeds.to_dict("records"),
        "runs": {name: runs.to_dict("records") for name, runs in sides.items()},
        "only_ours": of.only_ours, "only_theirs": of.only_theirs, "otherwise": of.otherwise,
    }  # fmt: skip
