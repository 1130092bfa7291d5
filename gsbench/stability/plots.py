"""The audit's pictures, by matplotlib."""

import io
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.axes import Axes

from gsbench.measure.atomic import write_atomically
from gsbench.stability.audit import Audit

COLORS = {"square_root": "tab:blue", "schur": "tab:red", "cholesky": "tab:orange"}


@dataclass(frozen=True)
class Picture:
    """A plot on the page."""

    title: str
    file: str
    caption: str


def write(audit: Audit, folder: Path) -> list[Picture]:
    """Draw what there is data for, and say what it shows."""
    drawn = []
    if audit.conditions:
        save(folder / "condition.png", lambda axes: by_condition(axes, audit))
        drawn.append(
            Picture(
                "Error against condition number", "condition.png",
                "Relative error of the sliced covariance, 7DGS in float32, factor in the paper's order, random factors "
                "with diagonals down to 10^-8. Lines: median; dashed: 99th percentile. The right axis of failures: "
                "share whose covariance is indefinite or not finite (dotted).",
            )
        )  # fmt: skip
    return drawn


def save(path: Path, draw: Callable[[Axes], None], size: tuple[float, float] = (7.5, 4.5)) -> None:
    """Draw on one pair of axes and write it as PNG."""
    figure, axes = plt.subplots(figsize=size, layout="constrained")
    draw(axes)
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=110)
    plt.close(figure)
    write_atomically(path, data.getvalue())


def by_condition(axes: Axes, audit: Audit) -> None:
    """Errors on the left axis, the share of failures on the right."""
    shares = axes.twinx()
    for curve in audit.conditions:
        color = COLORS[curve.scheme]
        axes.loglog(curve.condition, curve.median, color=color, marker="o", markersize=3, label=curve.scheme)
        axes.loglog(curve.condition, curve.percentile99, color=color, linestyle="--")
        shares.plot(curve.condition, [100 * x for x in curve.bad], color=color, linestyle=":")
    axes.set(xlabel="condition number of the factor", ylabel="relative error of the covariance", ylim=(1e-8, 1e2))
    shares.set(ylabel="indefinite or not finite, % (dotted)", ylim=(-2, 102))
    axes.grid(alpha=0.3)
    axes.legend(loc="upper left", title="median; dashed: 99 %")
