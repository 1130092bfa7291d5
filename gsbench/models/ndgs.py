"""Model moving, view-dependent scenes by N-DGS: 7DGS with unit directions, bounded times and one gate for both."""

from typing import Any

from gsbench.models.gaussians7d import Gaussians7DModel
from gsbench.models.registry import register


@register("ndgs")
class NDGSModel(Gaussians7DModel, gates=True):
    """N-DGS, the later code of the authors of 7DGS: Gaussians over position, direction and time."""

    def __init__(
        self, *, unit_directions: bool = True, bounded_times: bool = True, joint_gate: bool = True, **options: Any
    ) -> None:
        """Make a model without Gaussians.

        Args:
            unit_directions: whether mean directions are normalised when a Gaussian is sliced.
            bounded_times: whether mean times are sigmoids of their parameters, so that they stay in (0, 1).
            joint_gate: whether one factor of direction and time dims a Gaussian; see `Gaussians7DModel`.
            options: the other options of `Gaussians7DModel`.

        Raises:
            InputError: an option is out of its range.
        """
        super().__init__(unit_directions=unit_directions, bounded_times=bounded_times, joint_gate=joint_gate, **options)
