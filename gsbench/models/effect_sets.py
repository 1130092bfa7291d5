"""Sort the Gaussians of a model into effect sets: the effects that each of them has.

If a Gaussian lacks an effect, some of its parameters change no image: the motion of a static one, the harmonics above
its order. They are constant, do not learn, and are not stored.
"""

from typing import NamedTuple

from torch import Tensor

TIME, DIRECTION = 1, 2  # in EffectSets.frozen
NAMES = ("refined", "conditioned", "time", "direction", "static")  # by what AGR, slicing or freezing does to them


class EffectSets(NamedTuple):
    """The effects of each row of a model; rows are ordered refined (AGR) | conditioned | static."""

    refined: int  # this many first rows are moved by AGR
    conditioned: int  # this many first rows (refined <= conditioned) change with the query; the others are static
    orders: Tensor | None  # [N] int32: the order of a row's colours, packed as by `ColorOrder`; None: the whole
    frozen: Tensor | None = None  # [N] uint8: TIME + DIRECTION, what a row does not change with; None: nothing
    intervals: Tensor | None = None  # [refined, 2] clips: AGR moves a row from a first to a last time; None: always

    def by_name(self, rows: int) -> dict[str, int]:
        """Count by NAMES how many of the given number of Gaussians keep which effects."""
        frozen = [0, 0] if self.frozen is None else [int((self.frozen == bit).sum()) for bit in (TIME, DIRECTION)]
        conditioned = self.conditioned - self.refined - sum(frozen)
        return dict(zip(NAMES, (self.refined, conditioned, *frozen, rows - self.conditioned), strict=True))
