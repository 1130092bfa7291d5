"""Make as many Gaussians independent of time, direction or AGR (neural refinement) as a given loss of PSNR allows."""

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from gsbench.gates.gate import apply, choose
from gsbench.gates.sensitivity import Sensitivity
from gsbench.measure.exact_views import decides
from gsbench.measure.record import Gate
from gsbench.models import GaussianModel
from gsbench.models.appearance import order_of
from gsbench.models.gated import GatedModel

SHARES = (0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001)  # shares of the squared error, tried in this order
MOST_PREDICTED = 2.0  # the predicted loss of PSNR is at most this times the allowed one: few views may underestimate it


@dataclass(frozen=True)
class Gated:
    """Hold a simplified model, and by how much its PSNR is lower than that of the model before.

    Some of its Gaussians were made independent of time, direction or AGR, a network that changes Gaussians over time.
    """

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
) -> Gated | None:
    """Simplify as many Gaussians as the allowed loss of PSNR permits.

    A simplified Gaussian is independent of time, direction or AGR (the neural refinement), has a lower SH degree, or is
    removed. For each share in SHARES, from the largest, the function simplifies a copy of the model until the predicted
    errors add up to this share of the model's squared error. It returns the first copy whose measured loss of PSNR is
    allowed, or None. PSNR cannot decide, and the result is None, if it is capped in every view or not a number.

    Args:
        model: the model, trained or in training; it does not change.
        sensitivity: the predicted error of each simplification of each Gaussian.
        budget_db: the largest allowed loss of PSNR, dB.
        measure: a function that returns the PSNR of a model in dB, on views that were not used for `sensitivity`.
        intervals: the first and the last time at which each Gaussian is visible; AGR changes it only between these
            times.
    """
    before = measure(model)
    if not decides(before):
        return None
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
    """Count the Gaussians by the SH degree of the colour, and in 4DGS by the colour's number of frequencies in time."""
    if model.effect_sets is None or model.effect_sets.orders is None:
        return {}
    values, counts = torch.unique(model.effect_sets.orders, return_counts=True)
    orders = [order_of(packed) for packed in values.tolist()]
    names = [f"degree {one.degree}" + (f", {one.waves} waves" if one.waves > 1 else "") for one in orders]
    return dict(zip(names, counts.tolist(), strict=True))
