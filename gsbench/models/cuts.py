"""Simplify the Gaussians of a model: bake AGR in, freeze time or direction, cut harmonics.

A simplified Gaussian is an ordinary row of the model's parameters, so every model, backend and checkpoint takes it.
What is frozen stays at its mean over given queries, weighted by the Gaussian's opacity at each of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gsbench.models.base import GaussianModel, Raw
from gsbench.models.classes import Classes
from gsbench.models.query import Query
from gsbench.scenes.points import SH_C0

LIVE, SLICED, STILL, REMOVED = "live", "sliced", "still", "removed"
FEW = 1e-6  # added to weights: a Gaussian that no query sees is averaged over all


@dataclass(frozen=True)
class Cut:
    """All Gaussians of a model, simplified in one way."""

    name: str
    raw: Raw | None  # the raw parameters that change; None: the Gaussian is removed
    level: int | None = None  # of the harmonics that are left (see Classes.levels), where only the colour changes


def cuts_of(
    model: GaussianModel, queries: Sequence[Query], opacities: Sequence[Tensor], by_halves: bool = True
) -> list[Cut]:
    """List the ways to simplify the Gaussians of a model.

    Args:
        model: as it is.
        queries: of the views over which what is frozen is averaged.
        opacities: [N] of the model's slices at the queries, the weights.
        by_halves: whether time or direction alone may be frozen.
    """
    weights = shares_of(opacities)
    found = []
    names = (*model.centers, *model.geometry)
    raw: Raw = {name: value.detach() for name, value in model.splats.items()}
    if model.refinement is not None and model.phase.refine:
        raw = raw | _baked(model, queries, weights, names)
        found.append(Cut(SLICED, {name: raw[name] for name in names}))
    for name, frozen in model.frozen(raw, queries, weights).items():
        if name != STILL and not by_halves:
            continue
        found.append(Cut(name, {key: raw[key] for key in names} | frozen))
    found.append(Cut(REMOVED, None))
    return found + [Cut(f"level{level}", _repainted(model, level, queries, opacities, weights), level)
                    for level in model.lower_levels()]  # fmt: skip


def shares_of(opacities: Sequence[Tensor]) -> Tensor:
    """Return the weights [V, N] of queries, from the opacities of their slices; each Gaussian's sum to 1."""
    weights = torch.stack(list(opacities)) + FEW
    return weights / weights.sum(0)


def _baked(model: GaussianModel, queries: Sequence[Query], weights: Tensor, names: Sequence[str]) -> Raw:
    """Average what AGR makes of the raw parameters over the queries."""
    total: Raw = {name: torch.zeros_like(model.splats[name]) for name in names}
    moved: dict[float, Raw] = {}
    for query, weight in zip(queries, weights, strict=True):
        assert query.time is not None
        key = float(query.time)
        if key not in moved:
            moved = {key: model.refined(query)}
        for name in names:
            total[name] += weight[:, None] * moved[key][name]
    return total


def _repainted(
    model: GaussianModel, level: int, queries: Sequence[Query], opacities: Sequence[Tensor], weights: Tensor
) -> Raw:
    """Cut the harmonics above a level, and refit the constant one to the colours that the queries saw."""
    whole = {name: value.detach() for name, value in model.splats.items()}
    levels = torch.full((len(model),), level, dtype=torch.int32, device=weights.device)
    cut = whole | {"shN": whole["shN"] * model.kept(Classes(0, 0, levels))["shN"]}
    lost = torch.zeros_like(whole["means"])
    for query, seen, weight in zip(queries, opacities, weights, strict=True):
        raw = model.refined(query)
        means, _, _ = model.observe(raw, query)
        colors = [model.paint(raw | {k: v for k, v in one.items() if k in ("sh0", "shN")}, means, seen, query)
                  for one in (whole, cut)]  # fmt: skip
        lost += weight[:, None] * (colors[0] - colors[1])
    constant = cut["sh0"].clone()
    constant.flatten(1, -2)[:, 0] += lost / SH_C0
    return {"sh0": constant, "shN": cut["shN"]}
