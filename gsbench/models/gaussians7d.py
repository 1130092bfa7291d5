"""Model moving, view-dependent scenes by 7DGS: Gaussians over position, time and direction (Gao et al. 2025)."""

import math
from typing import Any

import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.models.base import Raw
from gsbench.models.gated import GatedModel
from gsbench.models.observing import DirectionalModel, TimedModel
from gsbench.models.query import Query
from gsbench.models.registry import register
from gsbench.models.sliced import Geometry


@register("7dgs")
class Gaussians7DModel(TimedModel, DirectionalModel, gates=True):
    """7DGS: Gaussians over position, time and direction, conditioned on a time and the direction from the camera."""

    observes = ("time", "direction")
    centers = ("means", "times", "directions")

    def __init__(self, *, joint_gate: bool = False, **options: Any) -> None:
        """Make a model without Gaussians.

        Args:
            joint_gate: whether direction and time q dim a Gaussian together, by exp(-lambda (q - mu_q)^T S_qq^-1 (q -
                mu_q)) as in N-DGS, and not by f_dir f_temp. There is no 1/2, whatever directional_half says, and one
                lambda, which lambda_t and lambda_d must both be. No kernel has it: slices are computed in torch.
            options: the options of `TimedModel` and `DirectionalModel`.

        Raises:
            InputError: an option is out of its range, or a joint gate has two values of lambda.
        """
        super().__init__(**options)
        self.joint_gate = joint_gate
        if joint_gate:
            if not torch.equal(self.log_lambda["time"], self.log_lambda["direction"]):
                raise InputError(f"joint_gate: expected lambda_d equal to lambda_t, got {options['lambda_d']} and "
                                 f"{options['lambda_t']}: a joint gate has one lambda")  # fmt: skip
            del self.log_lambda["direction"]

    def slice_geometry(self, raw: Raw, query: Query) -> Geometry:
        """Compute conditional 3D Gaussians by a kernel if the backend has one; with a joint gate, in torch."""
        return GatedModel.slice_geometry(self, raw, query) if self.joint_gate else super().slice_geometry(raw, query)

    def exponents(self, T_qq: Tensor, delta: Tensor, white: Tensor) -> dict[str, Tensor]:
        """Compute -ln of the factor by which each variable dims a Gaussian, and of both (`static`), [N] each.

        With a joint gate, the factor of a variable is that of both, divided by the one that is left without it.
        """
        if not self.joint_gate:
            return super().exponents(T_qq, delta, white)
        scale = self.lambda_of("time")
        time = (delta[:, -1] / T_qq[:, -1].norm(dim=-1)).square()  # delta_t^2 / S_t
        both = white.square().sum(-1)
        return {
            "direction": scale * (both - time).clamp(min=0),
            "time": scale * white[:, 3].square(),
            "static": scale * both,
        }

    def lifetimes(self) -> tuple[Tensor, Tensor]:
        """Return the mean time mu_t [N] and the lifetime s [N] of each Gaussian; see `GaussianModel.lifetimes`.

        With a joint gate, s is that of the direction which dims the Gaussian least at each time.
        """
        times, deviations = super().lifetimes()
        return times, deviations / math.sqrt(2) if self.joint_gate else deviations

    def hold_lifetimes(self, least: float) -> None:
        """Raise the lifetime of each Gaussian to at least `least`; see `TimedModel.hold_lifetimes`."""
        super().hold_lifetimes(least * math.sqrt(2) if self.joint_gate else least)
