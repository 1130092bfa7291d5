"""Find the frontier of a model over lengths and capacities, what a budget buys, and the time to a quality."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gsbench.report import paper
from gsbench.report.arms import Arm, Group, Values
from gsbench.report.intervals import Estimate, estimate

COSTS = ("seconds", "ms", "mb")
BASELINE = "3dgs"


@dataclass(frozen=True)
class Point:
    """An arm on a scene, or on the mean of scenes: what it costs and what it reaches."""

    arm: Arm
    psnr: Estimate  # dB; the interval is of seeds, on these scenes and views
    cost: dict[str, float]  # by COSTS; NaN where it is missing

    @property
    def series(self) -> str:
        """The frontier that the point belongs to: that of a model, or of a gated one."""
        return self.arm.series


def points(group: Group, scenes: list[str]) -> list[Point]:
    """Return a point for every arm that has finished all of `scenes`, averaged over them."""
    found = []
    for arm in group.arms:
        psnr = [group.sample(arm, s, "psnr")[:, None] for s in scenes]
        if scenes and all(map(len, psnr)):
            cost = {name: _mean([group.sample(arm, s, name) for s in scenes]) for name in COSTS}
            found.append(Point(arm, estimate(psnr, generalise=False), cost))
    return found


def frontier(of: Sequence[Point], cost: str) -> list[Point]:
    """Return the points that no cheaper one equals, by rising cost: each reaches more than all before it."""
    best: list[Point] = []
    for point in sorted(of, key=lambda p: (p.cost[cost], -p.psnr.mean)):
        if not math.isnan(point.cost[cost]) and (not best or point.psnr.mean > best[-1].psnr.mean):
            best.append(point)
    return best


def dominated(of: Sequence[Point], cost: str) -> list[Point]:
    """Return the points beside which another is at least as good and as cheap, and better in one of the two."""
    known = [p for p in of if not math.isnan(p.cost[cost])]
    return [p for p in known if any(dominates(q, p, cost) for q in known)]


def dominates(q: Point, p: Point, cost: str) -> bool:
    """Tell whether `q` is at least as good and as cheap as `p`, and better in one of the two."""
    as_good = q.psnr.mean >= p.psnr.mean and q.cost[cost] <= p.cost[cost]
    return as_good and (q.psnr.mean > p.psnr.mean or q.cost[cost] < p.cost[cost])


@dataclass(frozen=True)
class Choice:
    """The best point within a budget, and which other models it cannot be told from."""

    point: Point
    level: list[Point]  # the best of other models within the budget, where the interval of the difference holds zero
    unknown: bool  # whether no spread is known of the difference to the best of another model


def choose(group: Group, of: Sequence[Point], cost: str, budget: float) -> Choice | None:
    """Choose the highest PSNR among the points that cost at most `budget`; None where there is none.

    The best point of each other model within the budget is compared with it, paired over seeds and views.
    """
    best: dict[str, Point] = {}
    for point in of:
        if point.cost[cost] <= budget and point.psnr.mean > best.get(point.series, _NOTHING).psnr.mean:
            best[point.series] = point
    if not best:
        return None
    first, *others = sorted(best.values(), key=lambda p: -p.psnr.mean)
    differences = [(p, estimate(group.contrast([(1.0, first.arm), (-1.0, p.arm)], "psnr"))) for p in others]
    level = [p for p, d in differences if d.low <= 0 or d.mean <= 0]
    return Choice(first, level, any(math.isnan(d.low) for _, d in differences))


_NOTHING = Point(Arm("", "", {}, "", ""), Estimate(-math.inf, 0, 0, ""), {})


@dataclass(frozen=True)
class Target:
    """A PSNR on val that was set by rule, and the seconds each model needs for it on one scene."""

    scene: str
    rule: str
    psnr: float  # dB
    seconds: dict[str, float]  # by model; infinite: never


def targets(group: Group) -> list[Target]:
    """Return the targets of every scene and the seconds that the frontier of each model needs for them.

    The seconds are those of the quickest finished arm whose mean over the seeds reaches the target: nothing is
    interpolated, as a run of another length was not run. A model ends with the highest mean of its arms.
    """
    found = []
    for scene in group.scenes:
        reached: dict[str, list[tuple[float, float]]] = {}  # by model: PSNR on val, seconds of an arm
        for arm in group.arms:
            quality, cost = (group.sample(arm, scene, name) for name in ("psnr_val", "seconds"))
            if len(quality) and len(cost):
                reached.setdefault(arm.series, []).append((float(quality.mean()), float(cost.mean())))
        for rule, psnr in _rules(group, scene, {m: max(p for p, _ in arms) for m, arms in reached.items()}):
            needed = {m: min((s for p, s in arms if p >= psnr), default=math.inf) for m, arms in reached.items()}
            found.append(Target(scene, rule, psnr, needed))
    return found


def _rules(group: Group, scene: str, ends: dict[str, float]) -> list[tuple[str, float]]:
    """Return the targets of a scene: what 3dgs, the weakest and the strongest model end with, the paper's number."""
    if not ends:
        return []
    weakest, strongest = min(ends, key=lambda m: (ends[m], m)), max(ends, key=lambda m: (ends[m], m))
    rules = [(f"{BASELINE} ends", ends[BASELINE])] if BASELINE in ends else []
    if weakest != BASELINE:
        rules.append((f"weakest ends ({weakest})", ends[weakest]))
    if strongest != weakest:
        rules.append((f"strongest ends ({strongest})", ends[strongest]))
    run = next(r for r in group.records if r.scene == scene)
    row = paper.paper_row(run.dataset, scene, "7dgs") if run.protocol.get("paper_dataset") == run.dataset else None
    return [*rules, *([("paper's 7dgs (its best on test)", row.psnr)] if row else [])]


def profile(of: Sequence[Target]) -> dict[str, Values]:
    """Return, for each model, its sorted ratios of seconds to the fastest model's, one for each target reached by any.

    The share of ratios up to tau is the performance profile of Dolan and More (2002); "never" is infinite. A model
    without a run on a target's scene never reaches it.
    """
    models = sorted({m for target in of for m in target.seconds})
    solved = [t for t in of if math.isfinite(min(t.seconds.values()))]
    ratios = {m: [_ratio(t.seconds.get(m, math.inf), min(t.seconds.values())) for t in solved] for m in models}
    return {m: np.sort(np.array(values)) for m, values in ratios.items()}


def _ratio(seconds: float, fastest: float) -> float:
    return 1.0 if seconds == fastest else seconds / fastest if fastest else math.inf


def _mean(scenes: list[Values]) -> float:
    """Return the mean over scenes of the mean over seeds; NaN where a scene has none."""
    return float(np.mean([s.mean() for s in scenes])) if all(map(len, scenes)) else math.nan
