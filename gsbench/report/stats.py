"""Estimate means and differences of runs: each function takes tables and returns a table (docs/statistics.md).

The intervals themselves are those of gsbench.report.intervals, which takes arrays [seeds, views], one for each scene.
"""

import itertools
from collections.abc import Callable, Sequence

import numpy as np
import pandas as pd
from scipy.special import stdtrit

from gsbench.report.frame import TIMES, Results
from gsbench.report.intervals import LEVEL, Estimate, Values, estimate, holm

Key = tuple[str, str]  # a model and its variant
Weights = dict[Key, float]  # a weighted sum of models: a difference of two models has the weights 1 and -1
Grids = dict[str, dict[Key, Values]]  # by scene and model: [seeds, views], NaN where it was not measured


def means(runs: pd.DataFrame, by: list[str], quantities: Sequence[str]) -> pd.DataFrame:
    """Average quantities over the seeds of each scene, then over scenes; "psnr_db ±" is half the 95 % interval.

    The interval is over seeds, for these scenes. A mean is NaN if a run lacks the quantity (a time of another machine
    is no lack), or if a scene has none.

    Args:
        runs: a row for each run, with the columns `by`, "scene", "seed" and `quantities`.
        by: the columns that name a group of runs, such as ["model", "variant"].
        quantities: the columns to average.
    """
    names = list(quantities)
    groups = runs.groupby([*by, "scene"])
    mean, variance, n = groups[names].mean(), groups[names].var(), groups[names].count()
    is_elsewhere = np.outer(~runs.is_timed, [name in TIMES for name in names])
    lacks = (runs[names].isna() & ~is_elsewhere).groupby([runs[key] for key in [*by, "scene"]]).any()
    mean = mean.mask(lacks | (n == 0))
    variance = (variance / n).mask(mean.isna() | (n < 2))  # of the mean of a scene
    total = variance.groupby(by).sum()
    freedom = total**2 / (variance**2 / (n - 1)).groupby(by).sum()  # Satterthwaite (1946)
    freedom = freedom.fillna((n - 1).groupby(by).sum())
    scenes = runs.groupby(by).scene.nunique()
    half = pd.DataFrame(stdtrit(freedom, (1 + LEVEL) / 2), freedom.index, names) * total**0.5
    half = half.div(scenes, axis=0)  # from the sum over scenes to the mean
    half = half.where(variance.notna().groupby(by).all())
    average = mean.groupby(by).mean().where(mean.notna().groupby(by).all())
    seeds = groups.seed.nunique().groupby(by).min()
    return average.join(half.add_suffix(" ±")).assign(seeds=seeds, scenes=scenes).reset_index()


def grids(results: Results, quantity: str = "psnr_db") -> Grids:
    """Return a quantity of the finished runs as arrays, with the same seeds and views for all models of a scene.

    Differences of models are then those on the same view with the same seed. A missing run or view is NaN. PSNR has a
    column for each view, other quantities have one.
    """
    names = ["scene", "seed", "model", "variant"]
    runs = results.finished.runs
    runs = runs[np.isfinite(runs[quantity].astype(float))]
    if quantity == "psnr_db":
        table = results.views.merge(runs[names], left_on="run", right_index=True, validate="many_to_one")
    else:
        table = runs[[*names, quantity]].assign(view="")
    arrays: Grids = {}
    for scene, rows in table.groupby("scene"):
        wide = rows.pivot(index=["model", "variant", "seed"], columns="view", values=quantity)
        seeds = sorted(rows.seed.unique())
        arrays[scene] = {
            key: values.droplevel(["model", "variant"]).reindex(seeds).to_numpy(float)
            for key, values in wide.groupby(level=["model", "variant"])
        }
    return arrays


def contrast(arrays: Grids, weights: Weights) -> dict[str, Values]:
    """Return a weighted sum of models by scene as arrays [seeds, views], over the seeds and views that all have."""
    sums = {}
    for scene in sorted(arrays):
        if all(key in arrays[scene] for key in weights):
            total = np.sum([weight * arrays[scene][key] for key, weight in weights.items()], axis=0)
            total = total[~np.isnan(total).all(axis=1)]  # seeds
            total = total[:, ~np.isnan(total).any(axis=0)]  # views
            if total.size:
                sums[scene] = total
    return sums


def differences(arrays: Grids, asked: Sequence[Weights]) -> pd.DataFrame:
    """Return a row for each difference: mean, interval, p, and p after Holm's correction for all of them together.

    A difference that is asked twice, or with the opposite sign, counts as one comparison.
    """
    estimates = [estimate(list(contrast(arrays, weights).values())) for weights in asked]
    table = pd.DataFrame(map(row_of, estimates), columns=list(row_of(NOTHING)))
    keys = [min(_terms(weights, sign) for sign in (1, -1)) for weights in asked]  # equal for a - b and b - a
    distinct = table.p[~pd.Series(keys, table.index, dtype=object).duplicated()]
    adjusted = dict(zip([keys[i] for i in distinct.index], holm(distinct.tolist()), strict=True))
    table["p_holm"] = pd.Series([adjusted[key] for key in keys], table.index, dtype=float)
    return table.assign(significant=table.p_holm < 1 - LEVEL, comparisons=int(distinct.notna().sum()))


NOTHING = Estimate(np.nan, 0, 0, "")


def row_of(estimated: Estimate) -> dict[str, object]:
    """Return an estimate as a row of `differences`."""
    row = {name: getattr(estimated, name) for name in ("mean", "low", "high", "over", "scenes", "p")}
    return row | {"± over scenes": estimated.half_over_scenes, "gaining": estimated.gaining, "by scene": estimated.each}


def _terms(weights: Weights, sign: int) -> tuple[tuple[str, str, float], ...]:
    return tuple(sorted((*key, sign * weight) for key, weight in weights.items()))


def improvement(arrays: Grids, a: Key, b: Key) -> float:
    """Return the probability that a run of `a` has a higher PSNR than a run of `b` on the same view.

    Every run of `a` is compared with every run of `b`; equal values count one half, and all scenes have the same
    weight: the probability of improvement of Agarwal et al. 2021 (arXiv 2108.13264), for each view. NaN: no view is
    shared.
    """
    shares = []
    for scene in arrays.values():
        if a in scene and b in scene:
            first, second = (values[~np.isnan(values).all(axis=1)] for values in (scene[a], scene[b]))
            ahead = np.sign(first[:, None] - second[None]).mean(axis=(0, 1)) / 2 + 0.5  # [views]
            if np.isfinite(ahead).any():
                shares.append(np.nanmean(ahead))
    return float(np.mean(shares)) if shares else np.nan


def is_on_frontier(points: pd.DataFrame, cost: str) -> pd.Series:
    """Tell of each point whether its PSNR is higher than that of all cheaper points."""
    ordered = points.dropna(subset=[cost]).sort_values([cost, "psnr_db"], ascending=[True, False])
    before = ordered.psnr_db.cummax().shift(fill_value=-np.inf)
    return (ordered.psnr_db > before).reindex(points.index, fill_value=False)


def is_dominated(points: pd.DataFrame, cost: str) -> pd.Series:
    """Tell of each point whether another one is no worse in PSNR and in cost, and better in one of them."""
    q, c = points.psnr_db.to_numpy(), points[cost].to_numpy()
    as_good = (q[None] >= q[:, None]) & (c[None] <= c[:, None])  # [points, others]
    better = (q[None] > q[:, None]) | (c[None] < c[:, None])
    return pd.Series((as_good & better).any(axis=1), points.index)


def ranks(runs: pd.DataFrame, by: str, quantity: str, higher: bool, show: Callable[[float], str]) -> dict[str, int]:
    """Rank groups of runs: 1 for the best mean and those that do not differ from it, 2 for the next, else 0.

    Two means differ if the 95 % interval over seeds of their paired difference excludes zero; with one seed, if they
    differ as shown.

    Args:
        runs: a row for each run, with the columns `by`, "scene", "seed" and `quantity`.
        by: the column that names a group.
        quantity: the column to rank by; a group that lacks it in a run has rank 0.
        higher: whether higher values are better.
        show: formats a number as the table does.
    """
    is_whole = runs[quantity].notna().groupby(runs[by]).all()
    wide = runs.pivot(index=["scene", "seed"], columns=by, values=quantity)
    means = wide.groupby("scene").mean().mean()[is_whole[is_whole].index]
    rest = means.sort_values(ascending=not higher, kind="stable")
    places = dict.fromkeys(is_whole.index, 0)
    for place in (1, 2):
        if len(rest):
            best = rest.index[0]
            looks_equal = rest.map(show) == show(rest[best])
            ties = [key for key in rest.index if looks_equal[key] or _may_be_zero(wide[best] - wide[key])]
            places |= dict.fromkeys(ties, place)
            rest = rest.drop(ties)
    return places


def _may_be_zero(difference: pd.Series) -> bool:
    """Tell whether the 95 % interval over seeds of a paired difference, by scene and seed, contains zero."""
    scenes = [values.dropna().to_numpy()[:, None] for _, values in difference.groupby("scene")]
    gap = estimate(scenes, generalise=False) if all(map(len, scenes)) else NOTHING
    return abs(gap.mean) <= gap.half


def ranked_rows(table: pd.DataFrame) -> pd.DataFrame:
    """Add columns of ranks, 1 for the highest value of each row to two decimals, as they are shown."""
    rounded = table.round(2)
    return table.join(rounded.eq(rounded.max(axis=1), axis=0).astype(int).add_suffix(" rank"))


def factorial(cells: dict[tuple[bool, ...], Key], factors: Sequence[str]) -> list[tuple[str, Weights]]:
    """Return the name and the weights of every effect and interaction of `factors` whose models were all run.

    The gain of an effect is the difference of two models that differ only in it; an interaction is the difference of
    two such gains. Single effects come before interactions.

    Args:
        cells: the model of each combination of the factors, whether it has each of them.
        factors: their names.
    """
    sums = []
    for size in range(1, len(factors) + 1):
        for varied in itertools.combinations(range(len(factors)), size):
            held = [i for i in range(len(factors)) if i not in varied]
            name = " × ".join(factors[i] for i in varied)
            states = list(itertools.product((False, True), repeat=len(held)))
            asked = [(f"{name}{_beside(factors, held, state)}", [state]) for state in states]
            asked += [(f"{name}, mean over the others", states)] if size == 1 else []
            for title, averaged in asked:
                weights = {}
                for others, on in itertools.product(averaged, itertools.product((False, True), repeat=size)):
                    has = dict(zip((*varied, *held), (*on, *others), strict=True))  # by the number of the factor
                    cell = tuple(has[i] for i in range(len(factors)))
                    weights[cell] = (-1.0) ** (size - sum(on)) / len(averaged)  # each varied factor that is off: -1
                if weights.keys() <= cells.keys():
                    sums.append((title, {cells[cell]: weight for cell, weight in weights.items()}))
    return sums


def _beside(factors: Sequence[str], held: list[int], state: tuple[bool, ...]) -> str:
    """Name the other effects that both compared models have: ", with time"; " alone" of one effect without others."""
    on = [factors[i] for i, has in zip(held, state, strict=True) if has]
    return f", with {' and '.join(on)}" if on else " alone" if len(held) == len(factors) - 1 else ""
