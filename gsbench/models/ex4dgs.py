"""Define Ex4DGS: 3D Gaussians with a constant velocity, of which those that move most come to follow keyframes.

Lee et al., "Fully Explicit Dynamic Gaussian Splatting", NeurIPS 2024, arXiv 2410.15629, with the constants of the
authors' code.
"""

from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from gsbench.errors import check_known
from gsbench.kernels.slices import slice_static
from gsbench.kernels.tape import collect_gradients
from gsbench.kernels.tensors import check_number, check_whole
from gsbench.models.base import Raw
from gsbench.models.camera_time import CameraTime
from gsbench.models.factors import sizes
from gsbench.models.gaussian_batch import Conditioned, Geometry
from gsbench.models.moving import MovingGaussians3D
from gsbench.models.portable_math import acos, exp, log, sin, sqrt
from gsbench.models.registry import register
from gsbench.scenes.scene import Points

RISES = ("text", "code")
FOREVER = 1e6  # half the width of the window of a static Gaussian, key intervals
LEAST_FADE = 0.3 / 2.36  # key intervals
LEAST_ANGLE = 1e-4  # of slerp: how far the cosine stays from +-1
LEAST_SPEED = 1e-3  # in the logarithm of the penalty of velocities, extents a clip


@register("ex4dgs")
class Ex4DGSModel(MovingGaussians3D, gates=True):
    """Ex4DGS: a static Gaussian has a velocity v, a dynamic one positions p_k and quaternions q_k at keyframes,

        static    mean = mu_p + v t                        opacity = sigmoid(o)
        dynamic   mean = mu_p + hermite(p_k, tau)          opacity = sigmoid(o) f(tau)
                  cov = R S S^T R^T with R of slerp(q_k, tau)

    tau = 1 + n t counts keyframes, of which the first and the last lie outside of the clip. f is 1 in a window, and
    falls as exp(-(x / (e^w + 0.127))^2) at x before and after it, with a w for each side. All Gaussians start static.
    Before each round of density control, those that move most become dynamic. Positions are relative to mu_p, and
    quaternions are added to that of the Gaussian, so density control moves and copies paths as a whole.
    """

    observes = ("time",)
    geometry = ("scales", "quats", "velocities")  # at a time, AGR has no use for other keyframes
    lengths = ("means", "velocities", "key_means")
    moving = ("velocities", "key_means", "key_quats", "windows", "fades")
    kernel = slice_static

    def __init__(
        self,
        *,
        intervals: int = 10,  # n, between keyframes; the authors': one for 10 frames
        dynamic_share: float = 0.02,  # of the visible static Gaussians, which become dynamic in a round
        rise: str = "text",  # before a window, x counts from its beginning; `code`: from its end, as the authors' code
        velocity_penalty: float = 1e-4,  # weights in the loss, see `penalty`
        key_penalty: float = 1e-4,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        check_whole(intervals, "intervals", 1, 1024)
        check_number(dynamic_share, "dynamic_share", 0, 1)
        check_number(velocity_penalty, "velocity_penalty", 0)
        check_number(key_penalty, "key_penalty", 0)
        check_known("rise", rise, RISES)
        self.intervals, self.dynamic_share, self.rise = intervals, dynamic_share, rise
        self.velocity_penalty, self.key_penalty = velocity_penalty, key_penalty

    def initial_geometry(self, points: Points, distances: Tensor, generator: torch.Generator) -> Raw:
        """Return static spheres at rest."""
        N, n = len(distances), self.intervals
        return super().initial_geometry(points, distances, generator) | {
            "velocities": torch.zeros(N, 3),
            "key_means": torch.zeros(N, 3 * (n + 3)),  # at tau = 0 to n + 2
            "key_quats": torch.zeros(N, 4 * (n + 1)),  # at tau = 1 to n + 1, none outside of the clip
            "windows": torch.tensor([-FOREVER, FOREVER]).repeat(N, 1),
            "fades": log(torch.full((N, 2), float(n))),  # as long as the clip
        }

    def before_density(self, centers: Tensor, drawn: Tensor) -> None:
        """Make those static Gaussians dynamic that move most for the square of their distance from a camera.

        They keep their motion. Their windows are the middle half of the clip.
        """
        raw, n = self.raw_of(torch.arange(len(self), device=drawn.device)), self.intervals
        is_static = ~is_dynamic(raw)[:, 0] & drawn  # [V, N]
        squares = (raw["means"] - centers[:, None]).square().sum(-1)  # [V, N] of distances
        motion = raw["velocities"].square().sum(-1) / squares.square()  # (|v| / distance^2)^2
        order = torch.where(is_static, motion, -1.0).amax(0).argsort(descending=True, stable=True)
        rows = order[: int(self.dynamic_share * is_static.any(0).sum())]
        times = torch.arange(-1, n + 2).to(motion) / n  # of the keyframes
        splats = {name: x.data for name, x in self.splats.items()}
        splats["key_means"][rows] = (raw["velocities"][rows, None] * times[:, None]).flatten(1)
        splats["velocities"][rows] = 0
        splats["windows"][rows] = torch.tensor([1 + n / 4, 1 + 3 * n / 4]).to(motion)

    def change(self, raw: Raw, query: CameraTime) -> tuple[Tensor, Tensor]:
        """Return shifts [N, 3], along keyframes or v t, and the factors f(tau) [N] of opacities."""
        assert query.time is not None
        tau = self.tau(query.time)
        along_keys = hermite(raw["key_means"].unflatten(1, (-1, 3)), tau)
        moved = torch.where(is_dynamic(raw), along_keys, raw["velocities"] * query.time)
        return moved, self.visibility(raw, tau)

    def visibility(self, raw: Raw, tau: Tensor) -> Tensor:
        """Return f(tau), [N]; it is 1 for static Gaussians, whose windows have no end."""
        begin, end = raw["windows"].amin(1), raw["windows"].amax(1)
        before, after = (sizes(raw["fades"]) + LEAST_FADE).unbind(1)
        begun = tau > begin
        # The time before or after the window; with `code` it is that to its end on both sides, as x is squared.
        x = tau - end if self.rise == "code" else torch.where(begun, tau - end, begin - tau)
        x = torch.where(begun & (tau < end), 0.0, x / torch.where(begun, after, before))
        return exp(-x.square())

    def turned(self, raw: Raw, query: CameraTime) -> Tensor:
        """Return the quaternions [N, 4] at a time."""
        assert query.time is not None
        tau = self.tau(query.time)
        k = tau.floor().clamp(max=self.intervals).long()  # the last keyframe before this time, from 1 to n
        # Keyframes k and k + 1; quaternions begin at keyframe 1.
        pair = raw["key_quats"].unflatten(1, (-1, 4)).index_select(1, k + torch.arange(-1, 1, device=k.device))
        first, last = F.normalize(raw["quats"][:, None] + pair, dim=-1).unbind(1)
        return torch.where(is_dynamic(raw), slerp(first, last, tau - k), raw["quats"])

    def tau(self, time: Tensor) -> Tensor:
        """Return a time of the clip in key intervals, []."""
        return 1 + self.intervals * time.clamp(0, 1)

    def condition(self, raw: Raw, query: CameraTime) -> Conditioned:
        return super().condition(raw | {"quats": self.turned(raw, query)}, query)

    def slice_geometry(self, raw: Raw, query: CameraTime) -> Geometry:
        """Slice as other models do; gradients pass the path and the window once, not for each kernel that follows."""
        geometry = super().slice_geometry(raw, query)
        means, opacities = collect_gradients(geometry.means, geometry.opacities)
        return geometry._replace(means=means, opacities=opacities)

    def kernel_arguments(self, raw: Raw, query: CameraTime) -> dict[str, Any]:
        """Return Gaussians that were turned in torch, except for those that gates made static."""
        changing = self.turned({name: x[: self.conditioned] for name, x in raw.items()}, query)
        quats = torch.cat([changing, raw["quats"][len(changing) :]])
        return super().kernel_arguments(raw | {"quats": quats}, query)

    @torch.no_grad()
    def frozen(self, raw: Raw, queries: Sequence[CameraTime], weights: Tensor) -> dict[str, Raw]:
        """Replace means, opacities and quaternions by their weighted averages over views."""
        quats = torch.stack([self.turned(raw, query) for query in queries])  # [V, N, 4]
        mean = (weights[..., None].to(quats) * quats).sum(0)
        return {"static": super().frozen(raw, queries, weights)["static"] | {"quats": mean}}

    def penalty(self) -> Tensor:
        """Return the weighted sum of two means in units of the extent, [].

        They are ln(|v| + 1e-3) of static Gaussians, and |p_0 - p_k| of dynamic ones, a mean over keyframes and axes.
        """
        raw = {name: x[: self.conditioned] for name, x in self.splats.items()}
        dynamic = is_dynamic(raw)[:, 0]
        speeds = torch.linalg.vector_norm(raw["velocities"], dim=1) / self.extent
        keys = raw["key_means"].unflatten(1, (-1, 3)) / self.extent
        paths = (keys[:, :1] - keys).abs().mean((1, 2))
        of_static = mean_of(log(speeds + LEAST_SPEED), ~dynamic)
        return self.velocity_penalty * of_static + self.key_penalty * mean_of(paths, dynamic)

    def split(self, raw: Raw, generator: torch.Generator) -> Raw:
        """Return the children of 3DGS; those of dynamic Gaussians lie twice as far away."""
        children = super().split(raw, generator)
        offset = children["means"] - raw["means"]
        return children | {"means": raw["means"] + torch.where(is_dynamic(raw), 2 * offset, offset)}

    def lifetimes(self) -> tuple[Tensor, Tensor]:
        """Return the middles of the windows [N], and how far from them opacities fall to exp(-1/2), [N]."""
        windows, fades = self.splats["windows"].detach(), self.splats["fades"].detach()
        reach = (windows[:, 1] - windows[:, 0]).abs() / 2 + (sizes(fades.amax(1)) + LEAST_FADE) * 0.5**0.5
        return (windows.mean(1) - 1) / self.intervals, reach / self.intervals

    def fading_times(self, fading: Tensor, lifetimes: Tensor) -> Tensor:
        fade = (sizes(self.splats["fades"].detach().amax(1)) + LEAST_FADE) / self.intervals
        half_window = lifetimes - fade * 0.5**0.5
        return torch.where(fading > 0, half_window + fade * sqrt(fading), 0.0)  # behind it, exp(-(x / fade)^2)


def is_dynamic(raw: Raw) -> Tensor:
    """Return which Gaussians follow keyframes, [N, 1] bool: those whose windows have ends."""
    return (raw["windows"].abs() < FOREVER / 2).all(1, keepdim=True)


def hermite(keys: Tensor, tau: Tensor) -> Tensor:
    """Interpolate positions [N, K, 3] at keyframes 0, 1, .. K - 1 by cubic polynomials (section 3.2).

    Between keyframes k and k + 1, a Hermite polynomial with the slopes (p_k+1 - p_k-1) / 2 at its ends gives to the
    keyframe at a distance of x intervals the weight of cubic convolution (Keys 1981).
    """
    x = (tau - torch.arange(keys.shape[1], device=keys.device)).abs()
    near, far = 1 + x * x * (1.5 * x - 2.5), 2 - x * (4 - x * (2.5 - 0.5 * x))
    weights = torch.where(x < 1, near, torch.where(x < 2, far, 0.0))
    return (weights[:, None] * keys).sum(1)


def slerp(first: Tensor, last: Tensor, u: Tensor) -> Tensor:
    """Turn unit quaternions [N, 4] by a fraction u of the angle to others, by the longer way if it is above 180°."""
    cosine = (first * last).sum(1, keepdim=True).clamp(LEAST_ANGLE - 1, 1 - LEAST_ANGLE)
    angle = acos(cosine)
    return F.normalize(sin((1 - u) * angle) * first + sin(u * angle) * last, dim=1)


def mean_of(x: Tensor, rows: Tensor) -> Tensor:
    """Return the mean over some rows [N] bool of x [N], []; 0 if there are none."""
    return torch.where(rows, x, 0.0).sum() / rows.sum().clamp(min=1)
