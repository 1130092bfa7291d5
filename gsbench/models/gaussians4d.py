"""Model a moving scene by 4DGS: Gaussians in space and time, whose colours change with time (Yang et al. 2023)."""

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.colors import show_colors
from gsbench.kernels.headers import LOG_SIZE_MAX, MAX_WAVES, TIME_OPACITY_FACTOR_MIN
from gsbench.kernels.slices import slice_rotated
from gsbench.models.appearance import ColorOrder, coefficients_within, order_of, sh_time_colors
from gsbench.models.base import SHRINK, Raw
from gsbench.models.camera_time import CameraTime, initial_times, unit
from gsbench.models.effect_sets import EffectSets
from gsbench.models.factors import partner, quaternion, rotation, rotation4d, sizes, turn_of_space
from gsbench.models.gated import OPACITY_MARGIN, JointModel
from gsbench.models.gaussian_batch import Conditioned
from gsbench.models.portable_math import exp, log
from gsbench.models.registry import register
from gsbench.models.slicing import check_scheme, gain_of, mahalanobis, reduce, slice_gaussians
from gsbench.scenes.gaussian_ply import TrainedGaussians
from gsbench.scenes.points import size_of
from gsbench.scenes.scene import Points

MAX_DEGREE = 32  # largest degree of the Fourier series; the frames of a scene do not resolve higher frequencies


@register("4dgs")
class Gaussians4DModel(JointModel, gates=True):
    """4DGS: the factor of the covariance over (x, y, z, t) is a 4D rotation M_left(l) M_right(r) times four scales.

    A 4D rotation needs the same unit for space and time. The model uses the size of the scene as the length of its time
    range, so that training does not depend on the scene's unit of length. The fourth scale, that of time, is in this
    unit. The parameter `times` is in [0, 1].
    """

    clock: Tensor  # [] world units that correspond to the time range [0, 1]

    observes = ("time",)
    centers = ("means", "times")
    geometry = ("scales", "left_quats", "right_quats")
    kernel = slice_rotated
    takes_views = True

    def __init__(
        self,
        *,
        time_degree: int = 2,  # frequencies of the colours in time, without the constant; 0: constant colours
        scheme: str = "square_root",  # the numerical method of conditioning on time, see `slice_gaussians`
        lambda_t: float = 1.0,  # the coefficient in the exponent of f_temp, the factor of the opacity at a time
        **options: Any,
    ) -> None:
        super().__init__(**options)
        if not isinstance(time_degree, int) or not 0 <= time_degree <= MAX_DEGREE:
            raise InputError(f"time_degree: expected 0, 1, .., {MAX_DEGREE}, got {time_degree}")
        check_scheme(scheme)
        self.time_degree = time_degree
        self.takes_views = time_degree < MAX_WAVES  # torch shades view by view
        self.scheme = scheme
        self.add_lambda("time", lambda_t)
        self.register_buffer("clock", torch.ones(()))

    def initial_geometry(self, points: Points, distances: Tensor, generator: torch.Generator) -> Raw:
        """Return spheres with mean times uniform in [-0.1, 1.1] and a standard deviation in time of sqrt(1/5)."""
        N = len(distances)
        self.clock.fill_(size_of(points))
        duration = log(self.clock) + 0.5 * math.log(1 / 5)
        scales = torch.cat([log(distances)[:, None].repeat(1, 3), duration.expand(N, 1)], -1)
        quats = torch.zeros(N, 4)
        quats[:, 0] = 1
        times = initial_times(points, generator)
        return {"times": times, "scales": scales, "left_quats": quats, "right_quats": quats.clone()}

    def condition(self, raw: Raw, query: CameraTime) -> Conditioned:
        """Condition Gaussians on time t; f_temp = exp(-1/2 lambda_t (t - mu_t)^2 / S_t) multiplies opacities."""
        time = query.time
        assert time is not None
        factor, delta = _leading_first(self.factors(raw)), time - raw["times"]
        # A Gaussian that is culled at this time is sliced at its own mean time instead, so its mean does not move.
        # Otherwise the huge numbers of a Gaussian that is thin in time would give gradients of 0 x inf.
        with torch.no_grad():
            visible = self.opacity_factor(factor, delta) > TIME_OPACITY_FACTOR_MIN
        mean = torch.cat([raw["means"], raw["times"]], -1)
        at = torch.where(visible[:, None], time, raw["times"])
        means, factors, _ = slice_gaussians(mean, factor, at, scheme=self.scheme)
        opacity_factor = self.opacity_factor(factor, torch.where(visible[:, None], delta, 0.0))
        return Conditioned(means, factors, torch.where(visible, opacity_factor, 0.0))

    def static(self, raw: Raw) -> Conditioned:
        """Return the 3D Gaussians of Gaussians that ignore time, from left quaternions and spatial scales."""
        factors = rotation(turn_of_space(raw["left_quats"])) * sizes(raw["scales"][:, :3])[:, None, :]
        return Conditioned(raw["means"], factors, torch.ones_like(raw["opacities"]))

    def shaped_as(self, trained: TrainedGaussians, raw: Raw) -> Raw:
        left = turn_of_space(trained.quats)
        scales = torch.cat([trained.log_scales, raw["scales"][:, 3:]], 1)
        return {"scales": scales, "left_quats": left, "right_quats": partner(left)}

    @torch.no_grad()
    def frozen(self, raw: Raw, queries: Sequence[CameraTime], weights: Tensor) -> dict[str, Raw]:
        """Remove the dependence on time: replace means and opacities by their weighted averages over views.

        The covariance becomes the conditional one, which is the same at all times.
        """
        factor = self.factors(raw).double()
        blocks = reduce(factor)
        shift, opacity = torch.zeros_like(factor[:, 3:, 0]), torch.zeros_like(factor[:, 0, 0])  # [N, 1], [N]
        for query, weight in zip(queries, weights.double(), strict=True):
            assert query.time is not None
            delta = (query.time - raw["times"]).double()
            f_temp = self.opacity_factor(factor, delta)
            shift += weight[:, None] * delta
            f_temp = torch.where(f_temp > TIME_OPACITY_FACTOR_MIN, f_temp, 0.0)
            opacity += weight * f_temp * torch.sigmoid(raw["opacities"].double())
        turn, lengths, _ = torch.linalg.svd(blocks.T_pp)
        # A mirrored turn times -1 is a rotation, with the same covariance.
        left = turn_of_space(quaternion(turn * torch.linalg.det(turn)[:, None, None]))
        new = {
            "means": raw["means"] + (gain_of(blocks.T_pq, blocks.T_qq) @ shift[..., None])[..., 0],
            "scales": torch.cat([log(lengths), torch.full_like(shift, LOG_SIZE_MAX)], -1),
            "left_quats": left,
            "right_quats": partner(left),
            "opacities": torch.logit(opacity.clamp(OPACITY_MARGIN, 1 - OPACITY_MARGIN)),
        }
        static = {name: value.to(raw[name].dtype) for name, value in new.items()}
        return {"static": static}

    def full_order(self) -> int:
        return ColorOrder(self.active.sh_degree, self.time_degree + 1).packed

    def lower_orders(self) -> list[int]:
        """List the reduced colours: SH degrees up to the one in use, each constant in time or with all frequencies."""
        degrees = range(self.active.sh_degree + 1)
        orders = {ColorOrder(degree, waves).packed for waves in (1, self.time_degree + 1) for degree in degrees}
        return sorted(orders - {self.full_order()})

    def used_entries(self, effect_sets: EffectSets) -> dict[str, Tensor]:
        """Return masks of the parameter entries that affect an image, so that the others need not be stored.

        The result is empty if colours have no orders, because all entries are used then. A static Gaussian does not use
        its right quaternion and its scale in time. It uses its mean time only if its colour changes with time.
        """
        orders = effect_sets.orders
        if orders is None:
            return {}
        coefficients = coefficients_within(orders, self.sh_degree, self.time_degree + 1)
        moves = effect_sets.is_conditioned[:, None]
        is_of_space = torch.tensor([[True, True, True, False]], device=orders.device)
        uses_mean_time = moves | (order_of(orders).waves > 1)[:, None]  # one wave: a colour that is constant in time
        return {
            "shN": coefficients.flatten(1)[:, 1:, None],  # the constant coefficient is stored in sh0
            "times": uses_mean_time,
            "right_quats": moves.expand(-1, 4),
            "scales": moves | is_of_space,
        }

    def constant(self, name: str) -> float:
        return LOG_SIZE_MAX if name == "scales" else 0.0

    @torch.no_grad()
    def fill(self, effect_sets: EffectSets) -> None:
        """Set parameter entries of static Gaussians that change no image to constants.

        The right quaternions are set such that the 4D rotations turn only space.
        """
        super().fill(effect_sets)
        left = self.splats["left_quats"].data[effect_sets.conditioned :]
        self.splats["right_quats"].data[effect_sets.conditioned :] = partner(left)

    def uses_kernel(self, raw: Raw) -> bool:
        return self.scheme == "square_root" and super().uses_kernel(raw)

    def kernel_arguments(self, raw: Raw, query: CameraTime) -> dict[str, Any]:
        return super().kernel_arguments(raw, query) | {"clock": self.clock}

    def shade(self, raw: Raw, means: Tensor, opacities: Tensor, query: CameraTime) -> Tensor:
        """Compute the colours [N, 3] at a camera centre and a time: `sh_time_colors`, or the same by a kernel."""
        assert query.time is not None
        sh0, degree, waves = raw["sh0"].flatten(1, 2), self.active.sh_degree, self.time_degree + 1
        if waves <= MAX_WAVES and self.backend.serves(means):  # as the kernel has no more
            timed = {"times": raw["times"], "time": query.time} if waves > 1 else {}
            return show_colors(
                sh0,
                raw["shN"],
                means,
                opacities,
                center=query.center,
                degree=degree,
                waves=waves,
                orders=self.orders,
                **timed,
            )[0]
        coefficients = torch.cat([sh0, raw["shN"]], 1).unflatten(1, (waves, -1))
        directions = unit(means - query.center)
        return sh_time_colors(coefficients, directions, degree, query.time - raw["times"][:, 0], self.orders)

    def initial_colors(self, dc: Tensor) -> Raw:
        K = (self.sh_degree + 1) ** 2
        waves = dc.new_zeros(len(dc), self.time_degree + 1, K, 3)
        return {"sh0": dc[:, None, None], "shN": waves.flatten(1, 2)[:, 1:]}

    def spatial_scales(self) -> Tensor:
        return sizes(self.splats["scales"][:, :3])

    def hold_sizes(self, least: Tensor) -> None:
        self.splats["scales"].data[:, :3].clamp_(min=log(least)[:, None])

    def hold_lifetimes(self, least: float) -> None:
        """Raise the fourth scale of each Gaussian to `least` sqrt(lambda_t) clips, in world units (`clock`)."""
        least_scale = math.log(least) + 0.5 * self.log_lambda["time"].detach() + log(self.clock)
        self.splats["scales"].data[:, 3].clamp_(min=least_scale)

    @torch.no_grad()
    def shrink_rows(self, rows: Tensor, factors: Tensor) -> None:
        """Multiply the three spatial scales by factors. This is exact if the 4D rotation turns only space."""
        self.splats["scales"].data[rows, :3] += log(factors)[:, None].to(self.splats["scales"].dtype)

    def split(self, raw: Raw, generator: torch.Generator) -> Raw:
        """Sample means and times of children from the parent Gaussian; all four scales are 1.6 times smaller."""
        z = torch.randn(len(raw["means"]), 4, generator=generator).to(raw["means"])
        offset = (self.factors(raw) @ z[..., None])[..., 0]
        return {
            "means": raw["means"] + offset[:, :3],
            "times": raw["times"] + offset[:, 3:],
            "scales": raw["scales"] - math.log(SHRINK),
        }

    def opacity_factor(self, factor: Tensor, delta: Tensor) -> Tensor:
        """Compute the opacity factors f_temp [N] from factors [N, 4, 4] and time offsets delta = t - mu_t [N, 1]."""
        return exp(-0.5 * self.lambda_of("time") * mahalanobis(factor[:, 3:], delta))

    def factors(self, raw: Raw) -> Tensor:
        """Compute the factors R S of the covariances over (x, y, z, t), [N, 4, 4]; t is in [0, 1] for the scene."""
        factor = rotation4d(raw["left_quats"], raw["right_quats"]) * sizes(raw["scales"])[:, None, :]
        return torch.cat([factor[:, :3], factor[:, 3:] / self.clock], 1)


def _leading_first(factor: Tensor) -> Tensor:
    """Swap two columns of each factor F [N, 4, 4] so that the largest entry of the row of t comes first.

    F F^T does not change. In a Gaussian that is long in time, columns differ by factors of 10^7. With this order the
    Householder reflection is accurate in all columns (Powell and Reid 1969; Cox and Higham 1998).
    """
    largest = factor[:, 3].detach().abs().argmax(-1, keepdim=True)
    columns = torch.arange(4, device=factor.device).repeat(len(factor), 1)
    columns[:, :1] = largest
    columns.scatter_(1, largest, 0)  # where it was
    return factor.gather(2, columns[:, None].expand_as(factor))
