"""Remove effects that Gaussians do not need: choose simplifications within a budget of error, and apply them.

Every Gaussian takes the simplification that minimises time + lambda error. Here time is what the Gaussian costs in a
frame, and error is what gsbench.effects.sensitivity predicts. lambda, the same for all Gaussians, is such that the
errors add up to the budget. The same rule decides about time, direction, AGR, harmonics and removal.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from gsbench.effects.sensitivity import Sensitivity
from gsbench.models import GaussianModel
from gsbench.models.color_order import MOST_PACKED, at_most, order_of
from gsbench.models.effect_sets import DIRECTION, TIME, EffectSets
from gsbench.models.gated import GatedModel
from gsbench.models.simplifications import CONDITIONED, LIVE, REMOVED, STATIC

# Nanoseconds that a Gaussian adds to a frame, as measured on an EPYC Zen 4 (AVX-512, one thread, 5,300 Gaussians at
# 80 x 80). They are constants, so that the same seed chooses the same Gaussians on every machine.
REFINING = 195.0
SLICING = 28.0
COSTS = {CONDITIONED: SLICING, STATIC: 8.0, REMOVED: -60.0}  # beyond what a Gaussian takes in the rasterizer, 60
COLORING = (13.0, 19.0, 23.0, 28.0)  # by degree, for each frequency of time
LESS_TO_READ = 1.0  # a frozen variable among others saves no arithmetic, only parameters
BITS = {"time": TIME, "direction": DIRECTION}
BISECTIONS = 32


@dataclass(frozen=True)
class ChosenSimplifications:
    """The simplification of each Gaussian."""

    geometry: dict[str, Tensor]  # [N] bool by the name of a simplification: which Gaussians become it
    orders: Tensor  # [N] int32 of colours, see EffectSets.orders
    predicted: float  # error that the choice adds, as a share of the model's own


def choose(sensitivity: Sensitivity, model: GaussianModel, budget: float) -> ChosenSimplifications:
    """Choose the cheapest simplifications whose predicted errors add up to at most a share of the model's own error.

    Each Gaussian i takes the simplification s that minimises

        cost(i, s) + lambda error(i, s)

    with its nanoseconds of a frame (COSTS, COLORING) and its predicted squared error (`Sensitivity.errors`). Bisection
    finds the smallest lambda for which the errors add up to at most `budget` x `sensitivity.total`.

    Args:
        sensitivity: predicted errors of the model's simplifications.
        model: the model of `sensitivity`; effects may have been removed from it before.
        budget: the share of the model's squared error that may be added, such as 0.01, which costs 0.043 dB of PSNR.
    """
    now = effect_sets_of(model)
    live = _live_cost(model, now)
    none = torch.zeros_like(live)
    ways, errors = sensitivity.simplifications, sensitivity.errors
    geometry = {LIVE: none} | {way.name: errors[way.name] for way in ways if way.order is None}
    costs = torch.stack([live if name == LIVE else torch.minimum(live, none + COSTS.get(name, SLICING - LESS_TO_READ))
                         for name in geometry])  # fmt: skip
    forms = torch.stack(list(geometry.values()))
    removes = torch.tensor([name == REMOVED for name in geometry], device=live.device)[:, None]
    assert now.orders is not None
    orders = torch.stack([now.orders] + [at_most(now.orders, way.order) for way in ways if way.order is not None])
    hues = torch.stack([none] + [errors[way.name] for way in ways if way.order is not None])
    shading = _shading(orders)

    def decide(price: float) -> tuple[Tensor, Tensor, Tensor]:
        """Choose for one lambda; return the choices of geometry and colour, and the error of each Gaussian."""
        shade, hue = (shading + price * hues).min(0)
        _, form = (costs + price * forms + torch.where(removes, 0.0, shade)).min(0)  # argmin takes 8 to 30 times longer
        error = forms.gather(0, form[None])[0] + hues.gather(0, hue[None])[0] * ~removes[form, 0]
        return form, hue, error

    low, high = -60.0, 60.0  # of log2 of the price
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        within = float(decide(2.0**middle)[2].sum()) <= budget * sensitivity.total
        low, high = (low, middle) if within else (middle, high)
    form, hue, error = decide(2.0**high)
    chosen = {name: form == i for i, name in enumerate(geometry)}
    return ChosenSimplifications(
        chosen, orders.gather(0, hue[None])[0], float(error.sum()) / max(sensitivity.total, 1e-300)
    )


def _live_cost(model: GaussianModel, now: EffectSets) -> Tensor:
    """Return the nanoseconds of a frame that each Gaussian takes, without its colour and rasterization, [N]."""
    like = model.splats["opacities"].detach()
    cost = torch.full_like(like, COSTS[STATIC])
    cost[: now.conditioned] = SLICING
    assert now.frozen is not None
    cost -= LESS_TO_READ * (now.frozen > 0)
    cost[: now.refined] += REFINING
    return cost


def cost_of(model: GaussianModel) -> Tensor:
    """Return the nanoseconds of a frame that each Gaussian takes, with its colour, without rasterization, [N]."""
    now = effect_sets_of(model)
    assert now.orders is not None
    return _live_cost(model, now) + _shading(now.orders)


def most_cost(model: GaussianModel) -> float:
    """Return the nanoseconds that a Gaussian with every effect of this model adds to a frame."""
    return REFINING + SLICING + float(_shading(torch.tensor(model.full_order())))


def _shading(orders: Tensor) -> Tensor:
    """Return the nanoseconds to evaluate each colour; `orders` pack its harmonic degree and Fourier order."""
    order = order_of(orders)
    return torch.tensor(COLORING, device=orders.device)[order.degree] * order.waves


def effect_sets_of(model: GaussianModel) -> EffectSets:
    """Return which effects each Gaussian of a model keeps; all that the model has if none was removed."""
    if model.effect_sets is not None:
        return model.effect_sets
    rows = model.count_by_effects()
    conditioned = rows["refined"] + rows["conditioned"]
    device = model.splats["opacities"].device
    orders = torch.full((len(model),), model.full_order(), dtype=torch.int32, device=device)
    return EffectSets(rows["refined"], conditioned, orders, torch.zeros(len(model), dtype=torch.uint8, device=device))


@torch.no_grad()
def apply(
    model: GatedModel,
    sensitivity: Sensitivity,
    choice: ChosenSimplifications,
    intervals: Tensor | None = None,  # [N, 2]
) -> tuple[Tensor, Tensor]:
    """Simplify each Gaussian of a model, drop the removed ones, and sort the others by the effects that they keep.

    Args:
        model: the model to change in place.
        sensitivity: predicted errors of the model's simplifications.
        choice: the simplification of each Gaussian, from `choose`.
        intervals: the times at which each Gaussian can be seen, see `EffectSets.intervals`.

    Returns:
        The former rows [M] of the Gaussians that are left, and whether each of them was changed, [M] bool.
    """
    now = effect_sets_of(model)
    assert now.orders is not None
    assert now.frozen is not None
    for simplification in sensitivity.simplifications:
        if simplification.raw is None:
            continue
        rows = choice.geometry[simplification.name] if simplification.order is None else (
            (choice.orders != now.orders) & (choice.orders == at_most(now.orders, simplification.order)))  # fmt: skip
        for key, value in simplification.raw.items():
            model.splats[key].data[rows] = value[rows]
    place = torch.arange(len(model), device=now.orders.device)
    refined, static = place < now.refined, place >= now.conditioned
    frozen = now.frozen.clone()
    for name, rows in choice.geometry.items():
        if name != LIVE:
            refined = refined & ~rows
        if name in BITS:
            frozen[rows] |= BITS[name]
    frozen[now.conditioned :] = 0
    static = static | choice.geometry.get(STATIC, torch.zeros_like(static)) | (frozen == sum(BITS.values()))
    frozen[static] = 0
    kind = torch.where(refined, 0, torch.where(static, 2, 1))
    # Rows of an effect set are sorted by what is frozen and by the order of their colours, and otherwise stay where
    # they are: equal work lies together.
    rank = (kind * 4 + frozen) * (MOST_PACKED + 1) + MOST_PACKED - choice.orders
    if intervals is None:
        order = rank.argsort(stable=True)
    else:  # those that AGR moves at the same times lie together too: a GPU's warps rest as a whole
        order = intervals[:, 0].argsort(stable=True)
        order = order[rank[order].argsort(stable=True)]
    rows = order[~choice.geometry[REMOVED][order]]
    changed = (~choice.geometry[LIVE] | (choice.orders != now.orders))[rows]
    model.select(rows)
    counts = [int((kind[rows] <= most).sum()) for most in (0, 1)]
    own = now.intervals if intervals is None else intervals
    own = None if own is None else own[rows[: counts[0]]].contiguous()
    model.effect_sets = EffectSets(
        counts[0], counts[1], choice.orders[rows].contiguous(), frozen[rows].contiguous(), own
    )
    model.fill(model.effect_sets)
    return rows, changed
