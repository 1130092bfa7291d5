"""Record the PSNR of the evaluated split at the iteration that is best on val, and its highest PSNR (a leak)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from gsbench.errors import InputError
from gsbench.measure.exact_views import rank
from gsbench.train.hooks import Hook, Training


@dataclass
class Scores:
    """The best PSNR on val so far, and two PSNRs of the evaluated split, which is test or val, in dB."""

    val: float | None = None
    eval_at_best_val: float | None = None  # at the iteration with the best PSNR on val, the last of equal ones
    eval: float | None = None  # the highest; to choose an iteration by it leaks test data


class Best(Hook):
    """Measure the evaluated split whenever PSNR on val is the best so far, or always (`protocol.best_on_test`)."""

    name = "best"
    measures = True

    def __init__(self, training: Training) -> None:
        super().__init__(training)
        self.scores = Scores()

    def after_measuring(self, finished: int, psnr: float) -> float:
        """Measure the evaluated split, and keep the scores that are the best so far; return `psnr` as it is."""
        scores, leaks = self.scores, self.training.config.protocol.best_on_test
        is_best = psnr >= rank(scores.val)  # a NaN is never the best; rank of None or NaN is -inf
        if leaks or is_best:
            now = self.training.psnr(self.training.views)
            if is_best:
                scores.val, scores.eval_at_best_val = psnr, now
            if leaks and rank(now) >= rank(scores.eval):
                scores.eval = now
        return psnr

    def state_dict(self) -> dict[str, Any]:
        return vars(self.scores).copy()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.scores = Scores(**state)
        if not all(isinstance(value, float | None) for value in vars(self.scores).values()):
            raise InputError(f"checkpoint: expected the best PSNRs, got {state!r:.80}")
