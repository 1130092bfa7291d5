"""Estimate a mean over scenes, seeds and views with a 95 % interval that holds from three seeds on.

With three seeds a percentile bootstrap of any hierarchy covers far less than it claims: resampling three values finds
two thirds of their variance, and its quantiles are those of a normal distribution where Student's t has 4.3 instead of
2. So the spread of each level is estimated and has its own quantile of t (docs/statistics.md has the simulations):

- Three scenes and more: the means of the scenes are a sample of scenes like these, and include the spread of seeds and
  views. t with (scenes - 1) degrees of freedom is exact for normal means.
- One or two scenes say nothing about others. Seeds and views are crossed: each seed sees the same views. The half
  widths of seeds and of views, each with its own t, add in squares (MOVER: Zou and Donner 2008). The variance that
  seeds and views share is subtracted from the seeds once. The interval is at least that of the seeds alone.
- One seed: no spread is known, and there is no interval.
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
LEAST_SCENES = 3  # from which on an interval is one of scenes like these
LEAST_P = 1e-12


@dataclass(frozen=True)
class Spread:
    """The variance of a mean over seeds, views or scenes, and its degrees of freedom."""

    variance: float
    freedom: float

    def half_width(self, level: float) -> float:
        """Return half the width of this spread's own interval, by Student's t."""
        if self.variance <= 0:
            return 0.0
        return float(special.stdtrit(self.freedom, (1 + level) / 2)) * math.sqrt(self.variance)


@dataclass(frozen=True)
class Estimate:
    """A mean over scenes with its 95 % interval; without an interval if there is only one seed."""

    mean: float  # NaN: nothing was measured
    scenes: int
    seeds: int  # the fewest of a scene
    over: str  # what the interval generalises to: "scenes", "seeds and views", "seeds"; "" without an interval
    levels: tuple[Spread, ...] = ()  # their half widths add in squares
    floor: Spread | None = None  # the interval is not narrower than this one

    @cached_property
    def half(self) -> float:
        """Return half the width of the 95 % interval; NaN without one."""
        return self._half(LEVEL) if self.over else math.nan

    @property
    def low(self) -> float:
        """Return the lower end of the interval."""
        return self.mean - self.half

    @property
    def high(self) -> float:
        """Return the upper end of the interval."""
        return self.mean + self.half

    @cached_property
    def p(self) -> float:
        """Return the two-sided p-value of a mean of zero: one less the level whose interval ends at zero, or NaN."""
        if not self.over:
            return math.nan
        if self._half(LEVEL) == 0:
            return 1.0 if self.mean == 0 else 0.0
        low, high = math.log(LEAST_P), 0.0  # halved in the logarithm; scipy.optimize would take a second to import
        for _ in range(60):
            middle = (low + high) / 2
            if self._half(-math.expm1(middle)) > abs(self.mean):
                low = middle
            else:
                high = middle
        return math.exp(high)

    def _half(self, level: float) -> float:
        own = math.hypot(*(spread.half_width(level) for spread in self.levels))
        return max(own, self.floor.half_width(level) if self.floor else 0.0)


def estimate(scenes: list[Values], *, generalise: bool = True) -> Estimate:
    """Estimate the mean over scenes of the mean over seeds and views.

    Args:
        scenes: for each scene the values [seeds, views], every seed with the same views; one column if there are no
            views.
        generalise: from three scenes on the interval is over scenes like these, otherwise over these scenes.
    """
    if not scenes:
        return Estimate(math.nan, 0, 0, "")
    means = np.array([scene.mean() for scene in scenes])
    mean, count, seeds = float(means.mean()), len(scenes), min(len(scene) for scene in scenes)
    if seeds < 2:
        return Estimate(mean, count, seeds, "")
    if generalise and count >= LEAST_SCENES:
        return Estimate(mean, count, seeds, "scenes", (Spread(float(means.var(ddof=1)) / count, count - 1),))
    of_seeds = _combined([Spread(scene.mean(1).var(ddof=1) / len(scene), len(scene) - 1) for scene in scenes])
    if min(scene.shape[1] for scene in scenes) < 2:
        return Estimate(mean, count, seeds, "seeds", (of_seeds,))
    own = _combined([_without_rest(scene) for scene in scenes])
    of_views = _combined([Spread(s.mean(0).var(ddof=1) / s.shape[1], s.shape[1] - 1) for s in scenes])
    return Estimate(mean, count, seeds, "seeds and views", (own, of_views), of_seeds)


def over_seeds(values: Sequence[float]) -> Estimate:
    """Estimate the mean of one model's runs on a scene; its interval is over seeds, on this scene and these views.

    Args:
        values: one value for each seed.
    """
    return estimate([np.array(values, dtype=np.float64)[:, None]], generalise=False)


def _combined(scenes: list[Spread]) -> Spread:
    """Return the spread of a mean over scenes, its degrees of freedom after Satterthwaite (1946)."""
    total = sum(s.variance for s in scenes)
    squares = sum(s.variance**2 / s.freedom for s in scenes)
    freedom = total**2 / squares if squares else sum(s.freedom for s in scenes)
    return Spread(total / len(scenes) ** 2, freedom)


def _without_rest(scene: Values) -> Spread:
    """Return the spread over seeds, without the spread over views in each seed (two-way ANOVA)."""
    seeds, views = scene.shape
    rest = scene - scene.mean(1, keepdims=True) - scene.mean(0, keepdims=True) + scene.mean()
    of_rest = (rest**2).sum() / ((seeds - 1) * (views - 1)) / scene.size
    return Spread(max(float(scene.mean(1).var(ddof=1) / seeds - of_rest), 0.0), seeds - 1)


def holm(p: list[float]) -> list[float]:
    """Adjust p-values for multiple comparisons, after Holm (1979); NaN is not counted and stays NaN."""
    adjusted = [math.nan] * len(p)
    tested = sorted((value, i) for i, value in enumerate(p) if not math.isnan(value))
    largest = 0.0
    for rank, (value, i) in enumerate(tested):
        largest = max(largest, min(1.0, (len(tested) - rank) * value))
        adjusted[i] = largest
    return adjusted
