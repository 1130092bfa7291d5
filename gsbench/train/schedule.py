"""When things happen: the one rule that makes a run of any length the same recipe, and the order views are seen in."""

import torch

from gsbench.config import TrainConfig
from gsbench.models import Phase

# What an interval waits for takes a number of steps, not a part of the run. So `densify.every` does not scale, and
# resets are never closer than Adam, at its rate of 0.05, needs to raise opacities again.
STEPS_BETWEEN_RESETS = 300


class Schedule:
    """Steps of a `recipe_iterations` run, scaled to this one: step x iterations / recipe_iterations, rounded."""

    def __init__(self, config: TrainConfig, sh_degree: int, agr: bool) -> None:
        """Scale `config` to its own length, for a model of that full degree, with or without AGR."""
        self.config = config
        self.sh_degree = sh_degree
        self.agr = agr
        densify = config.densify
        self.densify_start = self.scaled(densify.start)
        self.densify_stop = self.scaled(densify.stop)
        self.densify_every = densify.every
        self.reset_every = max(self.scaled(densify.reset_every), STEPS_BETWEEN_RESETS)

    def scaled(self, step: int) -> int:
        """A step of the recipe in this run; at least 1."""
        return max(1, round(step * self.config.iterations / self.config.recipe_iterations))

    def phase(self, step: int) -> Phase:
        """What of the model is on at a step, counted from 0."""
        return Phase(
            sh_degree=min(self.sh_degree, step // self.scaled(self.config.sh_every)),
            refine=self.agr and step >= self.scaled(self.config.refine_from),
            tune_modulation=step >= self.scaled(self.config.modulation_from),
        )

    def densifies(self, step: int) -> bool:
        """Whether Gaussians are cloned, split and pruned after a step (3DGS: after 500, every 100, until 15,000)."""
        done = step + 1
        return self.densify_start < done <= self.densify_stop and done % self.densify_every == 0

    def resets(self, step: int) -> bool:
        """Whether opacities are reset after a step: while densifying, and only with time left to recover."""
        done = step + 1
        return done % self.reset_every == 0 and done + self.reset_every // 2 <= max(self.densify_stop, 1)

    def has_reset(self, step: int) -> bool:
        """Whether an opacity reset lies behind, from when on Gaussians too large are pruned."""
        return step + 1 > self.reset_every

    def measures(self, step: int) -> bool:
        """Whether a point of the curve is taken after a step; the last step always is."""
        points = max(1, self.config.curve_points)
        done, total = step + 1, self.config.iterations
        return done == total or done * points // total != step * points // total


def batch(step: int, views: int, batch_size: int, seed: int) -> list[int]:
    """Numbers of the views seen at a step: every view once an epoch, in an order drawn from (seed, epoch).

    A function of its arguments alone, so that a resumed run sees what an unbroken one would have.
    """
    chosen = []
    for position in range(step * batch_size, (step + 1) * batch_size):
        epoch, place = divmod(position, views)
        chosen.append(int(torch.randperm(views, generator=generator(seed, epoch))[place]))
    return chosen


def generator(seed: int, *purpose: int) -> torch.Generator:
    """A random stream of its own for a run's seed and a purpose, such as a step's number."""
    mixed = 0
    for number in (seed, *purpose):
        mixed = (mixed * 6364136223846793005 + number + 1442695040888963407) % (1 << 63)
    return torch.Generator().manual_seed(mixed)
