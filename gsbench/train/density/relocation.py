"""Move dead Gaussians to opaque ones and to those with large gradients, as FreeTimeGS does; their number is fixed.

Wang et al., "FreeTimeGS: Free Gaussian Primitives at Anytime and Anywhere", arXiv 2506.05348.
"""

import torch
from torch import Tensor

from gsbench.train.density.gradient import GradientRule
from gsbench.train.density.mcmc import copy_drawn, opacities_of


class RelocationDensification(GradientRule):
    """The relocation of FreeTimeGS. No Gaussian is added or removed, no noise is added, and no opacity is reset.

    A round takes place every 100 iterations or more, between `train.densify.start` and `stop`. A Gaussian is dead if
    its opacity is at most the model's `min_opacity`. Each dead Gaussian moves to a living one, which is drawn with a
    probability proportional to its `score`. The n Gaussians that are then at one place get opacities and sizes by the
    formula of 3DGS-MCMC.

    The weights are those of a public reproduction, FreeTimeGS++, whose mode `3d_mcmc` this is. There, a dead Gaussian
    keeps Adam's moments when it moves; here they become zero, as those of its source do.
    """

    @torch.no_grad()
    def densify(self, generator: torch.Generator, has_reset: bool, most: int) -> int:
        """Relocate dead Gaussians; return 0, because none is refused."""
        opacities = opacities_of(self.model)
        dead = opacities <= self.min_opacity
        if not dead.all():
            weights = score(opacities, self.mean_gradient()).masked_fill(dead.cpu(), 0)
            copy_drawn(self.rows, weights, dead.nonzero()[:, 0], generator, self.min_opacity)
        self.forget()
        return 0


def score(
    opacities: Tensor,  # [N]
    gradient: Tensor,  # [N] mean gradient of each 2D mean
) -> Tensor:  # [N]
    """Return the share of each Gaussian in the sum of opacities plus its share in the sum of gradients, in float64."""
    return share(opacities) + share(gradient)


def share(values: Tensor) -> Tensor:
    """Divide values >= 0, [N], by their sum, which has the same bits for any number of threads; zeros stay zeros."""
    values = values.double().cpu()
    return values / values.cumsum(0)[-1].clamp(min=torch.finfo(values.dtype).tiny)
