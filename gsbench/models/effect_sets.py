"""Sort the Gaussians of a model into classes, by the effects that each pays for.

A Gaussian of a class without an effect has entries among its parameters that change no image: the motion of one that is
still, the harmonics above its order. They are constant, learn nothing, and are not stored.
"""

from typing import NamedTuple

from torch import Tensor

TIME, DIRECTION = 1, 2  # in Classes.frozen
NAMES = ("refined", "sliced", "time", "direction", "still")  # of classes, by what AGR, slicing or freezing does to them


class Classes(NamedTuple):
    """Which rows of a model pay for which effect: rows are ordered refined (AGR) | sliced | still."""

    refined: int  # this many first rows are moved by AGR
    sliced: int  # this many first rows (refined <= sliced) change with the query; the others are still
    levels: Tensor | None  # [N] int32: the order of a row's colours, packed as by `ColorOrder`; None: the whole
    frozen: Tensor | None = None  # [N] uint8: TIME + DIRECTION, what a sliced row does not change with; None: nothing
    spans: Tensor | None = None  # [refined, 2] clips: AGR moves a row only from a first to a last time; None: always

    def by_name(self, rows: int) -> dict[str, int]:
        """Count the Gaussians of each class, by the names of NAMES, among so many rows."""
        frozen = [0, 0] if self.frozen is None else [int((self.frozen == bit).sum()) for bit in (TIME, DIRECTION)]
        sliced = self.sliced - self.refined - sum(frozen)
        return dict(zip(NAMES, (self.refined, sliced, *frozen, rows - self.sliced), strict=True))
