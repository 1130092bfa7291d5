"""Estimate a mean over scenes, seeds and views, with a 95 % interval that is valid for three or more seeds.

With three seeds, the interval of a percentile bootstrap is much too narrow. First, resampling three values gives only
two thirds of their variance. Second, its quantiles are those of a normal distribution (about 2 standard errors), while
Student's t needs 4.3 for three values. This module therefore estimates the variance over scenes, seeds and views
separately, and applies Student's t to each. The simulations are in docs/statistics.md.

- With three or more scenes, the means of the scenes are a sample of similar scenes. Their variance includes that of
  seeds and views. Student's t with (scenes - 1) degrees of freedom is exact if these means are normal.
- With one or two scenes, the interval does not hold for other scenes. All seeds see the same views, so seeds and views
  are crossed factors. Each factor has a half width by Student's t, and the squares of the half widths are added (MOVER:
  Zou and Donner 2008). The residual variance is contained in both factors, so it is subtracted once from the variance
  over seeds. The interval is never narrower than that of the seeds alone. For two scenes, `Estimate.half_over_scenes`
  says how much wider an interval for similar scenes is.
- With one seed, there is no interval, because the variance over seeds is not known.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy import special

Values = npt.NDArray[np.float64]
LEVEL = 0.95
LEAST_SCENES = 3  # the fewest scenes for an interval that holds for similar scenes
LEAST_P = 1e-12


@dataclass(frozen=True)
class Spread:
    """The variance of a mean over seeds, views or scenes, with its degrees of freedom."""

    variance: float
    freedom: float

    def half_width(self, level: float) -> float:
        """Return half the width of the confidence interval that follows from this variance alone, with Student's t."""
        if self.variance <= 0:
            return 0.0
        return float(special.stdtrit(self.freedom, (1 + level) / 2)) * math.sqrt(self.variance)


@dataclass(frozen=True)
class Estimate:
    """A mean over scenes with its 95 % interval; with only one seed there is no interval."""

    mean: float  # NaN: nothing was measured
    scenes: int
    seeds: int  # the smallest number of seeds of a scene
    over: str  # what the interval generalises to: "scenes", "seeds and views", "seeds"; "" without an interval
    levels: tuple[Spread, ...] = ()  # their half widths add in squares
    floor: Spread | None = None  # the interval is not narrower than this one
    each: tuple[float, ...] = ()  # the mean of each scene

    @cached_property
    def half(self) -> float:
        """Return half the width of the mean's 95 % interval, or NaN if there is no interval."""
        return self._half(LEVEL) if self.over else math.nan

    @property
    def low(self) -> float:
        """Return the lower end of the mean's 95 % interval."""
        return self.mean - self.half

    @property
    def high(self) -> float:
        """Return the upper end of the mean's 95 % interval."""
        return self.mean + self.half

    @property
    def gaining(self) -> int:
        """Return the number of scenes whose mean is above zero."""
        return sum(mean > 0 for mean in self.each)

    @property
    def half_over_scenes(self) -> float:
        """Return half the width of the 95 % interval for similar scenes: Student's t over the means of the scenes.

        NaN with fewer than two scenes. With two scenes it is wide (t = 12.7), which is what two scenes can tell. It is
        never narrower than the interval for these scenes, because two means may be equal by chance.
        """
        if len(self.each) < 2:
            return math.nan
        return max(_of_scenes(np.array(self.each)).half_width(LEVEL), self.half if self.over else 0.0)

    @cached_property
    def p(self) -> float:
        """Return the two-sided p-value of the hypothesis that the mean is zero; NaN if there is no interval.

        The p-value is 1 minus the confidence level at which the interval ends exactly at zero.
        """
        if not self.over:
            return math.nan
        if self._half(LEVEL) == 0:
            return 1.0 if self.mean == 0 else 0.0
        low, high = math.log(LEAST_P), 0.0  # bisection of log p; importing scipy.optimize would take a second
        for _ in range(60):
            middle = (low + high) / 2
            if self._half(-math.expm1(middle)) > abs(self.mean):  # at the level 1 - p: zero is in the interval
                low = middle
            else:
                high = middle
        return math.exp(high)

    def _half(self, level: float) -> float:
        width = math.hypot(*(spread.half_width(level) for spread in self.levels))
        return max(width, self.floor.half_width(level) if self.floor else 0.0)


def estimate(scenes: list[Values], *, generalise: bool = True) -> Estimate:
    """Estimate the mean over scenes of the mean over seeds and views, with its 95 % interval.

    Args:
        scenes: for each scene an array [seeds, views], in which every seed has the same views. It has one column if the
            quantity is not measured for each view.
        generalise: if true and there are at least three scenes, the interval holds for similar scenes; otherwise it
            holds only for the given scenes.
    """
    if not scenes:
        return Estimate(math.nan, 0, 0, "")
    means = np.array([scene.mean() for scene in scenes])
    mean, count, seeds = float(means.mean()), len(scenes), min(len(scene) for scene in scenes)
    each = tuple(means.tolist())
    if seeds < 2:
        return Estimate(mean, count, seeds, "", each=each)
    if generalise and count >= LEAST_SCENES:
        return Estimate(mean, count, seeds, "scenes", (_of_scenes(means),), each=each)
    of_seeds = _combined([Spread(scene.mean(1).var(ddof=1) / len(scene), len(scene) - 1) for scene in scenes])
    if min(scene.shape[1] for scene in scenes) < 2:
        return Estimate(mean, count, seeds, "seeds", (of_seeds,), each=each)
    without_rest = _combined([_without_rest(scene) for scene in scenes])
    of_views = _combined([Spread(s.mean(0).var(ddof=1) / s.shape[1], s.shape[1] - 1) for s in scenes])
    return Estimate(mean, count, seeds, "seeds and views", (without_rest, of_views), of_seeds, each)


def over_seeds(values: Sequence[float]) -> Estimate:  # one value for each seed
    """Estimate the mean of a model's runs on one scene; the interval is over seeds, for this scene and its views."""
    return estimate([np.array(values, dtype=np.float64)[:, None]], generalise=False)


def _of_scenes(means: Values) -> Spread:
    """Return the variance of the mean of scenes that are a sample of similar scenes, from the means of the scenes."""
    return Spread(float(means.var(ddof=1)) / len(means), len(means) - 1)


def _combined(scenes: list[Spread]) -> Spread:
    """Return the variance of a mean over scenes, from the variance of each scene's mean.

    The degrees of freedom follow Satterthwaite (1946).
    """
    total = sum(s.variance for s in scenes)
    squares = sum(s.variance**2 / s.freedom for s in scenes)
    freedom = total**2 / squares if squares else sum(s.freedom for s in scenes)
    return Spread(total / len(scenes) ** 2, freedom)


def _without_rest(scene: Values) -> Spread:
    """Return the variance of a scene's mean over seeds, minus the residual variance of a two-way ANOVA.

    The two factors of the ANOVA are seeds and views.
    """
    seeds, views = scene.shape
    rest = scene - scene.mean(1, keepdims=True) - scene.mean(0, keepdims=True) + scene.mean()
    of_rest = (rest**2).sum() / ((seeds - 1) * (views - 1)) / scene.size
    return Spread(max(float(scene.mean(1).var(ddof=1) / seeds - of_rest), 0.0), seeds - 1)


def holm(p: list[float]) -> list[float]:
    """Adjust p-values for multiple comparisons with Holm's method (1979); NaN values are not counted and stay NaN."""
    adjusted = [math.nan] * len(p)
    tested = sorted((value, i) for i, value in enumerate(p) if not math.isnan(value))
    largest = 0.0
    for rank, (value, i) in enumerate(tested):
        largest = max(largest, min(1.0, (len(tested) - rank) * value))
        adjusted[i] = largest
    return adjusted
