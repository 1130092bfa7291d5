"""Define the density control of 3DGS: clone small Gaussians, split large ones, prune transparent and unseen ones."""

import torch
from torch import Tensor

from gsbench.kernels.library import library_of
from gsbench.kernels.raster import add_density
from gsbench.models.base import CHILDREN
from gsbench.train.checkpoint import tensor
from gsbench.train.density.rule import DensificationRule


class GradientRule(DensificationRule):
    """The base class of rules that use the mean gradient of each 2D mean, in units of half the image (NDC)."""

    unseen: Tensor | None = None  # [N] int32: views since each Gaussian was last visible, where a rule prunes by it

    def start(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Set the accumulated gradients of the 2D means, and the counts of views, to zero."""
        like = self.model.splats["opacities"].detach()
        self.gradient = torch.zeros_like(like)  # [N] sum over views of |gradient of the 2D mean|
        self.times_visible = torch.zeros_like(like)  # [N] number of views in which the Gaussian was visible

    @torch.no_grad()
    def accumulate(self, drawn: Tensor, g_means2d: Tensor, width: int, height: int, views: int, skip: Tensor) -> None:
        """Add the norms of the gradients of the 2D means in some views, in units of half the image, and count views."""
        scale = views * width / 2, views * height / 2  # times views: the loss is a mean over the batch
        if self.model.backend.serves(self.gradient) and library_of(self.gradient.device.type).has("add_density"):
            add_density(drawn, g_means2d, scale, self.gradient, self.times_visible, self.unseen, skip)
            return
        x, y = g_means2d.unbind(-1)
        self.gradient += torch.hypot(x * scale[0], y * scale[1]).sum(0)
        self.times_visible += drawn.sum(0)
        if self.unseen is not None:
            self.unseen.add_(len(drawn)).masked_fill_(drawn.any(0), 0)

    def mean_gradient(self) -> Tensor:
        """Return the mean of these norms over the views that saw each Gaussian, [N]."""
        return self.gradient / self.times_visible.clamp(min=1)

    def reindex(self, rows: Tensor, fresh: Tensor) -> None:
        self.forget()

    def state_dict(self) -> dict[str, Tensor]:
        return {"gradient": self.gradient, "times_visible": self.times_visible}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        opacities = self.model.splats["opacities"]
        self.gradient, self.times_visible = (
            tensor(state, name, opacities.shape, opacities.dtype) for name in ("gradient", "times_visible")
        )


class GradientDensification(GradientRule):
    """The adaptive density control of 3DGS (section 5.2), with the splits in time of 7DGS (section 4.4).

    By default, in a run of 30,000 iterations:

    - Rounds take place between iterations 500 and 15,000, at most every 100 iterations and at most 36 times. A Gaussian
      is chosen if the mean gradient of its 2D mean is above 2e-4, in units of half the image.
    - A chosen Gaussian is cloned if its largest scale is at most 0.01 of the scene's radius and it is not long in time.
      Otherwise it is split into two Gaussians that are 1.6 times smaller.
    - A round also prunes Gaussians with an opacity below 0.005, Gaussians that no view of an epoch sees, and, after the
      first reset of opacities, Gaussians with a scale above 0.1 of the radius.
    - Every 3,000 iterations all opacities are lowered to at most twice the pruning threshold.
    """

    unseen: Tensor

    def start(self) -> None:
        super().start()
        self.patience = 2 * self.views - 1  # so many consecutive views always contain a whole epoch
        self.unseen = torch.zeros_like(self.gradient, dtype=torch.int32)

    @torch.no_grad()
    def densify(self, generator: torch.Generator, has_reset: bool, most: int) -> int:
        """Clone and split Gaussians with a large gradient, then prune; large ones only if `has_reset`."""
        _, refused = self._add(generator, most)
        self.rows.select((~(self._unseen() | self._faint_or_large(has_reset))).nonzero()[:, 0])
        return refused

    def _add(self, generator: torch.Generator, most: int, allowed: Tensor | None = None) -> tuple[Tensor, int]:
        """Clone and split Gaussians with a large gradient that are `allowed` [N] bool; None: all.

        A small Gaussian is cloned, because it covers too little; a large one, or one that is long in time, is split.

        Returns:
            The index before the change of each Gaussian or of its parent, [M], and the number of Gaussians that were
            not cloned or split because of `most`.
        """
        model = self.model
        wanted, refused = self._wanted(most, allowed)
        small = model.scales() <= self.config.clone_below * model.extent
        split = wanted & (~small | model.long_in_time())
        clone = wanted & ~split

        # Gaussians that are not split come first, then the clones, then the children in place of their parents.
        unsplit, cloned = (~split).nonzero()[:, 0], clone.nonzero()[:, 0]
        parents = split.nonzero()[:, 0].repeat_interleave(CHILDREN)
        before = torch.cat([unsplit, cloned, parents])
        self.rows.select(before, fresh=torch.arange(len(before), device=before.device) >= len(unsplit))
        added = torch.arange(len(unsplit), len(model), device=parents.device)
        clones, children = added.split([len(cloned), len(parents)])
        model.clone_rows(clones, generator)
        model.split_rows(children, generator)
        return before, refused

    def _unseen(self) -> Tensor:
        """Return which Gaussians no view of an epoch saw, [N] bool.

        Such a Gaussian has no gradient, so it never becomes visible again, but it costs as much time.
        """
        return self.unseen >= self.patience

    def _faint_or_large(self, has_reset: bool) -> Tensor:
        """Return which Gaussians are too transparent or, after the first reset of opacities, too large, [N] bool."""
        model = self.model
        unfit = torch.sigmoid(model.splats["opacities"]) < self.min_opacity
        if has_reset:
            unfit |= model.scales() > self.config.prune_above * model.extent
        return unfit

    def _wanted(self, most: int, allowed: Tensor | None) -> tuple[Tensor, int]:
        """Return which Gaussians to clone or split, [N] bool, and how many more were left out because of `most`.

        Those with the largest gradients are chosen.
        """
        gradient = self.mean_gradient()
        wanted = gradient > self.config.grad_threshold
        if allowed is not None:
            wanted &= allowed
        rows = wanted.nonzero()[:, 0]
        room = max(0, most - len(self.model))  # a clone and a split each add one Gaussian
        if len(rows) > room:
            refused = gradient[rows].argsort(descending=True, stable=True)[room:]
            wanted[rows[refused]] = False
        return wanted, max(0, len(rows) - room)

    def reset_opacities(self) -> None:
        """Lower all opacities to at most twice the pruning threshold; those of useful Gaussians rise again."""
        self.model.reset_opacities(2 * self.min_opacity)
        self.rows.forget("opacities")

    def reindex(self, rows: Tensor, fresh: Tensor) -> None:
        super().reindex(rows, fresh)
        self.unseen = self.unseen[rows]

    def state_dict(self) -> dict[str, Tensor]:
        return super().state_dict() | {"unseen": self.unseen}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        super().load_state_dict(state)
        self.unseen = tensor(state, "unseen", self.model.splats["opacities"].shape, torch.int32)
