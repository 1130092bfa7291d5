"""Keep each effect of each Gaussian only where it pays: choose variants under a budget of error, and apply them.

For every Gaussian the variant is chosen that minimises time + lambda error, its frame time and the error that
gsbench.effects.strength predicts for it; lambda is such that the errors add up to the budget. One rule decides about
time, direction, AGR, harmonics and existence, and its unit is error for milliseconds.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from gsbench.effects.strength import Strength
from gsbench.models import GaussianModel
from gsbench.models.base import Classes
from gsbench.models.variants import LIVE, REMOVED, SLICED, STILL

# Nanoseconds that a Gaussian adds to a frame (EPYC Zen 4, AVX-512, one thread; benchmarks/effects.py). They are
# constants, and not measured anew, so that the same seed chooses the same Gaussians on every machine.
REFINING = 195.0
SLICING, SLICING_STILL = 28.0, 8.0
COLORING = {0: 13.0, 1: 19.0, 2: 23.0, 3: 28.0}  # by degree, for each frequency of time
RASTERIZING = 60.0
LESS_TO_READ = 1.0  # a frozen variable among others saves no arithmetic, only parameters
BISECTIONS = 60


@dataclass(frozen=True)
class Choice:
    """The variant of each Gaussian."""

    names: list[str]  # of the variants of geometry
    geometry: Tensor  # [N] int64, a place in `names`
    levels: Tensor  # [N] int32 of colours, see Classes.levels
    predicted: float  # error that the choice adds, as a share of the model's own

    def rows(self, name: str) -> Tensor:
        """Tell which Gaussians became this variant, [N] bool."""
        return self.geometry == self.names.index(name) if name in self.names else torch.zeros_like(self.geometry).bool()


def choose(strength: Strength, model: GaussianModel, budget: float) -> Choice:
    """Choose the cheapest variants whose predicted errors add up to at most a share of the model's own error.

    Args:
        strength: of the model's variants.
        model: whose they are.
        budget: a share, such as 0.01, which is 0.043 dB.
    """
    like = model.splats["opacities"].detach()
    nothing = torch.zeros_like(like)
    refines = model.refinement is not None and model.phase.refine
    geometry = {LIVE: nothing} | {v.name: strength.errors[v.name] for v in strength.variants if v.level is None}
    full = model.full_level()
    colors = {full: nothing} | {v.level: strength.errors[v.name] for v in strength.variants if v.level is not None}
    costs = {name: cost_of(name, refines) for name in geometry}
    repaint = {level: COLORING[level % 4] * (level // 4 + 1) for level in colors}

    def decide(price: float) -> tuple[Tensor, Tensor, Tensor]:
        """Choose for a price of error; return the two choices and the error of each Gaussian, [N]."""
        hue = torch.stack([repaint[level] + price * error for level, error in colors.items()])
        best_hue, level = hue.min(0)
        form = torch.stack([costs[name] + price * error + (0.0 if name == REMOVED else best_hue)
                            for name, error in geometry.items()])  # fmt: skip
        shape = form.argmin(0)
        error = torch.stack(list(geometry.values())).gather(0, shape[None])[0]
        painted = torch.stack(list(colors.values())).gather(0, level[None])[0]
        removed = shape == list(geometry).index(REMOVED)
        return shape, level, error + torch.where(removed, 0.0, painted)

    limit = budget * strength.total
    low, high = -60.0, 60.0  # of log2 of the price
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        low, high = (low, middle) if float(decide(2.0**middle)[2].sum()) <= limit else (middle, high)
    shape, level, error = decide(2.0**high)
    levels = torch.tensor(list(colors), dtype=torch.int32, device=like.device)[level]
    return Choice(list(geometry), shape, levels, float(error.sum()) / max(strength.total, 1e-300))


def cost_of(name: str, refines: bool) -> float:
    """Return the nanoseconds of a variant of geometry in a frame, colours not counted."""
    own = {
        LIVE: SLICING + (REFINING if refines else 0.0),
        SLICED: SLICING,
        STILL: SLICING_STILL,
        REMOVED: -RASTERIZING,
    }
    return RASTERIZING + own.get(name, SLICING - LESS_TO_READ)


@torch.no_grad()
def apply(model: GaussianModel, strength: Strength, choice: Choice) -> Tensor:
    """Turn each Gaussian of a model into its variant, drop the removed ones, sort the others by class.

    Returns the rows [M] that the model's Gaussians had before.
    """
    by_name = {variant.name: variant for variant in strength.variants}
    for name in choice.names:
        raw, rows = by_name[name].raw if name in by_name else None, choice.rows(name)
        for key, value in (raw or {}).items():
            model.splats[key].data[rows] = value[rows]
    full = model.full_level()
    for variant in strength.variants:
        rows = choice.levels == variant.level if variant.level is not None else None
        if rows is not None and variant.raw is not None:
            for key, value in variant.raw.items():
                model.splats[key].data[rows] = value[rows]
    refines = model.refinement is not None and model.phase.refine
    kind = torch.ones_like(choice.geometry)
    kind[choice.rows(LIVE)] = 0 if refines else 1
    kind[choice.rows(STILL)] = 2
    # The order within a class is by level and then as before, so that equal work lies together.
    rank = kind * 64 + (full - choice.levels)
    rank[choice.rows(REMOVED)] = -1
    order = rank.argsort(stable=True)
    rows = order[rank[order] >= 0]
    model.select(rows)
    counts = kind[rows]
    model.classes = Classes(int((counts == 0).sum()), int((counts < 2).sum()), choice.levels[rows])
    return rows
