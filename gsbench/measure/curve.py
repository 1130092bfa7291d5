"""Store the training curve of a run: PSNR on the validation split over iterations and seconds."""

import math
from dataclasses import dataclass, field
from typing import NamedTuple

from gsbench.errors import InputError
from gsbench.measure.exact_views import rank

FALL = 0.1  # dB of PSNR; a smaller fall is not mentioned, because seeds differ by as much (docs/tuning.md)


class Point(NamedTuple):
    """One evaluation during training: iteration, seconds and PSNR."""

    iteration: int
    seconds: float  # seconds of training so far, without evaluation
    psnr_val: float | None  # dB on the validation split; None if it was not finite


@dataclass
class Curve:
    """The training curve of a run: its evaluations in order, which the checkpoint stores."""

    points: list[Point] = field(default_factory=list)

    def add(self, iteration: int, seconds: float, psnr_val: float) -> None:
        """Append an evaluation to the curve.

        Raises:
            InputError: iteration or seconds are smaller than those of the last evaluation, as after a faulty resume.
        """
        if self.points and (iteration <= self.points[-1].iteration or seconds < self.points[-1].seconds):
            raise InputError(
                f"curve: expected a point after {self.points[-1].iteration} iterations, {self.points[-1].seconds} s; "
                f"got {iteration} iterations, {seconds} s; restore the curve and the clock from one checkpoint"
            )
        self.points.append(Point(iteration, seconds, psnr_val if math.isfinite(psnr_val) else None))

    def delay(self, seconds: float) -> None:
        """Add the seconds of work that was done before this training to every evaluation."""
        self.points = [p._replace(seconds=p.seconds + seconds) for p in self.points]

    @property
    def last(self) -> Point | None:
        """Return the latest evaluation, or None if there is none."""
        return self.points[-1] if self.points else None

    @property
    def best(self) -> Point | None:
        """Return the evaluation with the highest PSNR, the last of equal ones; None if none is finite."""
        return max((p for p in reversed(self.points) if p.psnr_val is not None), key=_rank, default=None)

    def equal_to(self, iteration: int) -> list[Point]:
        """Return the evaluations between which PSNR cannot decide: that of an iteration, and all of the same rank."""
        ranks = {_rank(p) for p in self.points if p.iteration == iteration}
        return [p for p in self.points if _rank(p) in ranks]

    @property
    def fall(self) -> float:
        """Return how many dB the PSNR of the latest evaluation is below the highest one; 0 if it is not known."""
        best, last = self.best, self.last
        if best is None or best.psnr_val is None or last is None or last.psnr_val is None:
            return 0.0
        return best.psnr_val - last.psnr_val

    @property
    def progress(self) -> str:
        """Return the latest evaluation and its change as text, such as "12 s of training, val 24.40 dB (+0.31)"."""
        if not self.points:
            return "val not measured yet"
        before, now = (self.points[-2] if len(self.points) > 1 else None), self.points[-1]
        text = f"{now.seconds:.0f} s of training, val "
        if now.psnr_val is None:
            return f"{text}-"
        change = "" if before is None or before.psnr_val is None else f" ({now.psnr_val - before.psnr_val:+.2f})"
        return f"{text}{now.psnr_val:.2f} dB{change}"

    def state_dict(self) -> list[tuple[int, float, float | None]]:
        """Return the evaluations as plain tuples, which a checkpoint can store and load with `weights_only=True`."""
        return [(p.iteration, p.seconds, p.psnr_val) for p in self.points]

    def load_state_dict(self, state: list[tuple[int, float, float | None]]) -> None:
        """Replace the evaluations by those of a checkpoint.

        Raises:
            InputError: iterations or seconds are not increasing.
        """
        self.points = []
        for iteration, seconds, psnr in state:
            self.add(iteration, float(seconds), math.nan if psnr is None else float(psnr))


def _rank(point: Point) -> float:
    return rank(point.psnr_val)
