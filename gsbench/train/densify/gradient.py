"""Densify by gradients: clone small Gaussians, split large ones, prune faint and unseen ones (3DGS, section 5.2)."""

import torch
from torch import Tensor

from gsbench.config import DensifyConfig
from gsbench.models.base import CHILDREN
from gsbench.train.checkpoint import tensor
from gsbench.train.densify.base import MOST_GAUSSIANS, Densification
from gsbench.train.rows import Rows


class GradientDensification(Densification):
    """The adaptive density control of 3DGS: Gaussians whose 2D mean has a large mean gradient are cloned or split.

    Defaults of `train.densify`, whose steps are those of a run of 30,000:

    - every 100 steps (and at most 36 rounds) from 500 to 15,000, Gaussians are chosen whose 2D mean has a mean gradient
      above 2e-4, in units of half the image. Such a Gaussian is cloned if its largest scale is at most 0.01 of the
      scene's extent and it is not long in time. Otherwise it is split into two that are 1.6 times smaller;
    - in the same round a Gaussian is pruned whose opacity is below 0.005, that no view of an epoch has seen, or, after
      the first reset of opacities, whose largest scale is above 0.1 of the extent;
    - every 3,000 steps opacities are lowered to at most twice the pruning threshold.

    Source: 3DGS, section 5.2, and its code for the numbers; 7DGS, section 4.4, for splits of Gaussians long in time.
    """

    kind = "gradient"

    def __init__(self, rows: Rows, config: DensifyConfig, min_opacity: float, views: int) -> None:
        """Start with nothing accumulated; see `Densification`."""
        super().__init__(rows, config, min_opacity, views)
        self.patience = 2 * views - 1  # this many views in a row contain a whole epoch, wherever they begin
        self.unseen = torch.zeros(len(rows), dtype=torch.int32, device=self.model.splats["means"].device)
        self.forget()

    def forget(self) -> None:
        """Drop the accumulated gradients."""
        like = self.model.splats["opacities"].detach()
        self.gradient = torch.zeros_like(like)  # [N] sum over views of |gradient of the 2D mean|
        self.seen = torch.zeros_like(like)  # [N] number of views in which the Gaussian was visible

    @torch.no_grad()
    def accumulate(
        self,
        drawn: Tensor,  # [C, N] bool
        g_means2d: Tensor,  # [C, N, 2] per pixel
        width: int,
        height: int,
        views: int,
    ) -> None:
        """Add the gradients of one view, in units of half the image (NDC); see `Densification.accumulate`."""
        x, y = g_means2d.unbind(-1)  # scaled separately: making a tensor of the two sizes would wait for the GPU
        self.gradient += torch.hypot(x * (views * width / 2), y * (views * height / 2)).sum(0)
        self.seen += drawn.sum(0)
        # [N] views since the Gaussian was last visible
        self.unseen = (self.unseen + len(drawn)).masked_fill_(drawn.any(0), 0)

    @torch.no_grad()
    def densify(self, generator: torch.Generator, has_reset: bool) -> int:
        """Clone, split and prune Gaussians; the children of a split are sampled with `generator`.

        Returns:
            How many Gaussians of large gradient were neither cloned nor split, because there would be too many.
        """
        model, config = self.model, self.config
        scales = model.scales()
        wanted, refused = self._wanted()
        small = scales <= config.clone_below * model.extent
        split = wanted & (~small | model.long_in_time())
        clone = wanted & ~split

        kept, cloned = (~split).nonzero()[:, 0], clone.nonzero()[:, 0]
        parents = split.nonzero()[:, 0].repeat_interleave(CHILDREN)
        chosen = torch.cat([kept, cloned, parents])
        self.rows.select(chosen, fresh=torch.arange(len(chosen), device=chosen.device) >= len(kept))
        children = torch.arange(len(model) - len(parents), len(model), device=parents.device)
        model.split_rows(children, generator)

        # A Gaussian that no view sees gets no gradient, so it would never come back, and it costs as much as any other.
        keep = (torch.sigmoid(model.splats["opacities"]) >= self.min_opacity) & (self.unseen < self.patience)
        if has_reset:  # from then on Gaussians that are too large are pruned
            keep &= model.scales() <= config.prune_above * model.extent
        self.rows.select(keep.nonzero()[:, 0])
        return refused

    def _wanted(self) -> tuple[Tensor, int]:
        """Tell which Gaussians to clone or split, [N] bool, and how many are refused; each makes one more Gaussian.

        If there is no room for all, those of the largest gradients are taken, and the first of equal ones.
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
        self.rows.forget("opacities")

    def follow(self, rows: Tensor, fresh: Tensor) -> None:
        """Keep for how many views the given rows are unseen; gradients begin anew with every change of the rows."""
        self.unseen = self.unseen[rows]
        self.forget()

    def state_dict(self) -> dict[str, Tensor]:
        """Return the collected gradients and counts, for the checkpoint."""
        return {"gradient": self.gradient, "seen": self.seen, "unseen": self.unseen}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue from the `state_dict` of a checkpoint; raises InputError if it is not of this many Gaussians."""
        opacities = self.model.splats["opacities"]
        self.gradient, self.seen = (
            tensor(state, name, opacities.shape, opacities.dtype) for name in ("gradient", "seen")
        )
        self.unseen = tensor(state, "unseen", opacities.shape, torch.int32)
