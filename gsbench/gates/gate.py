"""Choose a simplification for each Gaussian of a model, and apply as many as a loss of PSNR allows.

A simplified Gaussian is independent of AGR (the neural refinement), or also of time and direction, has a lower SH
degree, or is removed. For each Gaussian i, the rule takes the simplification s that minimises cost(i, s) + lambda
error(i, s). The cost is the rendering time of the Gaussian in a frame, and the error is the predicted growth of the
images' squared error (gsbench.gates.sensitivity). lambda is the same for all Gaussians.
"""

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gsbench.gates.sensitivity import Sensitivity
from gsbench.measure.exact_views import decides
from gsbench.measure.record import Gate
from gsbench.models import GaussianModel
from gsbench.models.appearance import MOST_PACKED, at_most, order_of
from gsbench.models.effect_sets import EffectSets
from gsbench.models.gated import GatedModel
from gsbench.models.simplifications import CONDITIONED, LIVE, REMOVED, STATIC, Simplification

# Nanoseconds that a Gaussian adds to a frame, as measured on an EPYC Zen 4 (AVX-512, one thread, 5,300 Gaussians at
# 80 x 80). They are constants, so that the same seed chooses the same Gaussians on every machine.
REFINING = 195.0  # AGR
SLICING = 28.0
COSTS = {CONDITIONED: SLICING, STATIC: 8.0, REMOVED: -60.0}  # without the 60 that the rasterizer takes for a Gaussian
COLORING = (13.0, 19.0, 23.0, 28.0)  # by SH degree, for each frequency of time
BISECTIONS = 32
SHARES = (0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001)  # shares of the squared error, tried in this order
MOST_PREDICTED = 2.0  # the predicted loss of PSNR is at most this times the allowed one: few views may underestimate it


@dataclass(frozen=True)
class ChosenSimplifications:
    """The simplification that was chosen for each Gaussian."""

    # [N] bool: for which Gaussians each simplification is chosen, by its name; LIVE: for which none, or a colour's only
    geometry: dict[str, Tensor]
    orders: Tensor  # [N] int32: SH degree and frequencies of each colour, as in `ColorOrder`
    predicted: float  # predicted squared error that is added, as a share of the model's squared error


@dataclass(frozen=True)
class GatedCopy:
    """A simplified copy of a model."""

    model: GatedModel
    gate: Gate  # the decisions and measurements, for record.json
    rows: Tensor  # [M] the index of each Gaussian in the former model
    changed: Tensor  # [M] bool: whether the Gaussian was simplified


def gate_within(
    model: GatedModel,
    sensitivity: Sensitivity,
    budget_db: float,
    measure: Callable[[GaussianModel], float],
    intervals: Tensor | None = None,  # [N, 2]
) -> GatedCopy | None:
    """Simplify as many Gaussians as the allowed loss of PSNR permits.

    For each share in SHARES, from the largest, the function simplifies a copy of the model until the predicted errors
    add up to this share of the model's squared error. It returns the first copy whose measured loss of PSNR is allowed,
    or None. PSNR cannot decide, and the result is None, if it is capped in every view or not a number.

    Args:
        model: the model, which does not change.
        sensitivity: the predicted error of each simplification of each Gaussian.
        budget_db: the largest allowed loss of PSNR, dB.
        measure: returns the PSNR of a model in dB, on views that were not used for `sensitivity`.
        intervals: the first and the last time at which AGR changes each Gaussian.
    """
    before = measure(model)
    if not decides(before):
        return None
    for share in SHARES:
        if _loss_db(share) > MOST_PREDICTED * budget_db:
            continue
        gated = copy.deepcopy(model)
        choice = choose(sensitivity, gated, share)
        rows, changed = apply(gated, sensitivity.simplifications, choice, intervals)
        loss = before - measure(gated)
        if loss <= budget_db and len(gated):  # not all are removed
            counts = gated.count_by_effects() | {"removed": len(model) - len(gated)}
            gate = Gate(
                share=share,
                predicted_db=_loss_db(choice.predicted),
                measured_db=loss,
                rows=counts,
                orders=_count_by_order(gated),
                bytes_before=model.stored_bytes(),
                bytes=gated.stored_bytes(),
            )
            return GatedCopy(gated, gate, rows, changed)
    return None


def _loss_db(share: float) -> float:
    """Return the loss of PSNR if the squared error grows by a share of itself, dB."""
    return 10 * math.log10(1 + share)


def _count_by_order(model: GaussianModel) -> dict[str, int]:
    """Count the Gaussians by the SH degree of the colour, and in 4DGS by the colour's number of frequencies in time."""
    if model.effect_sets is None or model.effect_sets.orders is None:
        return {}
    values, counts = torch.unique(model.effect_sets.orders, return_counts=True)
    orders = map(order_of, values.tolist())
    names = [f"degree {order.degree}" + (f", {order.waves} waves" if order.waves > 1 else "") for order in orders]
    return dict(zip(names, counts.tolist(), strict=True))


def choose(sensitivity: Sensitivity, model: GaussianModel, budget: float) -> ChosenSimplifications:
    """Choose a simplification for each Gaussian so that the predicted errors add up to at most a bound.

    Bisection finds the smallest lambda for which the errors stay within the bound. A choice is one of G geometries
    (present, conditioned, static, removed), and independently one of K orders of the colour.

    Args:
        sensitivity: the predicted error of each simplification of each Gaussian of the model.
        model: the model, which does not change.
        budget: the bound, as a share of the model's squared error. For example 0.01 is a loss of 0.043 dB of PSNR.
    """
    now = effect_sets_of(model)
    live = _geometry_cost(model, now)
    zeros = torch.zeros_like(live)
    ways, errors = sensitivity.simplifications, sensitivity.errors
    errors_by_geometry = {LIVE: zeros} | {way.name: errors[way.name] for way in ways if way.order is None}
    names = list(errors_by_geometry)
    # A Gaussian that is cheaper already stays so: a static one does not become conditioned.
    costs = torch.stack([live if name == LIVE else torch.minimum(live, zeros + COSTS[name]) for name in names])
    geometry_errors = torch.stack(list(errors_by_geometry.values()))  # [G, N]; `costs` too
    removes = torch.tensor([name == REMOVED for name in names], device=live.device)[:, None]
    assert now.orders is not None
    orders = torch.stack([now.orders] + [at_most(now.orders, way.order) for way in ways if way.order is not None])
    order_errors = torch.stack([zeros] + [errors[way.name] for way in ways if way.order is not None])
    order_costs = _color_cost(orders)  # [K, N], as `orders` and `order_errors`

    def best(price: float) -> tuple[Tensor, Tensor, Tensor]:
        """Return the indices of each Gaussian's best geometry and order, and its error, if lambda is `price`."""
        # `min` gives the indices too; argmin takes 8 to 30 times longer.
        color_total, order = (order_costs + price * order_errors).min(0)  # [N]
        # The colour of a removed Gaussian costs nothing and adds no error.
        _, geometry = (costs + price * geometry_errors + torch.where(removes, 0.0, color_total)).min(0)
        order_error = order_errors.gather(0, order[None])[0] * ~removes[geometry, 0]
        return geometry, order, geometry_errors.gather(0, geometry[None])[0] + order_error

    low, high = -60.0, 60.0  # bounds of log2(lambda)
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        within = float(best(2.0**middle)[2].sum()) <= budget * sensitivity.total
        low, high = (low, middle) if within else (middle, high)
    geometry, order, error = best(2.0**high)
    chosen = {name: geometry == i for i, name in enumerate(names)}
    predicted = float(error.sum()) / max(sensitivity.total, 1e-300)
    return ChosenSimplifications(chosen, orders.gather(0, order[None])[0], predicted)


def cost_of(model: GaussianModel) -> Tensor:
    """Return the nanoseconds that conditioning, AGR and colour take for each Gaussian in a frame, [N]."""
    now = effect_sets_of(model)
    assert now.orders is not None
    return _geometry_cost(model, now) + _color_cost(now.orders)


def most_cost(model: GaussianModel) -> float:
    """Return the nanoseconds that a Gaussian with conditioning, AGR and full SH degree takes in a frame."""
    return REFINING + SLICING + float(_color_cost(torch.tensor(model.full_order())))


def _geometry_cost(model: GaussianModel, now: EffectSets) -> Tensor:
    """Return the nanoseconds that conditioning and AGR take for each Gaussian in a frame, [N]."""
    cost = torch.full_like(model.splats["opacities"].detach(), COSTS[STATIC])
    cost[: now.conditioned] = SLICING
    cost[: now.refined] += REFINING
    return cost


def _color_cost(orders: Tensor) -> Tensor:
    """Return the nanoseconds to evaluate colours of `orders` (see `ColorOrder`), in the same shape."""
    order = order_of(orders)
    return torch.tensor(COLORING, device=orders.device)[order.degree] * order.waves


def effect_sets_of(model: GaussianModel) -> EffectSets:
    """Return what each Gaussian of a model depends on; `orders` is not None."""
    if model.effect_sets is not None:
        return model.effect_sets
    rows = model.count_by_effects()
    conditioned = rows["refined"] + rows["conditioned"]
    opacities = model.splats["opacities"].detach()
    return EffectSets(rows["refined"], conditioned, torch.full_like(opacities, model.full_order(), dtype=torch.int32))


@torch.no_grad()
def apply(
    model: GatedModel,
    simplifications: Sequence[Simplification],
    choice: ChosenSimplifications,
    intervals: Tensor | None = None,  # [N, 2]
) -> tuple[Tensor, Tensor]:
    """Simplify each Gaussian of a model as chosen, and sort the Gaussians by what they still depend on.

    Args:
        model: the model, which is changed in place.
        simplifications: the parameters of each simplified Gaussian.
        choice: the simplification of each Gaussian, from `choose`.
        intervals: the first and the last time at which AGR changes each Gaussian.

    Returns:
        The former index of each remaining Gaussian, [M], and whether it was simplified, [M] bool.
    """
    now = effect_sets_of(model)
    assert now.orders is not None
    for way in simplifications:
        if way.raw is None:  # removed
            continue
        if way.order is None:
            chosen = choice.geometry[way.name]
        else:  # several limits may give the chosen order, and then the same colour
            chosen = (choice.orders != now.orders) & (choice.orders == at_most(now.orders, way.order))
        for key, value in way.raw.items():
            model.splats[key].data[chosen] = value[chosen]
    place = torch.arange(len(model), device=now.orders.device)
    static = (place >= now.conditioned) | choice.geometry.get(STATIC, torch.zeros_like(place, dtype=torch.bool))
    refined = (place < now.refined) & choice.geometry[LIVE]
    kind = torch.where(refined, 0, torch.where(static, 2, 1))  # 0: refined, 1: conditioned, 2: static
    # Gaussians are sorted by the effects that remain, then by the order of their colours, so that neighbours need the
    # same work. Otherwise their order does not change.
    rank = kind * (MOST_PACKED + 1) + MOST_PACKED - choice.orders
    if intervals is None:
        order = rank.argsort(stable=True)
    else:  # Gaussians that AGR changes at the same times are neighbours too, so that whole warps of a GPU can skip
        order = intervals[:, 0].argsort(stable=True)
        order = order[rank[order].argsort(stable=True)]
    rows = order[~choice.geometry[REMOVED][order]]
    changed = (~choice.geometry[LIVE] | (choice.orders != now.orders))[rows]
    model.select(rows)
    n_refined, n_conditioned = (int((kind[rows] <= last).sum()) for last in (0, 1))
    agr_times = now.intervals if intervals is None else intervals
    # `now.intervals` has only the formerly refined Gaussians; those that still are refined are among them.
    agr_times = None if agr_times is None else agr_times[rows[:n_refined]].contiguous()
    model.effect_sets = EffectSets(n_refined, n_conditioned, choice.orders[rows].contiguous(), agr_times)
    model.fill(model.effect_sets)
    return rows, changed
