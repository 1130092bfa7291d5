"""Schedule a training: scale the steps of the recipe to a run of any length.

This module needs no torch, so that a report can mark the events of a schedule.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # config.py needs hydra, which a machine that checks kernels may lack
    from gsbench.config import TrainConfig

# Some intervals are a number of steps in a run of any length: clones need `densify.every` steps to move apart, so it is
# not scaled, and Adam needs this many between two resets to raise opacities again at its rate of 0.05.
STEPS_BETWEEN_RESETS = 300

# Gaussians multiply by each round of densification, so a long run has no more rounds than 7,400 iterations have: 145 of
# them left three times as many Gaussians on trex, and lower PSNR on val (docs/tuning.md).
MOST_ROUNDS = 36

# The step of the recipe after which Gaussians of little blend weight are dropped, if densification is over.
THIN = 15_600
GATE = 18_000  # the step of the recipe after which the model is gated in training, if densification is over ..
STEPS_TO_RECOVER = 300  # .. and so many are left: with 120 left of 300, a gated training ended 0.4 dB lower


@dataclass(frozen=True)
class ActiveComponents:
    """The parts of a model that are active at a step of the training."""

    sh_degree: int
    refine: bool  # AGR moves the parameters and learns
    tunes_lambda: bool  # lambda_t and lambda_d learn


class Schedule:
    """Steps of a `recipe_iterations` run, scaled to this one: step x iterations / recipe_iterations, rounded."""

    def __init__(self, config: TrainConfig, sh_degree: int, agr: bool) -> None:
        """Scale the steps of `config` to its own length, for a model of degree `sh_degree`, with or without AGR."""
        self.config = config
        self.sh_degree = sh_degree
        self.agr = agr
        densify = config.densify
        self.densify_start = self.scaled(densify.start)
        self.densify_stop = self.scaled(densify.stop)
        window, rounds = self.densify_stop - self.densify_start, densify.rounds or MOST_ROUNDS
        self.densify_every = max(densify.every, math.ceil(window / rounds))
        every = self.reset_every = max(self.scaled(densify.reset_every), STEPS_BETWEEN_RESETS)
        # Opacities are reset once so many steps are done: while densifying, and only with steps left to recover.
        self.resets_after = range(every, self.densify_stop - every // 2 + 1, every)

    def scaled(self, step: int) -> int:
        """Scale a step of the recipe to this run; at least 1."""
        return max(1, round(step * self.config.iterations / self.config.recipe_iterations))

    def active(self, step: int) -> ActiveComponents:
        """Tell which parts of the model are switched on at a step, counted from 0."""
        return ActiveComponents(
            sh_degree=min(self.sh_degree, step // self.scaled(self.config.sh_every)),
            refine=self.agr and step >= self.scaled(self.config.refine_from),
            tunes_lambda=step >= self.scaled(self.config.lambda_from),
        )

    def densifies(self, step: int) -> bool:
        """Tell whether Gaussians are cloned, split and pruned after a step (3DGS: from 500 to 15,000)."""
        done = step + 1
        return self.densify_start < done <= self.densify_stop and done % self.densify_every == 0

    def resets(self, step: int) -> bool:
        """Tell whether opacities are reset after a step, counted from 0."""
        return step + 1 in self.resets_after

    def has_reset(self, step: int) -> bool:
        """Tell whether there was an opacity reset; after it Gaussians that are too large are pruned."""
        return step + 1 > self.reset_every

    def resolution(self, step: int) -> int:
        """Return the factor by which the images of a step are smaller: that of the first window with the step, or 1."""
        coarse = self.config.coarse or []
        return next((factor for factor, until in coarse if step < self.scaled(until)), 1)

    def within(self, step: int, start: int, stop: int | None) -> bool:
        """Tell whether a step lies in a window of steps of the recipe; None is the end of the run."""
        return self.scaled(start) <= step + 1 and (stop is None or step + 1 <= self.scaled(stop))

    def thins(self, step: int) -> bool:
        """Tell whether Gaussians of little blend weight are dropped after a step: once densification is over."""
        return self.config.densify.thin_to is not None and step + 1 == max(self.scaled(THIN), self.densify_stop)

    def gates(self, step: int) -> bool:
        """Tell whether the model is gated after a step: after densification, if enough steps are left."""
        at = max(self.scaled(GATE), self.densify_stop)
        return step + 1 == at and self.config.iterations - at >= STEPS_TO_RECOVER

    def measures(self, step: int) -> bool:
        """Tell whether a point of the curve is measured after a step; after the last step it always is."""
        points = max(1, self.config.curve_points)
        done, total = step + 1, self.config.iterations
        return done == total or done * points // total != step * points // total
