"""Remove the dependence on view direction from all Gaussians of a model, to measure how much the model uses it."""

import copy
from collections.abc import Sequence

import torch

from gsbench.gates.gate import effect_sets_of
from gsbench.gates.sensitivity import MOST_VIEWS
from gsbench.measure.quality import evenly
from gsbench.models import CameraTime, GaussianModel
from gsbench.models.effect_sets import DIRECTION
from gsbench.models.gated import has_gates
from gsbench.models.simplifications import STATIC, shares_of
from gsbench.scenes import View


@torch.no_grad()
def without_direction(model: GaussianModel, views: Sequence[View]) -> GaussianModel | None:
    """Return a copy of a model whose means and opacities ignore the view direction; None for a model without direction.

    The neural refinement (AGR), the dependence on time and the SH coefficients of the colours stay.

    Args:
        model: the trained model.
        views: the training views; direction is replaced by its mean over these views.
    """
    if not has_gates(model) or "direction" not in model.observes:
        return None
    queries = [CameraTime.of(view.camera, view.time) for view in evenly(views, MOST_VIEWS)]
    weights = shares_of([model.slice(query).opacities for query in queries])
    frozen = model.frozen({name: value.detach() for name, value in model.splats.items()}, queries, weights)
    changed = copy.deepcopy(model)
    name = "direction" if "direction" in frozen else STATIC
    for key, value in frozen[name].items():
        if key != "directions":  # these stay, because they are inputs of AGR
            changed.splats[key].data = value.clone()
    if name == STATIC:
        changed.effect_sets = effect_sets_of(model)._replace(refined=0, conditioned=0, intervals=None)
    return changed


def share_with_direction(model: GaussianModel) -> float:
    """Return the share of a model's Gaussians whose mean or opacity depends on the view direction."""
    effect_sets = effect_sets_of(model)
    assert effect_sets.frozen is not None
    return float((effect_sets.frozen[: effect_sets.conditioned] & DIRECTION == 0).sum()) / max(1, len(model))
