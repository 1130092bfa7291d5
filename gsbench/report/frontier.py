"""Compute Pareto frontiers of PSNR and cost, the best model within a budget, and the time to reach a PSNR."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean

import numpy as np

from gsbench.report import paper
from gsbench.report.configurations import Configuration, Group, Values, iterations
from gsbench.report.family import Family, Weights
from gsbench.report.intervals import Estimate, estimate
from gsbench.report.paper_protocol import has_images_of_paper

COSTS = ("seconds", "ms", "mb")
BUDGETS = (("seconds", 10.0), ("seconds", 60.0), ("seconds", 600.0), ("ms", 1000 / 60))  # answered in each report
STEPS = (2.0, 1.0, 0.5, 0.2, 0.1)  # dB between two targets
FEWEST_TARGETS = 3  # for one scene
WIDEST = 100.0  # dB from the lowest result, above which there is no target: more is no difference between models


@dataclass(frozen=True)
class FrontierPoint:
    """The mean cost and the mean PSNR of a model with certain settings, on one scene or averaged over scenes."""

    configuration: Configuration
    psnr: Estimate  # dB, the evaluated split; the interval is over seeds, on these scenes and views
    val: float  # PSNR on the validation views, dB; NaN if a run lacks it
    cost: dict[str, float]  # by COSTS; NaN where it is missing

    @property
    def series(self) -> str:
        """Return the name of the report's curve that has this point.

        The name is the model. If effects (time, view direction, the network AGR) were removed from its Gaussians, the
        name says so.
        """
        return self.configuration.series


def points(group: Group, scenes: list[str]) -> list[FrontierPoint]:
    """Return the mean cost and PSNR of every configuration (a model with its settings) that finished all `scenes`."""
    found = []
    for configuration in group.configurations:
        psnr = [group.sample(configuration, s, "psnr")[:, None] for s in scenes]
        if scenes and all(map(len, psnr)):
            cost = {name: _mean([group.sample(configuration, s, name) for s in scenes]) for name in COSTS}
            val = _mean([group.sample(configuration, s, "psnr_val") for s in scenes])
            found.append(FrontierPoint(configuration, estimate(psnr, generalise=False), val, cost))
    return found


def frontier(of: Sequence[FrontierPoint], cost: str) -> list[FrontierPoint]:
    """Return the points of the Pareto frontier: each has a higher PSNR than all cheaper points.

    Args:
        of: the points from which to select.
        cost: the cost to compare: "seconds" of training, "ms" per frame or "mb" of parameters.
    """
    best: list[FrontierPoint] = []
    for point in sorted(of, key=lambda p: (p.cost[cost], -p.psnr.mean)):
        if not math.isnan(point.cost[cost]) and (not best or point.psnr.mean > best[-1].psnr.mean):
            best.append(point)
    return best


def beaten(of: Sequence[FrontierPoint], cost: str) -> list[FrontierPoint]:
    """Return the dominated points: another point is no worse in mean PSNR and cost, and better in at least one."""
    known = [p for p in of if not math.isnan(p.cost[cost])]
    return [p for p in known if any(beats(q, p, cost) for q in known)]


def beats(q: FrontierPoint, p: FrontierPoint, cost: str) -> bool:
    """Tell whether point `q` dominates point `p`: it is no worse in mean PSNR and cost, and better in at least one."""
    as_good = q.psnr.mean >= p.psnr.mean and q.cost[cost] <= p.cost[cost]
    return as_good and (q.psnr.mean > p.psnr.mean or q.cost[cost] < p.cost[cost])


@dataclass(frozen=True)
class BudgetChoice:
    """The best model within a cost budget, and the other models to which it was compared on the evaluated views."""

    point: FrontierPoint
    on_val: bool  # whether it was chosen on validation views; otherwise on the evaluated views
    ahead: list[FrontierPoint]  # models that are significantly worse
    level: list[FrontierPoint]  # models that do not differ significantly
    behind: list[FrontierPoint]  # models that are significantly better
    unknown: list[FrontierPoint]  # models without a known spread over seeds

    @property
    def others(self) -> int:
        """Return the number of models to which the best one was compared."""
        return len(self.ahead) + len(self.level) + len(self.behind) + len(self.unknown)


def has_val(of: Sequence[FrontierPoint]) -> bool:
    """Tell whether the PSNR on the validation views is known for every model that is compared.

    If so, the best model can be chosen on these views, and its PSNR can be shown on other views.
    """
    return bool(of) and not any(math.isnan(p.val) for p in of)


def ranked(of: Sequence[FrontierPoint]) -> list[FrontierPoint]:
    """Sort points (models with their mean PSNR and cost) by falling PSNR on the validation views.

    If this PSNR is not known for all points, they are sorted by PSNR on the evaluated views.
    """
    on_val = has_val(of)
    return sorted(of, key=lambda p: -(p.val if on_val else p.psnr.mean))


def contest(of: Sequence[FrontierPoint], cost: str, budget: float) -> list[FrontierPoint]:
    """Return each model's best result among those that cost at most `budget`, sorted by falling PSNR."""
    best: dict[str, FrontierPoint] = {}
    for point in ranked(of):
        if point.cost[cost] <= budget:
            best.setdefault(point.series, point)
    return list(best.values())


def contested(of: Sequence[FrontierPoint]) -> list[Weights]:
    """Return the differences that `choose` tests: for each budget, the best model minus each other model."""
    contests = [contest(of, *budget) for budget in BUDGETS]
    return [[(1.0, found[0].configuration), (-1.0, other.configuration)] for found in contests for other in found[1:]]


def choose(of: Sequence[FrontierPoint], cost: str, budget: float, family: Family) -> BudgetChoice | None:
    """Choose the model with the best PSNR among those that cost at most `budget`; None if no model does.

    The chosen model is compared with the best result of each other model within the budget, paired by seed and view.

    Args:
        of: the points (models with their mean PSNR and cost) from which to choose.
        cost: the cost that the budget limits: "seconds" of training, "ms" per frame or "mb" of parameters.
        budget: the limit in seconds, milliseconds or MB.
        family: the adjusted p-values of all comparisons in the report, including those from `contested`.
    """
    found = contest(of, cost, budget)
    if not found:
        return None
    first, *others = found
    tested = [(p, family.of([(1.0, first.configuration), (-1.0, p.configuration)])) for p in others]
    return BudgetChoice(
        first,
        has_val(of),
        [p for p, t in tested if t.told and t.difference.mean > 0],
        [p for p, t in tested if t.known and not t.told],
        [p for p, t in tested if t.told and t.difference.mean < 0],
        [p for p, t in tested if not t.known],
    )


@dataclass(frozen=True)
class Target:
    """A PSNR on the validation views of a scene, and the training seconds that each model needs to reach it."""

    scene: str
    rule: str
    psnr: float  # dB
    seconds: dict[str, float]  # by model; infinite if the model never reaches the target


def targets(group: Group) -> list[Target]:
    """Return the PSNR targets of every scene, and the training seconds that each model needs to reach them.

    PSNR is measured on the validation views. A model's seconds are the least after which the mean curve of one of its
    configurations, which may train on after that, has the target. Nothing is interpolated between measurements.
    """
    found = []
    for scene in group.scenes:
        ends: list[float] = []  # PSNR on val of each configuration at its end
        reached: dict[str, list[tuple[float, float]]] = {}  # by model: PSNR on val, seconds
        for configuration in group.configurations:
            quality, cost = (group.sample(configuration, scene, name) for name in ("psnr_val", "seconds"))
            if len(quality) and len(cost):
                _, seconds, psnr = mean_curve(group, configuration, scene) or ([], [], [])
                end = float(quality.mean()), float(cost.mean())
                ends.append(end[0])
                reached.setdefault(configuration.series, []).extend([end, *zip(psnr, seconds, strict=True)])
        for rule, psnr_of_rule in _rules(group, scene, ends):
            needed = {m: min((s for p, s in at if p >= psnr_of_rule), default=math.inf) for m, at in reached.items()}
            found.append(Target(scene, rule, psnr_of_rule, needed))
    return found


def mean_curve(
    group: Group, configuration: Configuration, scene: str
) -> tuple[list[int], list[float], list[float]] | None:
    """Return iterations, mean seconds and mean PSNR over seeds, at the iterations that all seeds measured.

    The result is None if there is no such iteration, or if the seeds kept different lengths (`train.lengths`).
    """
    if len({iterations(r) for r in configuration.runs.get(scene, [])}) > 1:
        return None
    seeds = [
        {p.iteration: p for p in r.curve if p.psnr_val is not None}
        for r in configuration.runs.get(scene, [])
        if not math.isnan(group.value(r, "seconds"))
    ]
    steps = sorted(set.intersection(*map(set, seeds))) if seeds else []
    if not steps:
        return None
    seconds = [fmean(s[step].seconds for s in seeds) for step in steps]
    return steps, seconds, [fmean(s[step].psnr_val or 0.0 for s in seeds) for step in steps]


def _rules(group: Group, scene: str, reached: list[float]) -> list[tuple[str, float]]:
    """Return a scene's PSNR targets: round values between the lowest and highest result, and the paper's 7dgs value.

    The paper's value is no target for runs on other images than the paper's, such as images of another size.
    """
    if not reached:
        return []
    rules = [(f"{psnr:g} dB", psnr) for psnr in round_numbers(min(reached), max(reached))]
    comparable = all(has_images_of_paper(r) for r in group.finished if r.scene == scene)
    row = paper.paper_row(group.dataset, scene, "7dgs") if comparable else None
    return [*rules, *([("paper's 7dgs", row.psnr)] if row else [])]


def round_numbers(low: float, high: float) -> list[float]:
    """Return round PSNR values above `low` and up to `high`, as targets for training.

    The values are multiples of 2, 1, 0.5, 0.2 or 0.1 dB, namely of the largest of these steps that gives at least three
    values. If no step does, the multiples of 0.1 dB are returned. Round values favour no model, since none is a model's
    own PSNR.
    """
    found: list[float] = []
    high = min(high, low + WIDEST)
    for step in STEPS:
        found = [round(i * step, 1) for i in range(math.floor(low / step) + 1, math.floor(high / step) + 1)]
        if len(found) >= FEWEST_TARGETS:
            break
    return found


def profile(of: Sequence[Target]) -> dict[str, Values]:
    """Return for each model its sorted ratios of training time to the fastest model's time, one for each target.

    Only targets that some model reaches are used. The share of ratios up to a factor tau is the performance profile of
    Dolan and More (2002). A ratio is infinite if the model never reaches the target or has no run on its scene.
    """
    models = sorted({m for target in of for m in target.seconds})
    solved = [t for t in of if math.isfinite(min(t.seconds.values()))]
    ratios = {m: [_ratio(t.seconds.get(m, math.inf), min(t.seconds.values())) for t in solved] for m in models}
    return {m: np.sort(np.array(values)) for m, values in ratios.items()}


def _ratio(seconds: float, fastest: float) -> float:
    return 1.0 if seconds == fastest else seconds / fastest if fastest else math.inf


def _mean(scenes: list[Values]) -> float:
    """Average a quantity over the seeds of each scene, then over scenes; return NaN if a scene has no value."""
    return float(np.mean([s.mean() for s in scenes])) if all(map(len, scenes)) else math.nan
