"""Define the base classes of triangular models that depend on time, on direction, or on both."""

import math
from typing import Any

from torch import Tensor

from gsbench.models.triangular import TriangularModel


class TimedModel(TriangularModel):
    """The base class of models whose Gaussians depend on time, such as 7DGS with or without direction."""

    def __init__(self, *, lambda_t: float, bounded_times: bool = False, **options: Any) -> None:
        """Make a model without Gaussians.

        Args:
            lambda_t: the initial coefficient in the exponent of f_temp, the factor of the opacity at a time.
            bounded_times: whether mean times are sigmoids of their parameters, so that they stay in (0, 1) (N-DGS).
            options: the options of `TriangularModel`.

        Raises:
            InputError: an option is out of its range.
        """
        super().__init__(**options)
        self.add_lambda("time", lambda_t)
        self.bounded_times = bounded_times

    def lifetimes(self) -> tuple[Tensor, Tensor]:
        """Return the mean time mu_t [N] and the lifetime s [N] of each Gaussian; see `GaussianModel.lifetimes`."""
        found = super().lifetimes()
        assert found is not None
        return self.mean_times(dict(self.splats.items()))[:, 0], found[1]

    def hold_lifetimes(self, least: float) -> None:
        """Raise the diagonal entry of time in each Cholesky factor, a lower bound of sqrt(S_t), to at least `least`."""
        least_entry = math.log(least) + 0.5 * self.log_lambda["time"].detach()
        self.splats["log_diagonal"].data[:, self.rows["t"][0]].clamp_(min=least_entry)


class DirectionalModel(TriangularModel):
    """The base class of models whose Gaussians depend on view direction: 6DGS, and together with time 7DGS."""

    def __init__(
        self, *, lambda_d: float, directional_half: bool = True, unit_directions: bool = False, **options: Any
    ) -> None:
        """Make a model without Gaussians.

        Args:
            lambda_d: the initial coefficient in the exponent of f_dir, the factor of the opacity in a direction.
            directional_half: whether the exponent of f_dir has the factor 1/2 of 7DGS eq. 12; 6DGS does not have it.
            unit_directions: whether mean directions are normalised when a Gaussian is sliced (N-DGS).
            options: the options of `TriangularModel`.

        Raises:
            InputError: an option is out of its range.
        """
        super().__init__(**options)
        self.add_lambda("direction", lambda_d)
        self.directional_half = directional_half
        self.unit_directions = unit_directions
