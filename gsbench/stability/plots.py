"""Plot the results of the stability audit with matplotlib."""

import io
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gsbench.measure.atomic import write_atomically
from gsbench.stability.audit import Audit

COLORS = {"square_root": "tab:blue", "schur": "tab:red", "cholesky": "tab:orange"}
LEAST, MOST = 1e-16, 1e3  # the range of plotted errors; values outside are plotted at the edge


@dataclass(frozen=True)
class Plot:
    """The title, file name and caption of a plot on the page of the stability audit."""

    title: str
    file: str
    caption: str


BY_CONDITION = Plot(
    "Error against condition number", "condition.png",
    "Relative error of the sliced covariance: 7DGS in float32 by torch, the factor in the paper's order, random "
    "factors whose diagonals go down to 10^-8. Solid: median, dashed: 99th percentile, both on the left axis. "
    "Dotted, on the right axis: share of covariances that are indefinite or not finite.",
)  # fmt: skip
BY_TIME = (
    Plot(
        "Error against time: slicing", "time_slicing.png",
        "99.9th percentile of the covariance's relative error over 20,000 hard slices, against milliseconds forward "
        "and backward. Lower left is better. The reference is Gram-Schmidt in float64.",
    ),
    Plot(
        "Error against time: pictures", "time_picture.png",
        "Largest error of a pixel that no rounding can flip, 1,500 Gaussians at 96 x 96, against milliseconds forward "
        "and backward. The native kernel's exp2 is a polynomial and torch's exp is exact to an ulp: the two cannot be "
        "swapped within a backend, so backends stand for them. Tile bounds and the cut-offs at 1/255 and 1e-4 are "
        "rules of the image and cannot be switched off.",
    ),
)  # fmt: skip


def write(audit: Audit, folder: Path) -> list[Plot]:
    """Write all plots of the stability audit to `folder`; return their titles, file names and captions."""
    save(folder / BY_CONDITION.file, lambda axes: by_condition(axes, audit))
    for figure, thing in zip(BY_TIME, ("slicing", "picture"), strict=True):
        save(folder / figure.file, partial(by_time, audit=audit, thing=thing))
    return [BY_CONDITION, *BY_TIME]


def save(path: Path, draw: Callable[[Axes], None], size: tuple[float, float] = (7.5, 4.5)) -> None:
    """Create a figure with one pair of axes, plot on these with `draw`, and write the figure as PNG."""
    figure, axes = plt.subplots(figsize=size, layout="constrained")
    draw(axes)
    save_figure(figure, path)


def save_figure(figure: Figure, path: Path) -> None:
    """Write a matplotlib figure as PNG, and close it."""
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=110)
    plt.close(figure)
    write_atomically(path, data.getvalue())


def by_condition(axes: Axes, audit: Audit) -> None:
    """Plot errors (left axis) and the share of invalid covariances (right axis) over the condition number.

    There is a curve for each algorithm that computes conditional covariances.
    """
    shares = axes.twinx()
    for curve in audit.conditions:
        color = COLORS[curve.scheme]
        axes.loglog(curve.condition, shown(curve.median), color=color, marker="o", markersize=3, label=curve.scheme)
        axes.loglog(curve.condition, shown(curve.percentile99), color=color, linestyle="--")
        shares.plot(curve.condition, [100 * x for x in curve.bad], color=color, linestyle=":")
    axes.set(xlabel="condition number of the factor", ylabel="relative error of the covariance", ylim=(1e-8, 10))
    shares.set(ylabel="indefinite or not finite, % (dotted)", ylim=(-2, 102))
    axes.grid(alpha=0.3)
    if audit.conditions:
        axes.legend(loc="upper left", title="solid: median, dashed: 99 %")


def by_time(axes: Axes, audit: Audit, thing: str) -> None:
    """Plot errors over milliseconds as labelled points, one for each algorithm that conditions or renders Gaussians."""
    points = [point for point in audit.accuracy if point.thing == thing]
    points.sort(key=lambda point: point.ms)
    for i, (point, height) in enumerate(zip(points, shown([point.error for point in points]), strict=True)):
        color = next((color for scheme, color in COLORS.items() if scheme in point.way), "tab:blue")
        double = "float64" in point.way
        axes.scatter(point.ms, height, color=color, marker="s" if double else "o")
        # Labels of neighbours would overlap, so that of schur, which is near cholesky, goes above.
        above = "schur" in point.way if thing == "slicing" else i % 2 == 0
        aside = (6, 5 if above else -12)
        axes.annotate(point.way, (point.ms, height), textcoords="offset points", xytext=aside, fontsize=8, color=color)
    axes.set(xscale="log", yscale="log", xlabel="ms, forward and backward (square: float64)", ylabel="error")
    left, right = axes.get_xlim()
    axes.set_xlim(left, right * (right / left) ** 0.35)  # room for the labels
    axes.margins(y=0.1)
    axes.grid(alpha=0.3)


def shown(errors: list[float]) -> list[float]:
    """Clamp errors to the range of the plot, [1e-16, 1e3]."""
    return [min(max(error, LEAST), MOST) for error in errors]
