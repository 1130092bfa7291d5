"""Simulates differences of known truth, counts how often an interval holds it, and prints a table of the coverage.

python tests/report/simulate_coverage.py
"""

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


def draw(shape: tuple[int, int, int], spread: tuple[float, float, float], truth: float, random) -> np.ndarray:
    """Differences of two models, [scenes, seeds, views]; scenes are fixed where there are fewer than three."""
    scenes, seeds, views = shape
    of_seed, of_view, rest = spread
    of_scene = OF_SCENES * random.normal(size=(scenes, 1, 1)) if scenes > 2 else 0.0
    crossed = of_seed * random.normal(size=(scenes, seeds, 1)) + of_view * random.normal(size=(scenes, 1, views))
    return truth + of_scene + crossed + rest * random.normal(size=shape)


def coverage(shape, spread, count: int, truth: float = TRUTH, seed: int = 0) -> float:
    """The share of `count` simulations whose interval holds the truth."""
    random = np.random.default_rng(seed)
    intervals = (estimate(list(draw(shape, spread, truth, random))) for _ in range(count))
    return sum(of.low <= truth <= of.high for of in intervals) / count


if __name__ == "__main__":
    print("| spread | scenes | seeds | views | coverage |")
    print("| --- | ---: | ---: | ---: | ---: |")
    for name, spread in SPREADS.items():
        for shape in SHAPES:
            holds = coverage(shape, spread, 10_000)
            print(f"| {name} | {' | '.join(map(str, shape))} | {100 * holds:.1f} % |", flush=True)
