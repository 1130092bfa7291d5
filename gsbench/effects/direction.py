"""Freeze direction in every Gaussian of a trained model, to measure how much the model uses it."""

import copy
from collections.abc import Sequence

import torch

from gsbench.effects.gate import effect_sets_of
from gsbench.effects.sensitivity import MOST_VIEWS
from gsbench.measure.quality import evenly
from gsbench.models import GaussianModel, Query
from gsbench.models.effect_sets import DIRECTION
from gsbench.models.gated import GatedModel
from gsbench.models.simplifications import STATIC, shares_of
from gsbench.scenes import View


@torch.no_grad()
def without_direction(model: GaussianModel, views: Sequence[View]) -> GaussianModel | None:
    """Return a copy whose slices do not change with the direction of view.

    Return None if the model's Gaussians never depend on direction, or if the model cannot replace it by a constant.
    AGR, time and the harmonics of the colours stay.

    Args:
        model: the trained model.
        views: training views; the constant that replaces direction is the mean over them.
    """
    if not isinstance(model, GatedModel) or "direction" not in model.observes:
        return None
    queries = [Query.of(view.camera, view.time) for view in evenly(views, MOST_VIEWS)]
    weights = shares_of([model.slice(query).opacities for query in queries])
    frozen = model.frozen({name: value.detach() for name, value in model.splats.items()}, queries, weights)
    changed = copy.deepcopy(model)
    name = "direction" if "direction" in frozen else STATIC
    for key, value in frozen[name].items():
        if key != "directions":  # AGR reads them
            changed.splats[key].data = value.clone()
    if name == STATIC:
        changed.effect_sets = effect_sets_of(model)._replace(refined=0, conditioned=0, intervals=None)
    return changed


def share_with_direction(model: GaussianModel) -> float:
    """Return the share of Gaussians whose slices change with the direction of view."""
    effect_sets = effect_sets_of(model)
    assert effect_sets.frozen is not None
    return float((effect_sets.frozen[: effect_sets.conditioned] & DIRECTION == 0).sum()) / max(1, len(model))
