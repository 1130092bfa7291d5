"""Find the interval of time in which each Gaussian is visible; AGR (a network) skips it at other times."""

import itertools
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from gsbench.kernels.headers import ALPHA_MIN
from gsbench.models import CameraTime, GaussianModel
from gsbench.process.workers import side_by_side
from gsbench.scenes import View


@torch.no_grad()
def seen_times(model: GaussianModel, views: Sequence[View]) -> Tensor:  # [N, 2]
    """Return the first and the last time at which each Gaussian is visible in a training view, in [0, 1].

    A Gaussian is visible in a view if its opacity at this time and direction is at least 1/255, with or without AGR (a
    network). The interval is extended on both sides by the largest gap between the times of neighbouring views. It is
    (inf, -inf) for a Gaussian that is never visible.

    Args:
        model: the trained model.
        views: the training views.
    """
    own = dict(model.splats.items())

    def shown(view: View) -> Tensor:
        query = CameraTime.of(view.camera, view.time)
        moved = model.refined(query)
        opacities = model.slice_geometry(moved, query).opacities
        if model.refines:
            opacities = torch.maximum(opacities, model.slice_geometry(own, query).opacities)
        return opacities >= ALPHA_MIN

    times = [view.time or 0.0 for view in views]
    ordered = sorted(times)
    gap = max((later - earlier for earlier, later in itertools.pairwise(ordered)), default=0.0)
    first = torch.full_like(model.splats["opacities"], math.inf)
    last = -first
    workers = model.backend.workers(first)
    for time, seen in zip(times, side_by_side(shown, views, workers), strict=True):
        first = torch.where(seen, first.clamp(max=time - gap), first)
        last = torch.where(seen, last.clamp(min=time + gap), last)
    return torch.stack([first, last], -1)


def share_asleep(model: GaussianModel, views: Sequence[View]) -> float | None:
    """Return the share of AGR's evaluations that are skipped because the Gaussian is invisible at the time of a view.

    AGR is the neural refinement of Gaussians. Return None if the times at which Gaussians are visible are unknown.
    """
    intervals = None if model.effect_sets is None else model.effect_sets.intervals
    if intervals is None or not len(intervals):
        return None
    times = intervals.new_tensor([view.time or 0.0 for view in views])[:, None]
    return float(((times < intervals[:, 0]) | (times > intervals[:, 1])).float().mean())
