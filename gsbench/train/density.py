"""Adaptive density control: clone where small, split where large, prune what is faint or unseen (3DGS, section 5.2)."""

import torch
from torch import Tensor

from gsbench.config import DensifyConfig
from gsbench.models import GaussianModel
from gsbench.models.base import CHILDREN
from gsbench.train.optim import Optimizer


class DensityControl:
    """Collects the gradients of 2D means and, when asked, edits the model and the optimizer's moments alike."""

    def __init__(
        self, model: GaussianModel, optimizer: Optimizer, config: DensifyConfig, min_opacity: float, views: int
    ) -> None:
        """Control the density of `model` over epochs of `views`, pruning below `min_opacity`."""
        self.model = model
        self.optimizer = optimizer
        self.config = config
        self.min_opacity = min_opacity
        self.patience = 2 * views - 1  # so many views in a row hold a whole epoch, wherever they begin
        self.unseen = torch.zeros(len(model), dtype=torch.int32, device=model.splats["means"].device)
        self.forget()

    def forget(self) -> None:
        """Start collecting anew."""
        like = self.model.splats["opacities"].detach()
        self.gradient = torch.zeros_like(like)  # [N] sum over views of |gradient of the 2D mean|
        self.seen = torch.zeros_like(like)  # [N] number of views that drew the Gaussian

    @torch.no_grad()
    def observe(
        self,
        radii: Tensor,  # [C, N]
        g_means2d: Tensor,  # [C, N, 2] by pixels
        width: int,
        height: int,
        views: int,
    ) -> None:
        """Add one view's gradients, of a loss that is a mean over `views`, in units of half the image (NDC)."""
        x, y = g_means2d.unbind(-1)  # scaled apart: a tensor of both sizes would be waited for on a GPU
        self.gradient += torch.hypot(x * (views * width / 2), y * (views * height / 2)).sum(0)
        drawn = (radii > 0).sum(0)
        self.seen += drawn
        # [N] views since the last that drew the Gaussian
        self.unseen = torch.where(drawn > 0, 0, self.unseen + len(radii))

    @torch.no_grad()
    def densify(self, generator: torch.Generator, prune_large: bool) -> None:
        """Clone, split and prune; children's randomness is drawn from `generator`."""
        model, config = self.model, self.config
        scales = model.scales()
        wanted = self.gradient / self.seen.clamp(min=1) > config.grad_threshold
        small = scales <= config.clone_below * model.extent
        split = wanted & (~small | model.long_in_time())
        clone = wanted & ~split

        kept, cloned = (~split).nonzero()[:, 0], clone.nonzero()[:, 0]
        parents = split.nonzero()[:, 0].repeat_interleave(CHILDREN)
        self._select(torch.cat([kept, cloned, parents]), fresh=len(cloned) + len(parents))
        children = torch.arange(len(model) - len(parents), len(model), device=parents.device)
        model.split(children, generator)

        # What no view draws has no gradient: nothing could bring it back, and it costs as much as any other.
        keep = (torch.sigmoid(model.splats["opacities"]) >= self.min_opacity) & (self.unseen < self.patience)
        if prune_large:
            keep &= model.scales() <= config.prune_above * model.extent
        self._select(keep.nonzero()[:, 0], fresh=0)
        self.forget()

    def reset_opacities(self) -> None:
        """Lower opacities to twice what is pruned, so that only what is needed grows back before the next pruning."""
        self.model.reset_opacities(2 * self.min_opacity)
        self.optimizer.forget(self.model.splats["opacities"])

    def state_dict(self) -> dict[str, Tensor]:
        """What was collected."""
        return {"gradient": self.gradient, "seen": self.seen, "unseen": self.unseen}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Go on from `state_dict`."""
        self.gradient, self.seen, self.unseen = state["gradient"], state["seen"], state["unseen"]

    def _select(self, rows: Tensor, fresh: int) -> None:
        is_fresh = torch.arange(len(rows), device=rows.device) >= len(rows) - fresh
        self.model.select(rows)
        self.unseen = self.unseen[rows]
        self.optimizer.follow(self.model, rows, is_fresh)
