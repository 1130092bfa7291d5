"""Densify by relocation under a limit, as 3DGS-MCMC does: move dead Gaussians to opaque ones, grow, and add noise.

Kheradmand et al., "3D Gaussian Splatting as Markov Chain Monte Carlo", arXiv 2404.09591.
"""

import torch
from torch import Tensor

from gsbench.train.density.rule import DensificationRule

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
    - After every step each mean moves by normal noise with the covariance of its Gaussian. The noise is multiplied by
      `train.densify.noise`, by the learning rate of means and by sigmoid(-100 (opacity - 0.005)), so only transparent
      Gaussians move.
    """

    @torch.no_grad()
    def densify(self, generator: torch.Generator, has_reset: bool, most: int) -> int:
        """Relocate dead Gaussians, then add Gaussians up to `most`; return 0, because none is refused."""
        N = len(self.model)
        opacities = self._opacities()
        dead = opacities <= self.min_opacity
        if dead.all():
            return 0
        self._copy(drawn(opacities.masked_fill(dead, 0), int(dead.sum()), generator), dead.nonzero()[:, 0])
        added = max(0, min(most, int(N * (1 + GROWTH))) - N)
        self._copy(drawn(self._opacities(), added, generator), torch.arange(N, N + added, device=dead.device))
        return 0

    def _opacities(self) -> Tensor:
        return torch.sigmoid(self.model.splats["opacities"].detach())

    def _copy(self, sources: Tensor, places: Tensor) -> None:
        """Copy Gaussians to other rows, and change all copies such that together they look like the source.

        Args:
            sources: the row of the source of each copy, [M]; a row may occur several times.
            places: the rows of the copies, [M]: existing rows are replaced, others appended.
        """
        if not len(sources):
            return
        N, model = len(self.model), self.model
        rows = torch.arange(max(N, int(places.max()) + 1), device=sources.device)
        rows[places] = sources
        chosen, copies = sources.unique(return_counts=True)
        opacities, shrink = relocated(self._opacities()[chosen], (copies + 1).clamp(max=MOST_COPIES))
        opacities = opacities.clamp(self.min_opacity, LARGEST_OPACITY)
        model.splats["opacities"].data[chosen] = torch.logit(opacities).to(model.splats["opacities"].dtype)
        model.shrink_rows(chosen, shrink)
        fresh = torch.zeros(len(rows), dtype=torch.bool, device=rows.device)
        fresh[places] = fresh[chosen] = True
        self.rows.select(rows, fresh)

    @property
    def adds_noise(self) -> bool:  # type: ignore[override]
        """Whether noise is added: not after a gate has simplified Gaussians."""
        return self.config.noise > 0 and self.model.effect_sets is None

    @torch.no_grad()
    def add_noise(self, rate: float, generator: torch.Generator) -> None:
        """Move the means of transparent Gaussians by noise."""
        opacities = self._opacities()
        noise = torch.randn(len(opacities), 3, 1, generator=generator).to(opacities)
        rows = (opacities < STILL_FROM).nonzero()[:, 0]
        spread = self.model.spread(rows)
        weight = torch.sigmoid(-100 * (opacities[rows] - 0.005)) * (self.config.noise * rate)
        self.model.splats["means"].data[rows] += weight[:, None] * (spread @ (spread.mT @ noise[rows]))[..., 0]


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
