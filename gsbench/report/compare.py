"""Compare models in pairs, and compute what each effect gains in dB and what it costs.

The effects are time, view direction and AGR (the neural refinement of Gaussians). The costs are training seconds,
milliseconds per frame and bytes.
"""

import itertools
import math
from dataclasses import dataclass

import numpy as np

from gsbench.report.configurations import Configuration, Group, Values, is_ablated
from gsbench.report.family import Family, Tested, Weights
from gsbench.report.intervals import Estimate

Cell = tuple[bool, bool, bool]  # whether a model has time, view direction and AGR (neural refinement)
FACTORS = ("time", "direction", "AGR")
MEAN = "mean over the others"
PRICES = ("psnr", "seconds", "ms", "mb")
PUBLISHED = ("3dgs", "4dgs", "6dgs", "7dgs_noagr", "7dgs")  # preferred if two models have the same effects
NESTED = ("7dgs_nodir", "7dgs_nodir_agr")  # 7dgs without direction; 4dgs differs from 7dgs in more


@dataclass(frozen=True)
class Pair:
    """The difference in PSNR between two models, both with the settings that most runs of the experiment share."""

    better: Configuration  # the one with the higher mean PSNR
    other: Configuration
    difference: Estimate  # dB
    improvement: float  # the probability that a run of `better` beats one of `other` on a view they share
    p_holm: float  # adjusted for all comparisons of the report; NaN if the spread over seeds is not known
    differs: bool  # whether the difference is significant


def paired(group: Group) -> list[Weights]:
    """Return the differences between models that `pairs` tests, as weighted sums of two models' results.

    All models have the settings that most runs share. An ablation (a model with one part changed) is compared with the
    full models, but not with other ablations.
    """
    every = itertools.combinations(group.compared, 2)
    return [[(1.0, a), (-1.0, b)] for a, b in every if not (is_ablated(a.variant) and is_ablated(b.variant))]


def pairs(group: Group, family: Family) -> list[Pair]:
    """Compare every two models on the scenes that both have finished; pairs with the largest difference come first.

    Args:
        group: the run records of one experiment.
        family: the adjusted p-values of all comparisons in the report, including those from `paired`.
    """
    found = []
    for (_, a), (_, b) in paired(group):
        tested = family.of([(1.0, a), (-1.0, b)])
        if tested.difference.scenes == 0:
            continue
        if tested.difference.mean < 0:
            a, b = b, a
            tested = family.of([(1.0, a), (-1.0, b)])
        found.append(Pair(a, b, tested.difference, improvement(group, a, b), tested.p, tested.told))
    return sorted(found, key=lambda pair: -pair.difference.mean)


def improvement(group: Group, a: Configuration, b: Configuration) -> float:
    """Return the probability that a run of `a` has a higher PSNR than a run of `b` on the same view of the same scene.

    Every run of `a` is compared with every run of `b`. Equal values count one half, and all scenes have the same
    weight. This is the probability of improvement of Agarwal et al. 2021 (arXiv 2108.13264), computed for each view.
    The result is NaN if `a` and `b` share no view.
    """
    shares = []
    for scene in sorted(set(a.runs) & set(b.runs)):
        mine, theirs = _views(group, a, scene), _views(group, b, scene)
        common = sorted(set(mine) & set(theirs))
        ahead = [np.sign(mine[v][:, None] - theirs[v][None]).mean() / 2 + 0.5 for v in common]
        if ahead:
            shares.append(np.mean(ahead))
    return float(np.mean(shares)) if shares else math.nan


def _views(group: Group, configuration: Configuration, scene: str) -> dict[str, Values]:
    """Return for each view of a scene the PSNR of a model with every seed, without views that a seed lacks."""
    runs = [group.scores(r, "psnr") for r in configuration.runs[scene]]
    common = set.intersection(*map(set, runs))
    return {view: np.array([scores[view] for scores in runs]) for view in common}


@dataclass(frozen=True)
class Price:
    """The gain of an effect (time, view direction or the network AGR) in PSNR, and its cost in time and memory.

    An interaction of effects is stored in the same way: it is the change of one effect's gain when another effect is
    added.
    """

    name: str
    order: int  # 1: an effect, 2 and 3: an interaction
    models: str  # the weighted sum of models from which it is computed, as text
    costs: dict[str, Estimate]  # by PRICES
    told: dict[str, bool]  # by PRICES: whether it is significant after adjustment for all comparisons


@dataclass(frozen=True)
class Cube:
    """Eight models, one for each combination of three effects, and what these effects gain and cost.

    The effects are time, view direction and AGR (neural refinement). Models that were not run are missing.
    """

    cells: dict[Cell, Configuration]
    prices: list[Price]
    nested: list[Price]  # the same with the models of NESTED, which share one parametrisation
    missing: list[str]  # combinations of effects for which no run has finished, as text
    left_out: list[str]  # models with the same effects as a model in `cells`
    on_demand: list[str]  # models whose Gaussians lack some effects, so they are not compared


def priced(group: Group) -> list[Weights]:
    """Return the weighted sums of models' results that give the gain of each effect and of each interaction.

    The effects are time, view direction and AGR (neural refinement). `cube` tests each of these sums in PSNR, training
    seconds, milliseconds per frame and MB.
    """
    cells, own, _ = _filled(group)
    return [_sum(of, weights) for _, weights in _contrasts() for of in (cells, own) if weights.keys() <= of.keys()]


def cube(group: Group, family: Family) -> Cube:
    """Compute what time, view direction and AGR gain and cost, from the eight models with and without them.

    AGR is the neural refinement of Gaussians. The gain of an effect is the difference of two models that differ only in
    this effect. It is computed with each of the other two effects on or off, which gives 12 differences. The
    interaction of two effects is the difference of two such gains, which gives 6 interactions. The interaction of all
    three effects is the difference of two interactions. The mean gain of an effect over all on/off states of the other
    two effects needs all eight models.

    Args:
        group: the run records of one experiment.
        family: the adjusted p-values of all comparisons in the report, including those from `priced`.
    """
    cells, own, left_out = _filled(group)
    every: list[Cell] = list(itertools.product((False, True), (False, True), (False, True)))
    missing = [_words(cell) for cell in every if cell not in cells]
    prices = [price for weights in _contrasts() if (price := _price(family, cells, *weights))]
    nested = [
        price
        for name, weights in _contrasts()
        if is_single(name)
        and any(own.get(cell) is not cells.get(cell) for cell in weights)
        and (price := _price(family, own, name, weights))
    ]
    return Cube(cells, prices, nested, missing, left_out, [c.model for c in group.main_configurations if c.on_demand])


def _filled(group: Group) -> tuple[dict[Cell, Configuration], dict[Cell, Configuration], list[str]]:
    """Find the model that was run for each combination of time, view direction and AGR (neural refinement).

    Returns:
        Three values: the model of each combination; the same dictionary, in which 7dgs without view direction (NESTED)
        replaces other models with its combination; the names of models that are left out because another model has the
        same combination.
    """
    cells: dict[Cell, Configuration] = {}
    left_out = []
    rank = {name: i for i, name in enumerate(PUBLISHED)}
    whole = [c for c in group.main_configurations if not c.on_demand]
    for c in sorted(whole, key=lambda c: (rank.get(c.model, len(rank)), c.model)):
        if cells.setdefault(_cell(c), c) is not c and c.model not in NESTED:
            left_out.append(c.model)
    return cells, cells | {_cell(c): c for c in whole if c.model in NESTED}, left_out


def is_single(name: str) -> bool:
    """Tell whether a gain is that of time, direction or AGR alone, not an interaction or a mean over models."""
    return " × " not in name and MEAN not in name


def _cell(configuration: Configuration) -> Cell:
    effects = next(iter(configuration.runs.values()))[0].effects
    return effects.time, effects.direction, effects.refinement


def _words(cell: Cell) -> str:
    """Name a combination of the effects time, direction and AGR (neural refinement), such as "time + AGR"."""
    on = [name for name, has in zip(FACTORS, cell, strict=True) if has]
    return " + ".join(on) or "no effect"


def _contrasts() -> list[tuple[str, dict[Cell, float]]]:
    """Return the name of every effect and interaction, and the weighted sum of models' results that measures it.

    The effects are time, view direction and AGR (neural refinement). Single effects come before interactions.
    """
    found = []
    for size in (1, 2, 3):
        for varied in itertools.combinations(range(3), size):
            held = [i for i in range(3) if i not in varied]
            name = " × ".join(FACTORS[i] for i in varied)
            given = list(itertools.product((False, True), repeat=len(held)))
            each = [(_given(name, held, values), _weights(varied, held, [values], 1.0)) for values in given]
            found += each
            if size == 1:
                found.append((f"{name}, {MEAN}", _weights(varied, held, given, 1 / len(given))))
    return found


def _given(name: str, held: list[int], values: tuple[bool, ...]) -> str:
    """Name an effect together with the other effects that both compared models have, as in "direction, with time"."""
    on = [FACTORS[i] for i, value in zip(held, values, strict=True) if value]
    return f"{name}, with {' and '.join(on)}" if on else f"{name} alone" if len(held) == 2 else name


def _weights(
    varied: tuple[int, ...], held: list[int], given: list[tuple[bool, ...]], share: float
) -> dict[Cell, float]:
    """Return weights of models whose weighted sum of results is the gain of an effect or an interaction of effects.

    For the effect of time alone, the model with time has weight 1 and the model without any effect has weight -1.

    Args:
        varied: indices in FACTORS of the effects that are switched on and off.
        held: indices of the other effects.
        given: the on/off states of the other effects over which the sum runs.
        share: the absolute weight of each model.
    """
    weights = {}
    for values in given:
        for on in itertools.product((False, True), repeat=len(varied)):
            state = dict(zip((*varied, *held), (*on, *values), strict=True))
            weights[state[0], state[1], state[2]] = share * (-1.0) ** (len(varied) - sum(on))
    return weights


def _price(family: Family, cells: dict[Cell, Configuration], name: str, weights: dict[Cell, float]) -> Price | None:
    """Compute a weighted sum of models' results in dB, seconds, ms and MB.

    The result is None if a model was not run, or if the models share no scene.
    """
    if not weights.keys() <= cells.keys():
        return None
    sums = _sum(cells, weights)
    found: dict[str, Tested] = {unit: family.of(sums, unit) for unit in PRICES}
    if found["psnr"].difference.scenes == 0:
        return None
    sign = {True: "+", False: "−"}
    share = "" if abs(sums[0][0]) == 1 else f"{abs(sums[0][0]):g} ("
    terms = " ".join(f"{sign[w > 0]} {c.model}" for w, c in sums).removeprefix("+ ")
    costs = {unit: tested.difference for unit, tested in found.items()}
    told = {unit: tested.told for unit, tested in found.items()}
    return Price(name, name.count(" × ") + 1, f"{share}{terms}{')' if share else ''}", costs, told)


def _sum(cells: dict[Cell, Configuration], weights: dict[Cell, float]) -> Weights:
    """Return the models of a weighted sum with their weights, positive weights first."""
    return sorted(((w, cells[cell]) for cell, w in weights.items()), key=lambda term: (-term[0], term[1].model))
