"""Simulates differences of known truth, counts how often an interval holds it, and prints a table of the coverage.

python tests/report/simulate_coverage.py
"""

from collections.abc import Callable

import numpy as np

from gsbench.report.intervals import estimate

# Standard deviations in dB of what a seed, a view, and a seed on a view add to a difference of two models. The first
# line is what mini, trex and lego show (7dgs less 4dgs: 0.09 to 0.20, 0.3 to 1.2, 0.3 to 0.6).
SPREADS = {
    "as measured": (0.1, 1.0, 0.45),
    "seeds as views": (0.1, 0.3, 0.3),
    "seeds differ most": (0.3, 0.3, 0.1),
    "views differ most": (0.05, 0.5, 0.3),
}
# scenes, seeds, views
SHAPES = ((1, 2, 10), (1, 3, 20), (2, 3, 10), (2, 5, 20), (3, 3, 10), (8, 3, 20))
OF_SCENES = 0.5  # dB between scenes, where the interval is one of scenes like these
TRUTH = 0.25  # dB

Interval = Callable[[np.ndarray, np.random.Generator], tuple[float, float]]


def draw(shape: tuple[int, int, int], spread: tuple[float, float, float], truth: float, random) -> np.ndarray:
    """Differences of two models, [scenes, seeds, views]; scenes are fixed where there are fewer than three."""
    scenes, seeds, views = shape
    of_seed, of_view, rest = spread
    of_scene = OF_SCENES * random.normal(size=(scenes, 1, 1)) if scenes > 2 else 0.0
    crossed = of_seed * random.normal(size=(scenes, seeds, 1)) + of_view * random.normal(size=(scenes, 1, views))
    return truth + of_scene + crossed + rest * random.normal(size=shape)


def ours(values: np.ndarray, _: np.random.Generator) -> tuple[float, float]:
    of = estimate(list(values))
    return of.low, of.high


def percentile_bootstrap(values: np.ndarray, random: np.random.Generator) -> tuple[float, float]:
    """The plain hierarchical bootstrap: scenes (from three on), in them seeds and views, 500 times."""
    scenes, seeds, views = values.shape
    means = []
    for _ in range(500):
        drawn = random.integers(scenes, size=scenes) if scenes > 2 else range(scenes)
        of_scenes = [
            values[s][random.integers(seeds, size=seeds)][:, random.integers(views, size=views)].mean() for s in drawn
        ]
        means.append(np.mean(of_scenes))
    low, high = np.quantile(means, [0.025, 0.975])
    return low, high


def coverage(interval: Interval, shape, spread, count: int, truth: float = TRUTH, seed: int = 0) -> float:
    """The share of `count` simulations whose interval holds the truth."""
    random = np.random.default_rng(seed)
    held = 0
    for _ in range(count):
        low, high = interval(draw(shape, spread, truth, random), random)
        held += low <= truth <= high
    return held / count


if __name__ == "__main__":
    print("| spread | scenes | seeds | views | this interval | percentile bootstrap |")
    print("| --- | ---: | ---: | ---: | ---: | ---: |")
    for name, spread in SPREADS.items():
        for shape in SHAPES:
            holds = coverage(ours, shape, spread, 10_000)
            plain = coverage(percentile_bootstrap, shape, spread, 400)
            print(f"| {name} | {' | '.join(map(str, shape))} | {100 * holds:.1f} % | {100 * plain:.0f} % |", flush=True)
