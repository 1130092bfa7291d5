"""Define the base class of models whose Gaussians have a covariance over position and time, direction or both."""

from abc import abstractmethod

from torch import Tensor

from gsbench.models.base import Raw
from gsbench.models.gated import GatedModel
from gsbench.models.slicing import reduce


class JointModel(GatedModel):
    """The base class of 4DGS, 6DGS and 7DGS: a covariance over position and time, direction or both, sliced at a query.

    The conditional covariance is the same for all times and directions.
    """

    @abstractmethod
    def factors(self, raw: Raw) -> Tensor:
        """Compute factors of the covariances [N, n, n]; the first rows are position, and the last is time if any."""

    def spread(self, rows: Tensor) -> Tensor:
        """Return factors of the conditional 3D covariances of the Gaussians `rows` [M], [M, 3, 3]."""
        return reduce(self.factors(self.raw_of(rows))).T_pp

    def durations(self) -> Tensor | None:
        """Return the standard deviation in time of each Gaussian, [N]; None for a model without time."""
        if "time" not in self.observes:
            return None
        return self.factors(dict(self.splats.items())).detach()[:, -1].norm(dim=-1)
