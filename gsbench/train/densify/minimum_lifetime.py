"""Keep the lifetime of each Gaussian above half the gap between neighbouring times of the training views."""

import torch

from gsbench.models import GaussianModel
from gsbench.scenes import View

# A Gaussian at the time of a view then keeps 61 % of its opacity until halfway to the next time. A much shorter one
# shows at one time only: it fits the views of this time, and leaves a hole at times between (docs/tuning.md).
LEAST_GAPS = 0.5


class MinimumLifetime:
    """Keep each Gaussian's standard deviation in time above LEAST_GAPS of the median gap between training times."""

    def __init__(self, model: GaussianModel, views: list[View]) -> None:
        """Compute the minimum lifetime; there is none if the model has no time, or the views fewer than two times."""
        self.model = model
        times = torch.tensor(sorted({view.time for view in views if view.time is not None}), dtype=torch.float64)
        has_gaps = "time" in model.observes and len(times) > 1
        self.least = LEAST_GAPS * float(times.diff().median()) if has_gaps else None

    @torch.no_grad()
    def hold(self) -> None:
        """Raise the lifetimes of Gaussians that are below the minimum lifetime to this minimum."""
        if self.least is not None:
            self.model.hold_lifetimes(self.least)
