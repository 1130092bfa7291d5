"""Freeze time, direction or both in Gaussians with triangular factors (6DGS, 7DGS), and time in those of 4DGS."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from gsbench.kernels.headers import LOG_SIZE_MAX, TIME_GATE_MIN
from gsbench.models.factors import partner, quaternion, turn_of_space
from gsbench.models.query import Query
from gsbench.models.slicing import Reduced, gain_of, reduce, whiten

if TYPE_CHECKING:
    from gsbench.models.base import Raw
    from gsbench.models.gaussians4d import Gaussians4DModel
    from gsbench.models.triangular import TriangularModel

CENTERS = {"time": "times", "direction": "directions"}  # the raw parameters that are means of variables
OPACITY_MARGIN = 1e-6  # between an opacity and 0 or 1, whose logits are infinite


def freeze_triangular(
    model: TriangularModel,
    raw: Raw,
    queries: Sequence[Query],
    weights: Tensor,  # [V, N], of which each Gaussian's sum to 1
) -> dict[str, Raw]:
    """Freeze t, d and both at their weighted means over queries; return the raw parameters that each changes.

    The slice of (T_qq, K, T_pp) is mu_p + K (q - mu_q) with the factor T_pp. Freezing a variable zeroes its column of
    K; the mean keeps what the column did to it on average, and the opacity what f_temp or f_dir did. Its standard
    deviation becomes exp(LOG_SIZE_MAX), so that no query is far from its mean.

    Args:
        model: has the layout of the factor, lambda_t and lambda_d.
        raw: parameters, AGR already in them.
        queries: V of them.
        weights: of the queries, for each Gaussian.
    """
    blocks = Reduced(*(block.double() for block in reduce(model.factors(raw))))
    gain = gain_of(blocks.T_pq, blocks.T_qq)
    by_name = {name: [name] for name in model.columns} if len(model.columns) > 1 else {}
    by_name["still"] = list(model.columns)
    shift, gates = torch.zeros_like(gain[:, 0]), {name: torch.zeros_like(gain[:, 0, 0]) for name in by_name}
    for query, weight in zip(queries, weights.double(), strict=True):
        delta = model.offset(raw, query).double()
        shift += weight[:, None] * delta
        exponents = model.exponents(blocks.T_qq, delta, whiten(blocks.T_qq, delta))
        for name, variables in by_name.items():
            gates[name] += weight * torch.exp(-torch.stack([exponents[x] for x in variables]).sum(0))
    changed = {}
    for name, variables in by_name.items():
        columns = [column for x in variables for column in model.columns[x]]
        moved = raw["means"] + (gain[..., columns] @ shift[:, columns, None])[..., 0]
        opacity = (torch.sigmoid(raw["opacities"].double()) * gates[name]).clamp(OPACITY_MARGIN, 1 - OPACITY_MARGIN)
        new = model.triangle.parameters(_without(model, blocks, gain, variables)) | {"means": moved}
        new["opacities"] = torch.logit(opacity)
        new |= {center: torch.zeros_like(raw[center]) for x in variables for center in [CENTERS[x]]}
        changed[name] = {key: value.to(raw["means"].dtype) for key, value in new.items()}
    return changed


def _without(model: TriangularModel, blocks: Reduced, gain: Tensor, variables: list[str]) -> Tensor:
    """Compute the factor [N, n, n] in the model's own order whose slices depend on no frozen variable."""
    T_qq, kept = blocks.T_qq.clone(), gain.clone()
    if "direction" in variables and "time" in model.observes:
        # t is no longer measured by d: its own deviation becomes its whole one
        deviation = T_qq[:, -1].norm(dim=-1)
        T_qq[:, -1] = 0
        T_qq[:, -1, -1] = deviation
    for column in [column for x in variables for column in model.columns[x]]:
        T_qq[:, column] = 0
        T_qq[:, column, column] = math.exp(LOG_SIZE_MAX)
        kept[..., column] = 0
    p_rows = torch.cat([kept @ T_qq, blocks.T_pp], -1)
    q_rows = torch.cat([T_qq, T_qq.new_zeros(*T_qq.shape[:2], 3)], -1)
    return torch.cat([p_rows, q_rows], 1)[:, model.own_order()]


def freeze_rotated(
    model: Gaussians4DModel,
    raw: Raw,
    queries: Sequence[Query],
    weights: Tensor,  # [V, N], of which each Gaussian's sum to 1
) -> Raw:
    """Freeze t in 4DGS: the mean stays where it is on average, the opacity keeps f_temp's mean, the factor the slice's.

    Args:
        model: has the unit of time and lambda_t.
        raw: parameters.
        queries: V of them.
        weights: of the queries, for each Gaussian.
    """
    factor = model.factors(raw).double()
    blocks = reduce(factor)
    shift, opacity = torch.zeros_like(factor[:, 3:, 0]), torch.zeros_like(factor[:, 0, 0])
    for query, weight in zip(queries, weights.double(), strict=True):
        assert query.time is not None
        delta = (query.time - raw["times"]).double()
        gate = model.gate(factor, delta)
        shift += weight[:, None] * delta
        opacity += weight * torch.where(gate > TIME_GATE_MIN, gate, 0.0) * torch.sigmoid(raw["opacities"].double())
    turn, lengths, _ = torch.linalg.svd(blocks.T_pp)
    left = turn_of_space(quaternion(turn * torch.linalg.det(turn)[:, None, None]))
    new = {
        "means": raw["means"] + (gain_of(blocks.T_pq, blocks.T_qq) @ shift[..., None])[..., 0],
        "scales": torch.cat([lengths.log(), torch.full_like(shift, LOG_SIZE_MAX)], -1),
        "left_quats": left,
        "right_quats": partner(left),
        "opacities": torch.logit(opacity.clamp(OPACITY_MARGIN, 1 - OPACITY_MARGIN)),
    }
    return {name: value.to(raw[name].dtype) for name, value in new.items()}
