"""Densify by relocation under a limit, as 3DGS-MCMC does: move dead Gaussians to opaque ones, grow, and add noise.

Kheradmand et al., "3D Gaussian Splatting as Markov Chain Monte Carlo", arXiv 2404.09591.
"""

import torch
from torch import Tensor

from gsbench.models import GaussianModel
from gsbench.train.density.rule import DensificationRule
from gsbench.train.rows import Rows

GROWTH = 0.05  # share of Gaussians that a round adds, until there are `max_gaussians`
MOST_COPIES = 51  # equal Gaussians that one Gaussian becomes in a round, at most
STILL_FROM = 0.2  # opacity from which the noise, below 4e-9 of that on a transparent Gaussian, is left out
LARGEST_OPACITY = 1 - 1.2e-7  # the largest float32 below 1


class MCMCDensification(DensificationRule):
    """The relocation of 3DGS-MCMC (section 4). No Gaussian is cloned, split or pruned, and no opacity is reset.

    - A round takes place every 100 iterations or more, between `train.densify.start` and `stop`. A Gaussian is dead if
      its opacity is at most the model's `min_opacity`. Each dead Gaussian moves to a living one, which is drawn with a
      probability proportional to its opacity.
    - Then 5 % more Gaussians are added in the same way, up to `train.densify.max_gaussians`.
    - The n Gaussians that are now at one place get opacities and sizes such that together they look like the single
      Gaussian that was there before.
    - After every step each mean moves by Sigma eta, for the covariance Sigma of its Gaussian and a normal eta. This is
      multiplied by `train.densify.noise`, by the learning rate of means and by sigmoid(-100 (opacity - 0.005)), so only
      transparent Gaussians move.
    """

    @torch.no_grad()
    def densify(self, generator: torch.Generator, has_reset: bool, most: int) -> int:
        """Relocate dead Gaussians, then add Gaussians up to `most`; return 0, because none is refused."""
        N = len(self.model)
        opacities = opacities_of(self.model)
        dead = opacities <= self.min_opacity
        if dead.all():  # no source is left
            return 0
        copy_drawn(self.rows, opacities.masked_fill(dead, 0), dead.nonzero()[:, 0], generator, self.min_opacity)
        added = max(0, min(most, int(N * (1 + GROWTH))) - N)
        places = torch.arange(N, N + added, device=dead.device)
        copy_drawn(self.rows, opacities_of(self.model), places, generator, self.min_opacity)
        return 0

    @property
    def adds_noise(self) -> bool:  # type: ignore[override]
        """Whether noise is added: not after a gate has simplified Gaussians."""
        return self.config.noise > 0 and self.model.effect_sets is None

    @torch.no_grad()
    def add_noise(self, rate: float, generator: torch.Generator) -> None:
        """Move the means of transparent Gaussians by noise."""
        opacities = opacities_of(self.model)
        noise = torch.randn(len(opacities), 3, 1, generator=generator).to(opacities)
        rows = (opacities < STILL_FROM).nonzero()[:, 0]
        spread = self.model.spread(rows)  # [M, 3, 3] L, where Sigma = L L^T
        weight = torch.sigmoid(-100 * (opacities[rows] - 0.005)) * (self.config.noise * rate)
        self.model.splats["means"].data[rows] += weight[:, None] * (spread @ (spread.mT @ noise[rows]))[..., 0]


def opacities_of(model: GaussianModel) -> Tensor:
    """Return the opacities of all Gaussians, before they fade with time or direction, [N]."""
    return torch.sigmoid(model.splats["opacities"].detach())


def copy_drawn(rows: Rows, weights: Tensor, places: Tensor, generator: torch.Generator, least_opacity: float) -> None:
    """Copy Gaussians to other rows, and change all copies such that together they look like the source.

    Args:
        rows: the Gaussians of the training.
        weights: to which the probability of each Gaussian to be a source is proportional, [N].
        places: the rows of the copies, [M]: existing rows are replaced, others appended.
        generator: draws the sources, with replacement.
        least_opacity: to which lower opacities of copies are raised.
    """
    sources = drawn(weights, len(places), generator)
    if not len(sources):
        return
    model = rows.model
    order = torch.arange(max(len(model), int(places.max()) + 1), device=sources.device)
    order[places] = sources
    distinct, copies = sources.unique(return_counts=True)
    # First the sources get the opacity and the size of all Gaussians that are then at their place, with themselves.
    opacities, shrink = relocated(opacities_of(model)[distinct], (copies + 1).clamp(max=MOST_COPIES))
    opacities = opacities.clamp(least_opacity, LARGEST_OPACITY)
    model.splats["opacities"].data[distinct] = torch.logit(opacities).to(model.splats["opacities"].dtype)
    model.shrink_rows(distinct, shrink)
    fresh = torch.zeros(len(order), dtype=torch.bool, device=order.device)
    fresh[places] = fresh[distinct] = True
    rows.select(order, fresh)


def drawn(weights: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Draw the indices of `count` Gaussians with replacement, with probabilities proportional to `weights` [N].

    The sums are in float64 on the CPU, so that the same seed draws the same rows everywhere.
    """
    ends = weights.double().cpu().cumsum(0)
    at = torch.rand(count, generator=generator, dtype=torch.float64) * ends[-1]
    return torch.searchsorted(ends, at, right=True).clamp(max=len(ends) - 1).to(weights.device)


def relocated(opacities: Tensor, copies: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the opacity and the size of n equal Gaussians that together look as one (3DGS-MCMC, eq. 9).

        o' = 1 - (1 - o)^(1/n)      c = o / sum_{k=1..n} binom(n, k) (-1)^(k-1) o'^k / sqrt(k)

    The paper has a double sum over i and k; here the binomials are already added over i.

    Args:
        opacities: the opacity o of each Gaussian before, [M].
        copies: the number n of Gaussians that take its place, [M].

    Returns:
        (o', c), each [M] in float64: the new opacities, and the factors of the standard deviations.
    """
    o, n = opacities.double(), copies.double()
    new = 1 - (1 - o) ** (1 / n)
    k = torch.arange(1, int(copies.max()) + 1, dtype=torch.float64, device=o.device)
    log_binomials = torch.lgamma(n + 1)[:, None] - torch.lgamma(k + 1) - torch.lgamma((n[:, None] - k + 1).clamp(min=1))
    terms = torch.exp(log_binomials + k * new[:, None].log()) / k.sqrt()
    signs = torch.where(k % 2 == 1, 1.0, -1.0).double()
    return new, o / (terms * signs).masked_fill(k > n[:, None], 0).sum(-1)
