"""Draw README's frontier: PSNR on test against seconds of training, a line for each model, from the reference records.

python docs/site/frontier_chart.py
"""

import itertools
from pathlib import Path

import matplotlib as mpl
from matplotlib import pyplot
from published import CASES, experiment

from gsbench.report.render.palette import OF_MODELS, styles

ROOT = Path(__file__).resolve().parents[2]
PUBLISHED = ROOT / "results" / "published"
PICTURE = ROOT / "docs" / "images" / "frontier.png"
LENGTHS = ("250", "500", "1,000", "2,000", "4,000")  # iterations
NAMES = {"auto": "7DGS on demand (auto)", "7dgs": "7DGS", "7dgs_nodir": "7DGS without direction", "4dgs": "4DGS",
         "7dgs_noagr": "7DGS without AGR", "6dgs": "6DGS", "3dgs": "3DGS"}  # fmt: skip
MARKERS = "^shoDvPX<>pd*H8"
APART = 0.42  # dB between two labels
TICKS = (0.5, 1, 2, 5, 10, 20, 50, 100, 200)  # seconds

Point = tuple[float, float, float]  # seconds, dB, half of the 95 % interval


def points(model: str) -> list[Point]:
    """Return the means of a model over scenes and seeds at each length, with the interval that the tables have."""
    found = experiment(PUBLISHED, "frontier")
    line = []
    for case in (CASES[length] for length in LENGTHS):
        psnr, seconds = found.of(model, case), found.of(model, case, "seconds")
        line.append((seconds.mean, psnr.mean, psnr.half))
    return line


def heights(ends: dict[str, float]) -> dict[str, float]:
    """Return the height of each label in dB: that of its line's end, moved so that no two labels overlap."""
    ordered = sorted(ends, key=lambda model: -ends[model])
    found = {model: ends[model] for model in ordered}
    for _ in range(100):
        for upper, lower in itertools.pairwise(ordered):
            missing = APART - (found[upper] - found[lower])
            if missing > 0:
                found[upper] += missing / 2
                found[lower] -= missing / 2
    return found


def draw() -> None:
    """Draw the chart, and write it to docs/images/."""
    lines = {model: points(model) for model in NAMES}
    labels = heights({model: line[-1][1] for model, line in lines.items()})
    every = [point for line in lines.values() for point in line]
    first, last = (pick(seconds for seconds, _, _ in every) for pick in (min, max))
    mpl.rcParams |= {"font.family": "DejaVu Sans", "font.size": 11, "svg.hashsalt": "gsbench"}
    figure, axes = pyplot.subplots(figsize=(8, 4.6), dpi=150)
    chosen = styles(list(NAMES))
    for model, name in NAMES.items():
        seconds, psnr, half = zip(*lines[model], strict=True)
        colour = OF_MODELS[chosen[model]][0]
        axes.errorbar(
            seconds, psnr, half, color=colour, marker=MARKERS[chosen[model] % 15], markersize=5, linewidth=1.8,
            elinewidth=0.8, capsize=2, alpha=0.95,
        )  # fmt: skip
        axes.annotate(
            name, (seconds[-1], psnr[-1]), (1.25 * last, labels[model]), color=colour, va="center", fontsize=10,
            weight="bold", arrowprops={"arrowstyle": "-", "color": colour, "linewidth": 0.6, "shrinkA": 0, "shrinkB": 4,
                        "relpos": (0, 0.5)},
        )  # fmt: skip
    axes.set_xscale("log")
    axes.set_xlim(0.8 * first, 1.12 * last)
    axes.set_ylim(min(psnr for _, psnr, _ in every) - 0.5, max(psnr for _, psnr, _ in every) + 0.7)
    shown = [tick for tick in TICKS if 0.8 * first <= tick <= 1.12 * last]
    axes.set_xticks(shown, [f"{tick:g} s" for tick in shown])
    axes.minorticks_off()
    axes.set_xlabel("time of training")
    axes.set_ylabel("PSNR on test, dB")
    axes.grid(color="#e4e6ea", linewidth=0.8)
    axes.spines[["top", "right"]].set_visible(False)
    figure.subplots_adjust(left=0.085, right=0.7, top=0.97, bottom=0.125)
    figure.savefig(PICTURE, facecolor="white", metadata={"Software": None})


if __name__ == "__main__":
    draw()
