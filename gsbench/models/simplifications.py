"""Simplify Gaussians: make them independent of time, direction or AGR (neural refinement), or lower the SH degree.

Parameters that change with time, direction or AGR are replaced by their means over views, weighted by the opacity of
the Gaussian in each view. A simplified Gaussian is an ordinary row of the model's parameters, so rendering and
checkpoints need no change.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gsbench.models.base import GaussianModel, Raw
from gsbench.models.camera_time import CameraTime
from gsbench.models.effect_sets import EffectSets
from gsbench.models.gated import GatedModel
from gsbench.models.gaussian_batch import Gaussians3D
from gsbench.process.workers import side_by_side
from gsbench.scenes.points import SH_C0

LIVE, CONDITIONED, STATIC, REMOVED = "live", "conditioned", "static", "removed"
FEW = 1e-6  # added to weights, so that a Gaussian which no view shows is averaged over all views


@dataclass(frozen=True)
class Simplification:
    """Hold the parameters of all Gaussians of a model after one simplification, for example independent of time."""

    name: str
    raw: Raw | None  # the raw parameters that change; None: the Gaussian is removed
    rows: int  # only the first `rows` Gaussians change; the others do not have the effect that is removed
    order: int | None = None  # if only colours change: the remaining SH degree and frequencies, as in `ColorOrder`


def simplifications_of(
    model: GatedModel,
    queries: Sequence[CameraTime],  # of the views over which constants are averaged
    slices: Sequence[Gaussians3D],  # of the model for these views; their opacities are the weights of the average
) -> list[Simplification]:
    """Return the parameters of a model's Gaussians after each possible simplification.

    A simplified Gaussian is independent of AGR (the neural refinement), or also of time and direction, or has a lower
    SH degree, or is removed.
    """
    weights = shares_of([gaussians.opacities for gaussians in slices])
    simplified = []
    names = (*model.centers, *model.geometry)
    raw: Raw = {name: value.detach() for name, value in model.splats.items()}
    by_order = {  # raw parameters without the coefficients above an order
        order: raw | {"shN": raw["shN"] * model.used_entries(EffectSets(0, 0, _all(model, order)))["shN"]}
        for order in model.lower_orders()
    }
    rows = model.count_by_effects()
    conditioned = len(model) - rows["static"]
    refined_names, lower = names if rows["refined"] else (), list(by_order.values())
    refined, lost_colors = _averages(model, queries, slices, weights, refined_names, lower)
    raw = raw | refined
    if rows["refined"]:
        simplified.append(Simplification(CONDITIONED, refined, rows["refined"]))
    if frozen := model.frozen(raw, queries, weights):
        simplified.append(Simplification(STATIC, {key: raw[key] for key in names} | frozen[STATIC], conditioned))
    simplified.append(Simplification(REMOVED, None, len(model)))
    for (order, lower_raw), lost_color in zip(by_order.items(), lost_colors, strict=True):
        sh0 = lower_raw["sh0"].clone()
        sh0.flatten(1, -2)[:, 0] += lost_color / SH_C0  # the coefficient that is constant in time too
        simplified.append(Simplification(f"order{order}", {"sh0": sh0, "shN": lower_raw["shN"]}, len(model), order))
    return simplified


def shares_of(opacities: Sequence[Tensor]) -> Tensor:
    """Return the weights of V views for N Gaussians, [V, N]: opacities [N] in each view, normalised to a sum of 1."""
    weights = torch.stack(list(opacities)) + FEW
    return weights / weights.sum(0)


def _all(model: GaussianModel, order: int) -> Tensor:
    """Return `order` (an encoded SH degree and number of frequencies in time) for all Gaussians of a model, [N]."""
    return torch.full((len(model),), order, dtype=torch.int32, device=model.splats["means"].device)


def _averages(
    model: GaussianModel,
    queries: Sequence[CameraTime],  # of V views
    slices: Sequence[Gaussians3D],  # of the model for these views
    weights: Tensor,  # [V, N] of each view for each Gaussian
    names: Sequence[str],  # of the raw parameters that AGR changes; empty without AGR
    lower: Sequence[Raw],  # raw parameters with lower SH degrees
) -> tuple[Raw, list[Tensor]]:
    """Return means over views of parameters after AGR (a network), and of the colour that a lower SH degree drops."""

    def weighted(v: int) -> list[Tensor]:  # the terms of one view
        moved, sliced, weight = model.refined(queries[v]), slices[v], weights[v][:, None]
        colors = [
            model.shade(moved | {"shN": simpler["shN"]}, sliced.means, sliced.opacities, queries[v])
            for simpler in lower
        ]
        return [weight * moved[name] for name in names] + [weight * (sliced.colors - others) for others in colors]

    by_view = side_by_side(weighted, range(len(queries)), model.backend.workers(weights))
    total = next(by_view)
    for of_view in by_view:
        for x, y in zip(total, of_view, strict=True):
            x += y
    return dict(zip(names, total, strict=False)), total[len(names) :]
