"""Keep the iteration with the best PSNR on val, and stop a training whose PSNR on val no longer rises."""

import copy
import math
from collections.abc import Callable
from typing import Any

from gsbench.errors import InputError
from gsbench.measure.exact_views import rank
from gsbench.measure.record import Stop
from gsbench.measure.schema import parse
from gsbench.schedule import Schedule

NOTHING_KEPT: dict[str, Any] = {"best": None, "kept": None, "stop": None}  # of a checkpoint without `train.patience`


class EarlyStop:
    """Early stopping: hold the state of a training at its best PSNR on val; do nothing if `train.patience` is None.

    The training stops at the first measurement on val at which `train.patience` of all iterations, counted from the end
    of densification at the earliest, have had no better PSNR. Of iterations with equal PSNR, the last is kept.
    Iterations before the final SH degree or before AGR are not kept, because the state would be shown with parts that
    it was not trained with.
    """

    def __init__(self, schedule: Schedule, patience: float | None) -> None:
        """Start without a kept state.

        Args:
            schedule: the schedule of the training.
            patience: the share of all iterations after which a training without a better PSNR stops; None for never.
        """
        self.schedule = schedule
        self.wait = None if patience is None else max(1, round(patience * schedule.config.iterations))
        self.stop: Stop | None = None  # of a training that ended by this class
        self._best: tuple[int, float] | None = None  # iteration and PSNR on val, dB
        self._kept: dict[str, Any] | None = None  # the state at that iteration; None if it is the last one

    def see(self, iteration: int, psnr: float, state: Callable[[], dict[str, Any]]) -> None:
        """Look at a measurement on val, and keep the state of the training if it is the best so far.

        Args:
            iteration: the number of finished iterations.
            psnr: PSNR on val, dB; NaN is below every number.
            state: a function that returns the state of the training.
        """
        last = self.schedule.config.iterations
        now, end = self.schedule.active(iteration - 1), self.schedule.active(last - 1)
        if self.wait is None or (now.sh_degree, now.refine) != (end.sh_degree, end.refine):
            return
        if self._best is None or rank(psnr) >= rank(self._best[1]):
            self._best = iteration, psnr
            self._kept = None if iteration == last else copy.deepcopy(state())

    def is_over(self, iteration: int) -> bool:
        """Return whether the training stops after so many finished iterations, the last of which was measured."""
        if self.wait is None or self._best is None:
            return False
        return iteration - max(self._best[0], self.schedule.densify_stop) >= self.wait

    def take(self, iteration: int) -> dict[str, Any] | None:
        """Return the state with the best PSNR on val after the end of a training; None if the last one has it.

        Args:
            iteration: the number of finished iterations.
        """
        if self.wait is None or self._best is None:
            return None
        self.stop, kept, self._kept = Stop(iteration, self._best[0]), self._kept, None
        return kept

    def state_dict(self) -> dict[str, Any]:
        """Return the kept state and its PSNR for a checkpoint."""
        stop = None if self.stop is None else vars(self.stop).copy()
        return {"best": self._best, "kept": self._kept, "stop": stop}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the kept state from a checkpoint; raise InputError if it is not one."""
        if not isinstance(state, dict) or not isinstance(state["kept"], dict | None):
            raise InputError("checkpoint: expected the state at the best PSNR on val")
        best, self._kept = state["best"], state["kept"]
        if best is not None and not (len(best) == 2 and isinstance(best[0], int) and isinstance(best[1], float)):
            raise InputError(f"checkpoint: expected the best iteration and its PSNR, got {best!r:.80}")
        if best is None or math.isinf(best[1]):  # older versions stored an infinite PSNR, which no step would exceed
            self._best = self._kept = None
        else:
            self._best = best[0], best[1]
        self.stop = None if state["stop"] is None else parse(Stop, state["stop"], "checkpoint: stop")
