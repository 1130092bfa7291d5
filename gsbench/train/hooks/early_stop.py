"""Stop a training whose PSNR on val no longer rises, and end it with its best iteration on val (`train.patience`)."""

from __future__ import annotations

import copy
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, cast

from gsbench.config_key import joins, key
from gsbench.errors import InputError
from gsbench.measure.exact_views import rank
from gsbench.train.hooks import Hook, Training, check_choice_on_val, check_excludes

if TYPE_CHECKING:
    from gsbench.config import Config
    from gsbench.measure.record import Stop
    from gsbench.scenes import Scene


@joins("train")
@dataclass
class PatienceKey:
    """The key of this hook."""

    patience: float | None = key(
        None, "share of iterations without a better val PSNR that ends a run", low=0.01, high=1
    )


class EarlyStop(Hook):
    """Stop at the first measurement at which `train.patience` of all iterations have had no better PSNR on val.

    These iterations are counted from the end of densification at the earliest. Of iterations with equal PSNR, the last
    is kept. Iterations before the final SH degree, before AGR or in a warm-up are not kept, because the state would be
    shown with parts that it was not trained with.
    """

    name = "early_stop"
    measures = True

    def __init__(self, training: Training) -> None:
        super().__init__(training)
        patience = _patience(training.config)
        self.wait = None if patience is None else max(1, round(patience * training.config.train.iterations))
        self.stop: Stop | None = None  # of a training that has ended
        self._best: tuple[int, float] | None = None  # iteration and PSNR on val, dB
        self._kept: dict[str, Any] | None = None  # the state at that iteration; None if it is the last one
        self._last = 0  # the last measured iteration; not stored, as the last step is always measured

    @classmethod
    def check(cls, config: Config) -> None:
        if _patience(config) is not None:
            check_excludes(
                "train.patience",
                config,
                {
                    "effects.compare": "as a candidate of model=auto must not end before they are compared",
                    "train.lengths": "which chooses among whole trainings",
                    "train.average_from": "whose average ends a training (+recipe=long)",
                },
            )

    @classmethod
    def check_scene(cls, scene: Scene, config: Config) -> None:
        if _patience(config) is not None:
            check_choice_on_val("patience", "iteration", scene, config)

    def after_measuring(self, finished: int, psnr: float) -> float:
        """Keep the state of the Gaussians if none before had a higher PSNR on val; return `psnr` as it is."""
        training, self._last = self.training, finished
        iterations = training.config.train.iterations
        if self.wait is None or not training.schedule.is_complete(finished - 1):
            return psnr
        if self._best is None or rank(psnr) >= rank(self._best[1]):
            self._best = finished, psnr
            self._kept = None if finished == iterations else copy.deepcopy(training.state_of_gaussians())
        return psnr

    def stops(self, finished: int) -> bool:
        if self.wait is None or self._best is None:
            return False
        return finished - max(self._best[0], self.training.schedule.densify_stop) >= self.wait

    def at_end(self) -> None:
        """Restore the Gaussians of the best iteration, unless it is the last; measurements of later ones stay."""
        if self.wait is None or self._best is None:
            return
        from gsbench.measure.record import Stop

        training, stop = self.training, Stop(self._last, self._best[0])
        self.stop = stop
        equal = training.curve.equal_to(stop.kept)
        if len(equal) > 1:
            training.report(
                f"step {stop.iteration}: PSNR on val is equal at {len(equal)} steps, {equal[0].iteration} "
                f"to {equal[-1].iteration}: it cannot decide, and the last of them is kept"
            )
        if self._kept is not None:
            best_state, self._kept = self._kept, None  # not in the state that is loaded and saved now
            now = training.state_dict()
            training.load_state_dict(now | best_state | {"hooks": now["hooks"] | best_state["hooks"]})
            training.report(
                f"step {stop.iteration}: PSNR on val is highest at step {stop.kept}: the training ends "
                f"with the Gaussians of that step"
            )

    def state_dict(self) -> dict[str, Any]:
        stop = None if self.stop is None else asdict(self.stop)
        return {"best": self._best, "kept": self._kept, "stop": stop}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        from gsbench.measure.record import Stop
        from gsbench.reading import parse

        best, self._kept = state["best"], state["kept"]
        if best is not None and not (len(best) == 2 and isinstance(best[0], int) and isinstance(best[1], float)):
            raise InputError(f"checkpoint: expected the best iteration and its PSNR, got {best!r:.80}")
        if self._kept is not None and not isinstance(self._kept["hooks"], dict):
            raise InputError("checkpoint: expected the state at the best PSNR on val")
        self._best = None if best is None else (best[0], best[1])
        self.stop = None if state["stop"] is None else parse(Stop, state["stop"], "checkpoint: stop")

    def results(self) -> dict[str, Any]:
        return {"stop": self.stop}


def _patience(config: Config) -> float | None:
    return cast(PatienceKey, config.train).patience
