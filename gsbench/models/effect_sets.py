"""Record which effects (time, direction, AGR, higher SH degrees) each Gaussian of a model keeps.

If a Gaussian lacks an effect, some of its parameters change no image, for example the motion of a static Gaussian.
These parameters are constant, do not learn, and are not stored.
"""

from typing import NamedTuple

from torch import Tensor

TIME, DIRECTION = 1, 2  # in EffectSets.frozen
NAMES = ("refined", "conditioned", "time", "direction", "static")  # the sets of effects that a Gaussian may have


class EffectSets(NamedTuple):
    """Record which effects each Gaussian has.

    Gaussians are sorted: first those that AGR, the neural refinement, changes (refined), then those that change with
    time or direction but not through AGR (conditioned), then the static ones.
    """

    refined: int  # AGR changes the first `refined` Gaussians
    conditioned: int  # the first `conditioned` >= `refined` Gaussians change with time or direction
    orders: Tensor | None  # [N] int32: SH degree and frequencies of each colour, as in `ColorOrder`; None: all
    frozen: Tensor | None = None  # [N] uint8: TIME + DIRECTION, variables that a row does not depend on; None: nothing
    intervals: Tensor | None = None  # [refined, 2]: the first and last time at which AGR changes a row; None: always

    def by_name(self, rows: int) -> dict[str, int]:
        """Return the number of Gaussians with each set of effects, keyed by NAMES; `rows` is the number of all."""
        frozen = [0, 0] if self.frozen is None else [int((self.frozen == bit).sum()) for bit in (TIME, DIRECTION)]
        conditioned = self.conditioned - self.refined - sum(frozen)
        return dict(zip(NAMES, (self.refined, conditioned, *frozen, rows - self.conditioned), strict=True))
