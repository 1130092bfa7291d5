"""Find the best and the second best rows of a result table, with ties where an interval cannot tell two rows apart."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from gsbench.report.intervals import Estimate, estimate
from gsbench.report.layout import QuantityColumn, Row

BEST, SECOND = 1, 2
RULE = (
    "Bold: the best mean, and every mean that does not differ from it. Underlined: the same for the second best. "
    "Two means differ if the 95 % interval over seeds of their paired difference excludes zero; with one seed, if they "
    "differ as shown."
)
Runs = Mapping[str, Mapping[int, float]]  # by scene and seed


def ranks(rows: Sequence[Row], column: QuantityColumn) -> list[int]:
    """Return BEST, SECOND or 0 for each row of a section; rows without numbers and the paper's rows have no rank.

    Args:
        rows: the rows of one section, such as the models on one scene.
        column: the column by which the rows are ranked.
    """
    places = [0] * len(rows)
    if not column.better:
        return places
    sign = 1 if column.better == "higher" else -1
    known = {i: row.values[column.key] for i, row in enumerate(rows) if column.key in row.values}
    left = {i: runs for i, runs in known.items() if not math.isnan(mean(runs).mean)}
    for place in (BEST, SECOND):
        if not left:
            break
        leader = max(left.values(), key=lambda runs: sign * mean(runs).mean)
        tied = [i for i, runs in left.items() if _are_tied(leader, runs, column)]
        for i in tied:
            places[i] = place
            del left[i]
    return places


def mean(runs: Runs) -> Estimate:
    """Estimate the mean over scenes of the mean over seeds, with its 95 % interval over seeds."""
    if not runs or any(math.isnan(value) for seeds in runs.values() for value in seeds.values()):
        return Estimate(math.nan, len(runs), 0, "")
    return estimate([np.array(list(seeds.values()))[:, None] for seeds in runs.values()], generalise=False)


def _are_tied(best: Runs, other: Runs, column: QuantityColumn) -> bool:
    """Tell whether two rows look equal, or the interval of their difference over the seeds of both holds zero."""
    if column.show(mean(best).mean) == column.show(mean(other).mean):
        return True
    shared = {scene: best[scene].keys() & other[scene].keys() for scene in best.keys() & other.keys()}
    difference = mean(
        {scene: {seed: best[scene][seed] - other[scene][seed] for seed in seeds} for scene, seeds in shared.items()}
        if all(shared.values())
        else {}
    )
    return abs(difference.mean) <= difference.half  # False if there is no interval
