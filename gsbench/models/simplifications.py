"""Simplify the Gaussians of a model: bake AGR in, freeze time or direction, remove harmonics.

A simplified Gaussian is an ordinary row of the model's parameters, so every model, backend and checkpoint can use it.
A frozen value is the mean over given queries, weighted by the Gaussian's opacity at each of them.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gsbench.models.base import GaussianModel, Gaussians3D, Raw
from gsbench.models.effect_sets import EffectSets
from gsbench.models.gated import GatedModel
from gsbench.models.query import Query
from gsbench.process.workers import side_by_side
from gsbench.scenes.points import SH_C0

LIVE, CONDITIONED, STATIC, REMOVED = "live", "conditioned", "static", "removed"
FEW = 1e-6  # added to weights: a Gaussian that no query sees is averaged over all


@dataclass(frozen=True)
class Simplification:
    """All Gaussians of a model, simplified in one way."""

    name: str
    raw: Raw | None  # the raw parameters that change; None: the Gaussian is removed
    rows: int  # only this many first rows change: effect sets that are behind them have nothing of this to lose
    order: int | None = None  # of the harmonics that are left (see EffectSets.orders), where only the colour changes


def simplifications_of(
    model: GatedModel, queries: Sequence[Query], slices: Sequence[Gaussians3D], by_halves: bool = True
) -> list[Simplification]:
    """List the ways to simplify the Gaussians of a model.

    Args:
        model: as it is.
        queries: of the views over which frozen values are averaged.
        slices: of the model at the queries; their opacities are the weights.
        by_halves: whether time or direction alone may be frozen.
    """
    weights = shares_of([one.opacities for one in slices])
    found = []
    names = (*model.centers, *model.geometry)
    raw: Raw = {name: value.detach() for name, value in model.splats.items()}
    fewer = {order: raw | {"shN": raw["shN"] * model.kept(EffectSets(0, 0, _all(model, order)))["shN"]}
             for order in model.lower_orders()}  # fmt: skip
    rows = model.count_by_effects()
    conditioned = len(model) - rows["static"]
    refined, lost = _averages(model, queries, slices, weights, names if rows["refined"] else (), list(fewer.values()))
    raw = raw | refined
    if rows["refined"]:
        found.append(Simplification(CONDITIONED, refined, rows["refined"]))
    for name, frozen in model.frozen(raw, queries, weights).items():
        if name != STATIC and not by_halves:
            continue
        found.append(Simplification(name, {key: raw[key] for key in names} | frozen, conditioned))
    found.append(Simplification(REMOVED, None, len(model)))
    for (order, less), missing in zip(fewer.items(), lost, strict=True):
        constant = less["sh0"].clone()
        constant.flatten(1, -2)[:, 0] += missing / SH_C0
        found.append(Simplification(f"order{order}", {"sh0": constant, "shN": less["shN"]}, len(model), order))
    return found


def shares_of(opacities: Sequence[Tensor]) -> Tensor:
    """Return the weights [V, N] of queries, from the opacities of their slices; each Gaussian's sum to 1."""
    weights = torch.stack(list(opacities)) + FEW
    return weights / weights.sum(0)


def _all(model: GaussianModel, order: int) -> Tensor:
    """Return one order of colour for all Gaussians, [N]."""
    return torch.full((len(model),), order, dtype=torch.int32, device=model.splats["means"].device)


def _averages(
    model: GaussianModel, queries: Sequence[Query], slices: Sequence[Gaussians3D], weights: Tensor,
    names: Sequence[str], fewer: Sequence[Raw],
) -> tuple[Raw, list[Tensor]]:  # fmt: skip
    """Average over the queries the raw parameters after AGR, and the colour [N, 3] that fewer harmonics lose.

    Args:
        model: as it is.
        queries: V of them.
        slices: at the queries.
        weights: [V, N].
        names: of the raw parameters that AGR moves; none without AGR.
        fewer: raw parameters with fewer harmonics.
    """

    def at(v: int) -> list[Tensor]:
        moved, seen, weight = model.refined(queries[v]), slices[v], weights[v][:, None]
        colors = [model.shade(moved | {"shN": less["shN"]}, seen.means, seen.opacities, queries[v]) for less in fewer]
        return [weight * moved[name] for name in names] + [weight * (seen.colors - others) for others in colors]

    workers = model.backend.workers(weights)
    total = functools.reduce(_add, side_by_side(at, range(len(queries)), workers))
    return dict(zip(names, total, strict=False)), total[len(names) :]


def _add(total: list[Tensor], more: list[Tensor]) -> list[Tensor]:
    for one, other in zip(total, more, strict=True):
        one += other
    return total
