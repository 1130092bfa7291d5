"""Define the regularisers of `train.penalties`: mean opacity, mean size, and the strain of the motion.

To add one, derive a class from `Penalty`, and add it to PENALTIES and to `PenaltiesConfig` of
gsbench/train/hooks/penalties.py.
"""

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gsbench.errors import InputError
from gsbench.models import CameraTime, GaussianModel
from gsbench.models.portable_math import sqrt
from gsbench.scenes import View
from gsbench.train.batches import generator
from gsbench.train.checkpoint import MOST_STEPS, tensor, whole_number

NEIGHBOURS = 8
SAMPLES = 8_192  # the most Gaussians in B
EVERY = 100  # steps after which neighbours are searched again
VISIBLE = 0.05  # neighbours have an opacity factor above this when they are searched
LEAST_DISTANCE = 1e-3  # added to distances, in parts of the scene's extent
LEAST_SHARE = 0.1  # least |u|: for a shorter time, rounding in float32 would exceed the differences of the means
DRAWS = 2  # the purpose of the random numbers, see `generator`


class Penalty(ABC):
    """A term of the loss of every view.

    Threads compute the penalties of different views at the same time, so only `prepare` and `reindex` change an object.
    """

    needs: ClassVar[tuple[str, ...]] = ()  # what the model must observe, of "time", "direction"

    def __init__(self, model: GaussianModel, seed: int, frames: int) -> None:
        """Make the penalty of an initialised model; `frames` is the number of different times of training views."""
        self.model = model
        self.seed = seed
        self.frames = frames

    @abstractmethod
    def __call__(self, query: CameraTime, index: int) -> Tensor:
        """Return the penalty for view number `index` of a batch, []."""

    def prepare(self, step: int, first: View) -> None:
        """Act once in a step before its views are rendered; `first` is the first view of the batch."""

    def reindex(self) -> None:
        """Act after Gaussians were added, removed or reordered."""

    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a `state_dict`; raise InputError if it is not valid."""


class MeanOpacity(Penalty):
    """The mean opacity of all Gaussians, a regulariser of 3DGS-MCMC."""

    def __call__(self, query: CameraTime, index: int) -> Tensor:
        """Return the mean opacity, []; it is the same for every view."""
        return torch.sigmoid(self.model.splats["opacities"]).mean()


class MeanSize(Penalty):
    """The mean scale in space over Gaussians and axes, divided by the radius of the scene (3DGS-MCMC)."""

    def __call__(self, query: CameraTime, index: int) -> Tensor:
        """Return the mean scale, []; it is the same for every view."""
        return self.model.spatial_scales().mean() / self.model.extent


class Strain(Penalty):
    """The strain of the motion: how fast neighbouring Gaussians move apart, relative to their distance.

    Let m_i(t) be the conditional mean of Gaussian i for the camera of a view, t0 the time of the view, and
    t1 = t0 + u / F for F frames and a random u. With a random set B of Gaussians and the k nearest neighbours N(i),

        E = 1 / (|B| k) sum_{i in B} sum_{j in N(i)} w_ij |v_i - v_j|^2 / (|m_i(t0) - m_j(t0)|^2 + (1e-3 extent)^2)

    where v_i = (m_i(t1) - m_i(t0)) / (t1 - t0) is the mean velocity, and w_ij = sqrt(f_i f_j) with the opacity factors
    f in [0, 1] at t0. No gradient flows through w_ij and the denominator. Neighbours are nearest at the time of one
    view, and are searched again every 100 steps and after Gaussians were added, removed or reordered.
    """

    needs = ("time",)

    def __init__(self, model: GaussianModel, seed: int, frames: int) -> None:
        super().__init__(model, seed, frames)
        self.step = 0
        self.searched = 0  # the step of the last search
        self.neighbours: Tensor | None = None  # [N, k] int32, -1 for Gaussians that had no visible neighbours
        self.rows = torch.zeros(0, dtype=torch.int64)  # the Gaussians that have neighbours, [M]

    @torch.no_grad()
    def prepare(self, step: int, first: View) -> None:
        """Search neighbours if there are none or if they are 100 steps old."""
        self.step = step
        if self.neighbours is None or step >= self.searched + EVERY:
            self.searched = step
            self._use(self._nearest(CameraTime.of(first.camera, first.time)))

    def __call__(self, query: CameraTime, index: int) -> Tensor:
        """Return E for a view, []."""
        if not len(self.rows):
            return query.center.new_zeros(())
        assert self.neighbours is not None
        assert query.time is not None
        draws = generator(self.seed, self.step, DRAWS, index)
        drawn = 2 * float(torch.rand((), generator=draws)) - 1  # in [-1, 1]
        u = (1 - LEAST_SHARE) * drawn + (LEAST_SHARE if drawn > 0 else -LEAST_SHARE)  # LEAST_SHARE <= |u| <= 1
        later = CameraTime(query.center, query.time + u / self.frames)
        assert later.time is not None
        sample = self.rows[torch.randperm(len(self.rows), generator=draws)[:SAMPLES].to(self.rows.device)]
        pairs = self.neighbours[sample].long().T.contiguous()  # [k, B]

        means, visible = self._visible_means(query)
        means_later, visible_later = self._visible_means(later)
        velocities = (means_later - means) / (later.time - query.time)
        # A Gaussian that is culled has no conditional mean, so its pairs do not count.
        visible = torch.where(visible_later > 0, visible, 0.0)
        weights = sqrt(visible[sample] * visible[pairs])
        least = (LEAST_DISTANCE * self.model.extent) ** 2
        distances = _differences(means.detach(), sample, pairs).square().sum(0) + least
        strains = weights / distances * _differences(velocities, sample, pairs).square().sum(0)  # [k, B]
        return strains.sum(0).sum() / pairs.numel()

    def reindex(self) -> None:
        self.neighbours = None

    def state_dict(self) -> dict[str, Any]:
        return {} if self.neighbours is None else {"searched": self.searched, "neighbours": self.neighbours}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.neighbours = None
        if state:
            self.searched = whole_number("strain", state.get("searched"), MOST_STEPS)
            neighbours = tensor(state, "neighbours", (len(self.model), NEIGHBOURS), torch.int32)
            if not ((neighbours >= -1) & (neighbours < len(self.model))).all():
                raise InputError("checkpoint: expected neighbours from -1 to the number of Gaussians, got others")
            self._use(neighbours)

    def _use(self, neighbours: Tensor) -> None:
        self.neighbours = neighbours
        self.rows = (neighbours[:, 0] >= 0).nonzero()[:, 0]

    def _nearest(self, query: CameraTime) -> Tensor:
        """Return the nearest visible neighbours of each visible Gaussian for a camera and a time, [N, k] int32."""
        means, visible = self._visible_means(query)
        rows = ((visible > VISIBLE) & means.isfinite().all(-1)).nonzero()[:, 0]
        neighbours = torch.full((len(means), NEIGHBOURS), -1, dtype=torch.int32, device=means.device)
        if len(rows) <= NEIGHBOURS:
            return neighbours
        positions = means[rows].double().cpu().numpy()
        nearest = torch.from_numpy(cKDTree(positions).query(positions, k=NEIGHBOURS + 1)[1])  # with itself
        itself = nearest == torch.arange(len(rows))[:, None]
        itself[~itself.any(-1), -1] = True  # more than k others are in the same place: the last of them is left out
        neighbours[rows] = rows[nearest[~itself].unflatten(0, (-1, NEIGHBOURS)).to(rows.device)].int()
        return neighbours

    def _visible_means(self, query: CameraTime) -> tuple[Tensor, Tensor]:
        """Return the conditional means [N, 3] and, without gradients, the opacity factors in [0, 1], [N]."""
        raw = self.model.refined(query)
        geometry = self.model.slice_geometry(raw, query)
        unfaded = torch.sigmoid(raw["opacities"].detach()).clamp(min=torch.finfo(geometry.means.dtype).tiny)
        return geometry.means, geometry.opacities.detach() / unfaded


def _differences(
    vectors: Tensor,  # [N, 3]
    sample: Tensor,  # [B]
    pairs: Tensor,  # [k, B]
) -> Tensor:  # [3, k, B]
    """Return the differences between the vectors of a sample of Gaussians and those of their neighbours.

    On a CPU, the gradient of `gather` adds equal indices in a fixed order, and is faster than that of `embedding`.
    """
    columns = vectors.T.contiguous()
    # [3, B] and [3, k B]
    ends, starts = (columns.gather(1, rows.flatten().expand(3, -1)) for rows in (sample, pairs))
    return ends[:, None] - starts.unflatten(1, pairs.shape)


PENALTIES: dict[str, type[Penalty]] = {"opacity": MeanOpacity, "size": MeanSize, "strain": Strain}
