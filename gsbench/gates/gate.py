"""Choose a simplification for each Gaussian of a model, and apply it.

A simplified Gaussian is independent of time, direction or AGR (the neural refinement), has a lower SH degree, or is
removed. For each Gaussian, the rule chooses the simplification that minimises cost + lambda error. The cost is the
rendering time of the Gaussian in a frame, and the error is the predicted growth of the images' squared error
(gsbench.gates.sensitivity). lambda is the same for all Gaussians. It is chosen so that the errors add up to a given
bound.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from gsbench.gates.sensitivity import Sensitivity
from gsbench.models import GaussianModel
from gsbench.models.appearance import MOST_PACKED, at_most, order_of
from gsbench.models.effect_sets import DIRECTION, TIME, EffectSets
from gsbench.models.gated import GatedModel
from gsbench.models.simplifications import CONDITIONED, LIVE, REMOVED, STATIC

# Nanoseconds that a Gaussian adds to a frame, as measured on an EPYC Zen 4 (AVX-512, one thread, 5,300 Gaussians at
# 80 x 80). They are constants, so that the same seed chooses the same Gaussians on every machine.
REFINING = 195.0  # AGR
SLICING = 28.0
COSTS = {CONDITIONED: SLICING, STATIC: 8.0, REMOVED: -60.0}  # without the 60 that the rasterizer takes for a Gaussian
COLORING = (13.0, 19.0, 23.0, 28.0)  # by SH degree, for each frequency of time
LESS_TO_READ = 1.0  # saved if a Gaussian depends on only one of time and direction: it has fewer parameters to read
BITS = {"time": TIME, "direction": DIRECTION}
BISECTIONS = 32


@dataclass(frozen=True)
class ChosenSimplifications:
    """Hold the simplification that was chosen for each Gaussian, such as independent of time, and the total error."""

    geometry: dict[str, Tensor]  # for each simplification by name: which Gaussians it is chosen for, [N] bool
    orders: Tensor  # [N] int32: SH degree and frequencies of each colour, as in `ColorOrder`
    predicted: float  # predicted squared error that is added, as a share of the model's squared error


def choose(sensitivity: Sensitivity, model: GaussianModel, budget: float) -> ChosenSimplifications:
    """Choose a simplification for each Gaussian so that the predicted errors add up to at most a given bound.

    A simplified Gaussian is independent of time, direction or AGR (the neural refinement), has a lower SH degree, or is
    removed.

    For Gaussian i, the simplification s minimises cost(i, s) + lambda error(i, s). The cost is the Gaussian's rendering
    time in a frame (COSTS, COLORING), and the error is the predicted growth of the images' squared error. Bisection
    finds the smallest lambda for which the errors stay within the bound.

    Args:
        sensitivity: the predicted error of each simplification of each Gaussian.
        model: the model for which the errors were predicted.
        budget: the bound, as a share of the model's squared error. For example 0.01 is a loss of 0.043 dB of PSNR.
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
        """Return each Gaussian's best simplification (such as no time) and its error, if lambda weights the errors."""
        shade, hue = (shading + price * hues).min(0)
        _, form = (costs + price * forms + torch.where(removes, 0.0, shade)).min(0)  # argmin takes 8 to 30 times longer
        error = forms.gather(0, form[None])[0] + hues.gather(0, hue[None])[0] * ~removes[form, 0]
        return form, hue, error

    low, high = -60.0, 60.0  # bounds of log2(lambda)
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
    """Return the nanoseconds that conditioning and AGR (a network) take for each Gaussian in a frame, [N]."""
    like = model.splats["opacities"].detach()
    cost = torch.full_like(like, COSTS[STATIC])
    cost[: now.conditioned] = SLICING
    assert now.frozen is not None
    cost -= LESS_TO_READ * (now.frozen > 0)
    cost[: now.refined] += REFINING
    return cost


def cost_of(model: GaussianModel) -> Tensor:
    """Return the nanoseconds that conditioning, AGR (a network) and colour take for each Gaussian in a frame, [N]."""
    now = effect_sets_of(model)
    assert now.orders is not None
    return _live_cost(model, now) + _shading(now.orders)


def most_cost(model: GaussianModel) -> float:
    """Return the nanoseconds that a Gaussian with conditioning, AGR (a network) and full SH degree takes in a frame."""
    return REFINING + SLICING + float(_shading(torch.tensor(model.full_order())))


def _shading(orders: Tensor) -> Tensor:
    """Return the nanoseconds to evaluate colours with the SH degrees and frequencies in time that `orders` encodes."""
    order = order_of(orders)
    return torch.tensor(COLORING, device=orders.device)[order.degree] * order.waves


def effect_sets_of(model: GaussianModel) -> EffectSets:
    """Return what each Gaussian of a model depends on: time, direction, AGR (neural refinement), and its SH degree."""
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
    """Simplify each Gaussian of a model as chosen, and sort the Gaussians by what they still depend on.

    A simplified Gaussian is independent of time, direction or AGR (the neural refinement), has a lower SH degree, or is
    removed.

    Args:
        model: the model, which is changed in place.
        sensitivity: the parameters of each simplified Gaussian.
        choice: the simplification of each Gaussian, from `choose`.
        intervals: the first and the last time at which AGR changes each Gaussian.

    Returns:
        The former index of each remaining Gaussian, [M], and whether it was simplified, [M] bool.
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
    # Gaussians are sorted by the effects that remain, then by the order of their colours, so that neighbours need the
    # same work. Otherwise their order does not change.
    rank = (kind * 4 + frozen) * (MOST_PACKED + 1) + MOST_PACKED - choice.orders
    if intervals is None:
        order = rank.argsort(stable=True)
    else:  # Gaussians that AGR changes at the same times are neighbours too, so that whole warps of a GPU can skip
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
