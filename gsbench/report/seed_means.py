"""Average measured quantities over seeds and scenes, with 95 % intervals (gsbench.report.intervals)."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from gsbench.measure.record import Record
from gsbench.report import conditions
from gsbench.report.intervals import Estimate, estimate
from gsbench.report.tables import quantities

SPREAD = conditions.SPREAD  # the same in every table


def mean(runs: Mapping[str, Sequence[Record]], key: str) -> Estimate:
    """Estimate a quantity's mean over seeds and then over scenes, with its interval over seeds.

    The mean is NaN if the quantity is missing from a run, or if a scene has no run.

    Args:
        runs: finished runs by scene.
        key: the name of the quantity, such as "psnr".
    """
    scenes = [np.array([[_number(quantities(run).get(key))] for run in seeds]) for seeds in runs.values()]
    if any(len(scene) == 0 or np.isnan(scene).any() for scene in scenes):
        return Estimate(math.nan, len(scenes), 0, "")
    return estimate(scenes, generalise=False)


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else math.nan
