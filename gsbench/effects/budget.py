"""Remove time, direction or AGR from a model's Gaussians, as far as the measured loss of PSNR stays within a budget."""

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from gsbench.effects.gate import apply, choose
from gsbench.effects.sensitivity import Sensitivity
from gsbench.measure.record import Gate
from gsbench.models import GaussianModel
from gsbench.models.color_order import order_of
from gsbench.models.gated import GatedModel

SHARES = (0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001)  # of the squared error, tried from the largest
MOST_PREDICTED = 2.0  # times the budget: on few views a loss may be measured that is smaller than it is


@dataclass(frozen=True)
class Gated:
    """A model after effects were removed from some of its Gaussians, and what this cost."""

    model: GatedModel
    gate: Gate  # what was decided, for the record
    rows: Tensor  # [M] the place that each Gaussian had before
    changed: Tensor  # [M] bool: whether it became another simplification


def gate_within(
    model: GatedModel,
    sensitivity: Sensitivity,
    budget_db: float,
    measure: Callable[[GaussianModel], float],
    intervals: Tensor | None = None,  # [N, 2]
) -> Gated | None:
    """Simplify as many Gaussians as the budget allows: try SHARES from the largest.

    Return None if no share is within it.

    Each share is that of the squared error which the simplifications may add. The model itself is not changed.

    Args:
        model: the model to simplify, trained or in training.
        sensitivity: predicted errors of the model's simplifications.
        budget_db: the most dB by which `measure` may fall.
        measure: returns the PSNR of a model in dB, on views that were not used for `sensitivity`.
        intervals: the times at which each Gaussian can be seen; AGR does not move a Gaussian at other times.
    """
    before = measure(model)
    for share in SHARES:
        if 10 * math.log10(1 + share) > MOST_PREDICTED * budget_db:
            continue
        gated = copy.deepcopy(model)
        choice = choose(sensitivity, gated, share)
        rows, changed = apply(gated, sensitivity, choice, intervals)
        loss = before - measure(gated)
        if loss <= budget_db and len(gated):
            gate = Gate(
                share=share,
                predicted_db=10 * math.log10(1 + choice.predicted),
                measured_db=loss,
                rows=gated.count_by_effects() | {"removed": len(model) - len(gated)},
                orders=orders_of(gated),
                bytes_before=model.stored_bytes(),
                bytes=gated.stored_bytes(),
            )
            return Gated(gated, gate, rows, changed)
    return None


def orders_of(model: GaussianModel) -> dict[str, int]:
    """Count the Gaussians by the degree of their harmonics, and in 4DGS by the frequencies of their colour in time."""
    if model.effect_sets is None or model.effect_sets.orders is None:
        return {}
    values, counts = torch.unique(model.effect_sets.orders, return_counts=True)
    orders = [order_of(packed) for packed in values.tolist()]
    names = [f"degree {one.degree}" + (f", {one.waves} waves" if one.waves > 1 else "") for one in orders]
    return dict(zip(names, counts.tolist(), strict=True))
