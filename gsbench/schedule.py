"""Compute at which steps of a training something happens (densification, opacity resets, SH degree, resolution).

The settings give steps for a training of `recipe_iterations` (30,000) iterations. They are multiplied by
iterations / recipe_iterations. This module does not import torch, because reports use it too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # config.py needs hydra, which a machine that checks kernels may lack
    from gsbench.config import TrainConfig

# Two intervals are not scaled to the length of the run. Clones need `densify.every` steps to move apart, and Adam needs
# this many steps after a reset to raise opacities again at its learning rate of 0.05.
STEPS_BETWEEN_RESETS = 300

# Largest number of rounds of densification; a run of 7,400 iterations has as many. On trex, 145 rounds gave three times
# as many Gaussians and a lower PSNR on val (docs/tuning.md).
MOST_ROUNDS = 36

# The step, in a run of 30,000, after which Gaussians with small blend weights are removed, if densification is over.
THIN = 15_600
# The step, in a run of 30,000, after which a gate simplifies Gaussians, if densification is over and STEPS_TO_RECOVER
# steps are left. With 120 steps left of 300, PSNR was 0.4 dB lower.
GATE = 18_000
STEPS_TO_RECOVER = 300
# The share of the steps after which model=auto compares its candidates on val (effects.compare). The number of
# Gaussians no longer grows then. A choice after 50 % of the steps lost 0.16 dB more, after 100 % 0.07 dB less.
COMPARE = 0.7


@dataclass(frozen=True)
class ActiveComponents:
    """Which parts of a model act and learn at a step."""

    sh_degree: int
    refine: bool  # AGR changes the Gaussians and learns
    tunes_lambda: bool  # lambda_t and lambda_d learn
    warms_up: bool = False  # the model's first stage, in which it may be static (`GaussianModel.warm_up`)


class Schedule:
    """Say what happens at each step of a training, counted from 0."""

    def __init__(self, config: TrainConfig, sh_degree: int, agr: bool, warm_up: float = 0.0) -> None:
        """Convert the steps in the settings, given for `recipe_iterations` iterations, to steps of this run.

        `sh_degree` is the final SH degree, and `warm_up` the share of the run after which the model's warm-up ends.
        """
        self.config = config
        self.warm_up = round(warm_up * config.iterations)
        self.sh_degree = sh_degree
        self.agr = agr
        densify = config.densify
        self.densify_start = self.scaled(densify.start)
        self.densify_stop = self.scaled(densify.stop)
        window, rounds = self.densify_stop - self.densify_start, densify.rounds or MOST_ROUNDS
        self.densify_every = max(densify.every, math.ceil(window / rounds))
        # The numbers of finished steps after which opacities are reset, the last half an interval before densification
        # ends, or earlier.
        self.reset_every, self.resets_after = math.inf, range(0)
        if densify.reset_every is not None:
            every = self.reset_every = max(self.scaled(densify.reset_every), STEPS_BETWEEN_RESETS)
            self.resets_after = range(every, self.densify_stop - every // 2 + 1, every)

    def scaled(self, step: int) -> int:
        """Scale a step of the settings to the length of this run; at least 1."""
        return max(1, round(step * self.config.iterations / self.config.recipe_iterations))

    def active(self, step: int) -> ActiveComponents:
        """Return which parts of the model act and learn at a step."""
        return ActiveComponents(
            sh_degree=min(self.sh_degree, step // self.scaled(self.config.sh_every)),
            refine=self.agr and step >= self.scaled(self.config.refine_from),
            tunes_lambda=step >= self.scaled(self.config.lambda_from),
            warms_up=step < self.warm_up,
        )

    def is_complete(self, step: int) -> bool:
        """Return whether all parts of the model that act at the last step act at this one."""
        now, last = self.active(step), self.active(self.config.iterations - 1)
        return (now.sh_degree, now.refine, now.warms_up) == (last.sh_degree, last.refine, last.warms_up)

    def densifies(self, step: int) -> bool:
        """Return whether Gaussians are cloned, split and pruned after a step."""
        done = step + 1
        return self.densify_start < done <= self.densify_stop and done % self.densify_every == 0

    def resets(self, step: int) -> bool:
        """Return whether all opacities are lowered after a step."""
        return step + 1 in self.resets_after

    def has_reset(self, step: int) -> bool:
        """Return whether opacities were reset before a step; from then on Gaussians that are too large are pruned."""
        return step + 1 > self.reset_every

    def resolution(self, step: int) -> int:
        """Return the factor by which the training images are reduced at a step; 1 is full resolution."""
        coarse = self.config.coarse or []
        return next((factor for factor, until in coarse if step < self.scaled(until)), 1)

    def most_gaussians(self, step: int, limit: int) -> int:
        """Return how many Gaussians a model may have after the round of densification at a step.

        At full resolution this is `limit`. At resolution 1 / s it is divided by s^(2 - step / densify_stop), because
        a smaller image shows less detail (DashGaussian, section 4.2).
        """
        return math.ceil(limit / self.resolution(step) ** (2 - step / self.densify_stop))

    def within(self, step: int, start: int, stop: int | None) -> bool:
        """Return whether a step lies between `start` and `stop` of the settings; a `stop` of None is the end."""
        return self.scaled(start) <= step + 1 and (stop is None or step + 1 <= self.scaled(stop))

    def thins(self, step: int) -> bool:
        """Return whether Gaussians with small blend weights are removed after a step, once after densification."""
        return self.config.densify.thin_to is not None and step + 1 == max(self.scaled(THIN), self.densify_stop)

    def gates(self, step: int) -> bool:
        """Return whether Gaussians are simplified after a step: once, if at least STEPS_TO_RECOVER steps are left."""
        at = max(self.scaled(GATE), self.densify_stop)
        return step + 1 == at and self.config.iterations - at >= STEPS_TO_RECOVER

    @property
    def compares_after(self) -> int:
        """Return the number of finished steps after which model=auto compares its candidates on val.

        This is the first measurement on val after 70 % of the steps and after densification.
        """
        least = max(round(COMPARE * self.config.iterations), self.densify_stop)
        return next(
            (done for done in range(least, self.config.iterations) if self.measures(done - 1)), self.config.iterations
        )

    def measures(self, step: int) -> bool:
        """Return whether PSNR on val is measured after a step for the training curve; always after the last step."""
        points = max(1, self.config.curve_points)  # of the curve, evenly spaced
        done, total = step + 1, self.config.iterations
        return done == total or done * points // total != step * points // total  # a point lies at or before `done`
