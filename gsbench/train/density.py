"""Control the density of Gaussians: clone small ones, split large ones, prune faint and unseen ones (3DGS, 5.2)."""

import torch
from torch import Tensor

from gsbench.config import DensifyConfig
from gsbench.models import GaussianModel
from gsbench.models.base import CHILDREN
from gsbench.train.checkpoint import tensor
from gsbench.train.optim import Optimizer

# Of the runs of the 7DGS paper the largest has 1.41 million, of those here 0.55. A Gaussian of 7DGS has 84 numbers,
# four times with its gradient and moments: 2.7 GB for so many.
MOST_GAUSSIANS = 2_000_000


class DensityControl:
    """Adaptive density control: collects gradients of 2D means, then edits the model and the optimizer's moments."""

    def __init__(
        self, model: GaussianModel, optimizer: Optimizer, config: DensifyConfig, min_opacity: float, views: int
    ) -> None:
        """Start with nothing collected.

        Args:
            model: initialised.
            optimizer: of the model; its moments follow the Gaussians.
            config: thresholds.
            min_opacity: a Gaussian below it is pruned.
            views: the number of training views, an epoch.
        """
        self.model = model
        self.optimizer = optimizer
        self.config = config
        self.min_opacity = min_opacity
        self.patience = 2 * views - 1  # this many views in a row contain a whole epoch, wherever they begin
        self.unseen = torch.zeros(len(model), dtype=torch.int32, device=model.splats["means"].device)
        self.forget()

    def forget(self) -> None:
        """Drop the collected gradients."""
        like = self.model.splats["opacities"].detach()
        self.gradient = torch.zeros_like(like)  # [N] sum over views of |gradient of the 2D mean|
        self.seen = torch.zeros_like(like)  # [N] number of views in which the Gaussian was visible

    @torch.no_grad()
    def accumulate(
        self,
        radii: Tensor,  # [C, N]
        g_means2d: Tensor,  # [C, N, 2] per pixel
        width: int,
        height: int,
        views: int,
    ) -> None:
        """Add the gradients of one view, in units of half the image (NDC).

        Args:
            radii: of the splats in pixels; 0 where the Gaussian was culled.
            g_means2d: gradient of the loss, a mean over `views`, by the 2D means.
            width: of the image, pixels.
            height: of the image, pixels.
            views: in the batch.
        """
        x, y = g_means2d.unbind(-1)  # scaled separately: making a tensor of the two sizes would wait for the GPU
        self.gradient += torch.hypot(x * (views * width / 2), y * (views * height / 2)).sum(0)
        drawn = (radii > 0).sum(0)
        self.seen += drawn
        # [N] views since the Gaussian was last visible
        self.unseen = torch.where(drawn > 0, 0, self.unseen + len(radii))

    @torch.no_grad()
    def densify(self, generator: torch.Generator, prune_large: bool) -> int:
        """Clone, split and prune Gaussians; the children of a split are sampled with `generator`.

        Returns:
            How many were neither cloned nor split, though their gradient asks for it, since there would be too many.
        """
        model, config = self.model, self.config
        scales = model.scales()
        wanted, refused = self._wanted()
        small = scales <= config.clone_below * model.extent
        split = wanted & (~small | model.long_in_time())
        clone = wanted & ~split

        kept, cloned = (~split).nonzero()[:, 0], clone.nonzero()[:, 0]
        parents = split.nonzero()[:, 0].repeat_interleave(CHILDREN)
        self._select(torch.cat([kept, cloned, parents]), fresh=len(cloned) + len(parents))
        children = torch.arange(len(model) - len(parents), len(model), device=parents.device)
        model.split_rows(children, generator)

        # A Gaussian that no view sees gets no gradient, so it would never come back, and it costs as much as any other.
        keep = (torch.sigmoid(model.splats["opacities"]) >= self.min_opacity) & (self.unseen < self.patience)
        if prune_large:
            keep &= model.scales() <= config.prune_above * model.extent
        self._select(keep.nonzero()[:, 0], fresh=0)
        self.forget()
        return refused

    def _wanted(self) -> tuple[Tensor, int]:
        """Tell which Gaussians to clone or split, as [N] bool, each of which makes one more, and how many are refused.

        Where there is no room for all, those of the largest gradients are taken, and of equal ones the first.
        """
        gradient = self.gradient / self.seen.clamp(min=1)
        wanted = gradient > self.config.grad_threshold
        rows = wanted.nonzero()[:, 0]
        room = max(0, (self.config.max_gaussians or MOST_GAUSSIANS) - len(self.model))
        if len(rows) > room:
            refused = gradient[rows].argsort(descending=True, stable=True)[room:]
            wanted[rows[refused]] = False
        return wanted, max(0, len(rows) - room)

    def reset_opacities(self) -> None:
        """Lower opacities to twice the pruning threshold; needed Gaussians grow back before the next pruning."""
        self.model.reset_opacities(2 * self.min_opacity)
        self.optimizer.forget(self.model.splats["opacities"])

    def follow(self, rows: Tensor) -> None:
        """Keep the counts of the given rows, in their order, after `model.select(rows)`."""
        self.unseen = self.unseen[rows]
        self.forget()

    def state_dict(self) -> dict[str, Tensor]:
        """Return the collected gradients and counts, for the checkpoint."""
        return {"gradient": self.gradient, "seen": self.seen, "unseen": self.unseen}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue from the `state_dict` of a checkpoint; raises InputError where it is not of this many Gaussians."""
        opacities = self.model.splats["opacities"]
        self.gradient, self.seen = (
            tensor(state, name, opacities.shape, opacities.dtype) for name in ("gradient", "seen")
        )
        self.unseen = tensor(state, "unseen", opacities.shape, torch.int32)

    def _select(self, rows: Tensor, fresh: int) -> None:
        is_fresh = torch.arange(len(rows), device=rows.device) >= len(rows) - fresh
        self.model.select(rows)
        self.unseen = self.unseen[rows]
        self.optimizer.follow(self.model, rows, is_fresh)
