"""Keep the training curve of a run: PSNR on the val split over iterations and seconds."""

import math
from dataclasses import dataclass, field
from typing import NamedTuple

from gsbench.errors import InputError


class Point(NamedTuple):
    """One evaluation during training."""

    iteration: int
    seconds: float  # of training so far, evaluation excluded
    psnr_val: float | None  # dB on the validation split; None where it was not finite


@dataclass
class Curve:
    """The points of a run's training curve in order.

    The checkpoint holds them, so a resumed run continues the curve.
    """

    points: list[Point] = field(default_factory=list)

    def add(self, iteration: int, seconds: float, psnr_val: float) -> None:
        """Append a point; raises InputError if iteration or seconds go backwards (after a faulty resume)."""
        if self.points and (iteration <= self.points[-1].iteration or seconds < self.points[-1].seconds):
            raise InputError(
                f"curve: expected a point after {self.points[-1].iteration} iterations, {self.points[-1].seconds} s; "
                f"got {iteration} iterations, {seconds} s; restore the curve and the clock from one checkpoint"
            )
        self.points.append(Point(iteration, seconds, psnr_val if math.isfinite(psnr_val) else None))

    @property
    def last(self) -> Point | None:
        """Return the latest point; None before the first."""
        return self.points[-1] if self.points else None

    @property
    def best(self) -> Point | None:
        """Return the earliest of the points with the highest PSNR; None if no PSNR is finite."""
        finite = [(p.psnr_val, p) for p in self.points if p.psnr_val is not None]
        return max(finite, key=lambda pair: pair[0])[1] if finite else None

    @property
    def progress(self) -> str:
        """Return the latest point as text, with its change: "12 s of training, val 24.40 dB (+0.31)"."""
        if not self.points:
            return "val not measured yet"
        before, now = (self.points[-2] if len(self.points) > 1 else None), self.points[-1]
        told = f"{now.seconds:.0f} s of training, val "
        if now.psnr_val is None:
            return f"{told}-"
        change = "" if before is None or before.psnr_val is None else f" ({now.psnr_val - before.psnr_val:+.2f})"
        return f"{told}{now.psnr_val:.2f} dB{change}"

    def seconds_to(self, psnr: float) -> float | None:
        """Return the training seconds at the first point that reached `psnr` dB, not interpolated; None if none did."""
        return next((p.seconds for p in self.points if p.psnr_val is not None and p.psnr_val >= psnr), None)

    def state_dict(self) -> list[tuple[int, float, float | None]]:
        """Return the points as plain tuples, which a checkpoint can hold (weights_only=True)."""
        return [(p.iteration, p.seconds, p.psnr_val) for p in self.points]

    def load_state_dict(self, state: list[tuple[int, float, float | None]]) -> None:
        """Continue from the points of a checkpoint; raises InputError if they do not make a curve."""
        self.points = []
        for iteration, seconds, psnr in state:
            self.add(iteration, float(seconds), math.nan if psnr is None else float(psnr))
