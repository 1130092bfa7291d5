"""Define 6DGS, 7DGS and N-DGS: Gaussians over position, direction and time, with a Cholesky factor as parameter."""

import math
from collections.abc import Sequence
from typing import Any, ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor

from gsbench.errors import InputError, check_known
from gsbench.kernels.headers import EXPONENT_MAX, LOG_SIZE_MAX
from gsbench.kernels.slices import slice_triangular
from gsbench.models.base import SHRINK, Raw
from gsbench.models.camera_time import CameraTime, initial_times, times_inside, unit
from gsbench.models.effect_sets import EffectSets
from gsbench.models.factors import KINDS, OFF_DIAGONALS, CholeskyLayout, rotation, sizes
from gsbench.models.gated import OPACITY_MARGIN, JointModel
from gsbench.models.gaussian_batch import Conditioned
from gsbench.models.portable_math import exp, log, logit
from gsbench.models.registry import register
from gsbench.models.slicing import Reduced, check_scheme, gain_of, reduce, slice_gaussians, whiten
from gsbench.scenes.gaussian_ply import TrainedGaussians
from gsbench.scenes.scene import Points

# The order of position, time and direction among the rows of the triangular factor.
FACTOR_ORDERS = {"paper": "ptd", "conditioned_first": "dtp"}
WIDTH = {"p": 3, "t": 1, "d": 3}
CENTERS = {"time": "times", "direction": "directions"}  # the raw parameters that are the means of time and direction
LETTERS = {"time": "t", "direction": "d"}
FLATTEST = 1e-9  # least ratio of the smallest to the largest scale of a trained Gaussian
TIME_CORRELATION = 0.05  # a Gaussian is split in time if |S_pt| is above this part of the scene's extent ..
TIME_SCALE = 0.25  # .. and sqrt(S_t) is above this part of the scene's length (7DGS, section 4.4)


class CholeskyModel(JointModel):
    """The base class of 6DGS and 7DGS: Gaussians over position p, and over direction d, time t, or d and t.

    The parameters are those of a lower triangular factor of the covariance. Before conditioning on d and t, its rows
    are sorted to (p, d, t).
    """

    geometry: ClassVar[tuple[str, ...]] = ("log_diagonal", *KINDS)
    lengths = ("means", "motion")
    kernel = slice_triangular
    takes_views = True
    directional_half = True  # whether f_dir has the 1/2 of 7DGS eq. 12
    unit_directions = False  # whether mean directions are normalised when a Gaussian is sliced
    bounded_times = False  # whether mean times are sigmoids of their parameters

    def __init__(
        self,
        *,
        factor_order: str = "conditioned_first",  # of the rows: (direction, time, position); paper: (p, t, d)
        scheme: str = "square_root",  # the numerical method of conditioning, see `slice_gaussians`
        off_diagonal: str = "relative",  # how a parameter gives an entry below the diagonal, see `CholeskyLayout`
        split_in_time: bool = True,  # whether moving Gaussians are also split if they are long in time (section 4.4)
        **options: Any,
    ) -> None:
        super().__init__(**options)
        check_known("factor_order", factor_order, FACTOR_ORDERS)
        check_scheme(scheme)
        self.factor_order = factor_order
        self.scheme = scheme
        self.split_in_time = split_in_time
        # The row numbers of p, d and t in the triangular factor, then the indices of d and t in q, ordered (d, t).
        variables = "p" + "".join(LETTERS[x] for x in self.observes)
        letters = "".join(x * WIDTH[x] for x in FACTOR_ORDERS[factor_order] if x in variables)  # such as dddtppp
        self.rows = {x: [i for i, letter in enumerate(letters) if letter == x] for x in "pdt"}
        columns = {"time": [len(letters) - WIDTH["p"] - 1], "direction": [0, 1, 2]}  # t is the last of q
        self.columns = {x: columns[x] for x in columns if x in self.observes}
        self.layout = CholeskyLayout(letters, off_diagonal)
        self.is_reduced = factor_order == "conditioned_first" and scheme == "square_root"

    def initial_geometry(self, points: Points, distances: Tensor, generator: torch.Generator) -> Raw:
        """Return spheres with random mean times and directions.

        The standard deviation is sqrt(1/10) in time and 1 in direction. Mean times are those of the points, else
        uniform in [-0.1, 1.1]; with `bounded_times` they are clipped to [0, 1]. Mean directions are uniform on the unit
        sphere.
        """
        N = len(distances)
        log_diagonal = torch.zeros(N, len(self.layout.letters))
        log_diagonal[:, self.rows["p"]] = log(distances)[:, None]
        log_diagonal[:, self.rows["t"]] = 0.5 * math.log(1 / 10)
        raw = {"log_diagonal": log_diagonal}
        raw |= {kind: torch.zeros(N, len(self.layout.places[kind])) for kind in self.layout.kinds}
        if "direction" in self.observes:
            raw["directions"] = F.normalize(torch.randn(N, 3, generator=generator), dim=-1)
        if "time" in self.observes:
            times = initial_times(points, generator)
            raw["times"] = logit(times_inside(times)) if self.bounded_times else times
        return raw

    def condition(self, raw: Raw, query: CameraTime) -> Conditioned:
        """Condition Gaussians on time t and on the unit vector d from the camera to their means (7DGS, algorithm 1)."""
        factor, offset = self.factors(raw), self.offset(raw, query)
        k = offset.shape[1]
        # `factors` sorts rows to (p, d, t), and leaves the columns in the order of the parametrization. If this is
        # (d, t, p), the first columns are T_qq and T_pq, and the last T_pp.
        reduced = (
            Reduced(factor[:, 3:, :k], factor[:, :3, :k], factor[:, :3, k:]) if self.is_reduced else reduce(factor)
        )
        # If q is so far from mu_q that the opacity is zero, T_qq is replaced by the identity and q by mu_q, and the
        # opacity factor is zero. Otherwise the huge numbers would give gradients of 0 x inf.
        with torch.no_grad():
            visible = self.exponents(reduced.T_qq, offset, whiten(reduced.T_qq, offset))["static"] < EXPONENT_MAX
        delta = torch.where(visible[:, None], offset, 0.0)
        T_qq = torch.where(visible[:, None, None], reduced.T_qq, torch.eye(delta.shape[1]).to(delta))
        white = whiten(T_qq, delta)
        opacity_factor = torch.where(visible, exp(-self.exponents(T_qq, delta, white)["static"]), 0.0)
        if self.scheme == "square_root":
            means, factors = raw["means"] + (reduced.T_pq * white[:, None]).sum(-1), reduced.T_pp
        else:  # these schemes are for comparison, and do without `delta`
            mean = F.pad(raw["means"], (0, k))  # q is measured from mu_q
            means, factors, _ = slice_gaussians(mean, factor, offset, scheme=self.scheme)
        return Conditioned(means, factors, opacity_factor)

    def static(self, raw: Raw) -> Conditioned:
        """Return 3D Gaussians whose covariance factor is the position block of the Cholesky factor."""
        space = self.rows["p"]
        layout = CholeskyLayout("ppp", self.layout.form)  # has the kind `shape` only
        factors = layout.factor(raw["log_diagonal"][:, space], raw)
        return Conditioned(raw["means"], factors, torch.ones_like(raw["opacities"]))

    def uses_kernel(self, raw: Raw) -> bool:
        schemes = ("square_root", "cholesky") if raw["means"].is_cpu else ("square_root",)
        return self.scheme in schemes and super().uses_kernel(raw)

    def kernel_arguments(self, raw: Raw, query: CameraTime) -> dict[str, Any]:
        """Return also the means of time and direction, and numbers by which the kernel knows the model's options."""
        named = super().kernel_arguments(raw, query) | {
            "coupling": raw.get("coupling", raw["motion"].detach()[..., :0]),  # [N, 0] if q is time alone
            "half": 0.5 if self.directional_half else 1.0,
            "conditioned_first": self.factor_order == "conditioned_first",
            "form": OFF_DIAGONALS.index(self.layout.form),
            "subtracts": self.scheme == "cholesky",
        }
        named |= {"times": self.mean_times(raw)} if "time" in self.observes else {}
        return named | ({"directions": self.mean_directions(raw)} if "direction" in self.observes else {})

    def spatial_scales(self) -> Tensor:
        return sizes(self.splats["log_diagonal"][:, self.rows["p"]])

    def scales(self) -> Tensor:
        """Return the largest standard deviation of each conditional 3D Gaussian, [N]; it is the same at all times."""
        T_pp = reduce(self.factors(dict(self.splats.items())).detach()).T_pp
        return torch.linalg.matrix_norm(T_pp, ord=2)

    def hold_sizes(self, least: Tensor) -> None:
        space = self.rows["p"]  # adjacent, so that a slice, which shares memory, takes them
        self.splats["log_diagonal"].data[:, space[0] : space[-1] + 1].clamp_(min=log(least)[:, None])

    def split(self, raw: Raw, generator: torch.Generator) -> Raw:
        """Split Gaussians in time if they move and are long in time, else in space.

        A split in time samples the mean times of the children and moves their means along the parent's path. The
        standard deviation in time becomes 1.6 times smaller. A split in space samples the means of the children from
        the parent's conditional 3D Gaussian, whose scales become 1.6 times smaller. The gain K, the derivative of the
        mean with respect to time and direction, does not change.
        """
        factor = self.factors(raw)
        T_qq, T_pq, T_pp = reduce(factor)
        gain = gain_of(T_pq, T_qq)
        in_time = self.moves_long(factor)[:, None]  # [N, 1]
        z = torch.randn(raw["means"].shape, generator=generator).to(factor)
        children = {"means": raw["means"] + torch.where(in_time, 0, (T_pp @ z[..., None])[..., 0])}
        T_pp = torch.where(in_time[..., None], T_pp, T_pp / SHRINK)
        if "time" in self.observes:
            # The mean time of a child differs by dt = z sigma from its parent's. At any (t, d) its slice has the mean
            # of the parent's slice, since K (q - mu_q) changes by -K_t dt and mu_p by K_t dt.
            # sigma is at most the length of the clip: that of a Gaussian that stands still grows without end, and AGR
            # reads mean times.
            sigma = factor[:, -1].norm(dim=-1, keepdim=True).clamp(max=1)
            children["times"], dt = self.shifted_times(raw, torch.where(in_time, z[:, :1] * sigma, 0))
            children["means"] = children["means"] + gain[..., -1] * dt
            T_qq = torch.cat([T_qq[:, :-1], torch.where(in_time[..., None], T_qq[:, -1:] / SHRINK, T_qq[:, -1:])], 1)
        return children | self._parameters_of(T_qq, gain @ T_qq, T_pp)

    @torch.no_grad()
    def shrink_rows(self, rows: Tensor, factors: Tensor) -> None:
        """Multiply factors T_pp of conditional covariances by a number for each Gaussian; motion does not change."""
        # In double precision, because T_qq and T_pq are computed anew too.
        raw = {name: value.detach()[rows].double() for name, value in self.splats.items()}
        T_qq, T_pq, T_pp = reduce(self.factors(raw))
        for name, value in self._parameters_of(T_qq, T_pq, T_pp * factors[:, None, None]).items():
            self.splats[name].data[rows] = value.to(self.splats[name].dtype)

    def _parameters_of(self, T_qq: Tensor, T_pq: Tensor, T_pp: Tensor) -> dict[str, Tensor]:
        """Compute the parameters of covariance factors from the blocks of [T_qq 0; T_pq T_pp]."""
        return self.layout.parameters(self._assembled(T_qq, T_pq, T_pp))

    def _assembled(self, T_qq: Tensor, T_pq: Tensor, T_pp: Tensor) -> Tensor:
        """Assemble covariance factors [N, n, n] from blocks [T_qq 0; T_pq T_pp] of position p and other variables q."""
        q_rows = torch.cat([T_qq, T_qq.new_zeros(*T_qq.shape[:2], 3)], -1)
        sorted_rows = self.rows["p"] + self.rows["d"] + self.rows["t"]
        order = sorted(range(len(sorted_rows)), key=sorted_rows.__getitem__)  # back to that of the model's factor
        return torch.cat([torch.cat([T_pq, T_pp], -1), q_rows], 1)[:, order]

    def used_entries(self, effect_sets: EffectSets) -> dict[str, Tensor]:
        """Return masks of the entries that affect an image; in a static Gaussian, time and direction do not."""
        masks = super().used_entries(effect_sets)
        if effect_sets.orders is None:
            return masks
        static = ~effect_sets.is_conditioned
        gone = {"p": torch.zeros_like(static), "t": static, "d": static}  # [N] which Gaussians have lost a variable
        masks["log_diagonal"] = ~torch.stack([gone[x] for x in self.layout.letters], -1)
        for kind in self.layout.kinds[1:]:  # all but shape
            pairs = [self.layout.pair(place) for place in self.layout.places[kind]]
            masks[kind] = ~torch.stack([gone[a] | gone[b] for a, b in pairs], -1)
        if "direction" in self.observes:
            masks["directions"] = ~static[:, None]
        if "time" in self.observes:
            masks["times"] = ~static[:, None]
        return masks

    def constant(self, name: str) -> float:
        return LOG_SIZE_MAX if name == "log_diagonal" else 0.0

    def shaped_as(self, trained: TrainedGaussians, raw: Raw) -> Raw:
        """Return initial Cholesky factors whose block of position is that of trained 3D Gaussians."""
        space = torch.tensor(self.rows["p"])
        double = {name: value.double() for name, value in raw.items()}
        factor = self.layout.factor(double["log_diagonal"], double)  # diagonal: the model starts without coupling
        # The smallest scale of a flat Gaussian is computed as a difference of numbers as large as its largest scale.
        log_scales = trained.log_scales.double()
        log_scales = log_scales.clamp(min=log_scales.amax(1, keepdim=True) + math.log(FLATTEST))
        factor[:, space[:, None], space] = rotation(trained.quats.double()) * sizes(log_scales)[:, None, :]
        return self.layout.parameters(factor)

    @torch.no_grad()
    def frozen(self, raw: Raw, queries: Sequence[CameraTime], weights: Tensor) -> dict[str, Raw]:
        """Return parameters of Gaussians that do not depend on time, on direction, or on both.

        To remove the dependence on a variable, its columns of the gain K (the derivative of the mean with respect to
        the variable) become zero. The average shift of the mean over views is added to the mean, and the opacity is
        multiplied by the average opacity factor. The standard deviation of the variable becomes exp(LOG_SIZE_MAX), so
        that the opacity factor is 1 for every view. `weights` are [V, N].
        """
        blocks = Reduced(*(block.double() for block in reduce(self.factors(raw))))
        gain = gain_of(blocks.T_pq, blocks.T_qq)
        removed = {name: [name] for name in self.columns} | {"static": list(self.columns)}  # variables, by the result
        shift = torch.zeros_like(gain[:, 0])  # [N, k] mean of q - mu_q over views
        opacity_factors = {name: torch.zeros_like(gain[:, 0, 0]) for name in removed}  # [N]
        for query, weight in zip(queries, weights.double(), strict=True):
            delta = self.offset(raw, query).double()
            shift += weight[:, None] * delta
            exponents = self.exponents(blocks.T_qq, delta, whiten(blocks.T_qq, delta))
            for name, factor in opacity_factors.items():
                factor += weight * exp(-exponents[name])
        changed = {}
        for name, variables in removed.items():
            columns = [column for x in variables for column in self.columns[x]]
            moved = raw["means"] + (gain[..., columns] @ shift[:, columns, None])[..., 0]
            opacity = torch.sigmoid(raw["opacities"].double()) * opacity_factors[name]
            new = self.layout.parameters(self._without(blocks, gain, variables)) | {"means": moved}
            new["opacities"] = torch.logit(opacity.clamp(OPACITY_MARGIN, 1 - OPACITY_MARGIN))
            new |= {CENTERS[x]: torch.zeros_like(raw[CENTERS[x]]) for x in variables}
            changed[name] = {key: value.to(raw["means"].dtype) for key, value in new.items()}
        return changed

    def _without(self, blocks: Reduced, gain: Tensor, variables: list[str]) -> Tensor:
        """Compute Cholesky factors [N, n, n] that ignore the given variables, from present blocks and gain K."""
        T_qq, gain_left = blocks.T_qq.clone(), gain.clone()
        if "direction" in variables and "time" in self.observes:
            # Without d, the row of t has its whole standard deviation on the diagonal.
            deviation = T_qq[:, -1].norm(dim=-1)
            T_qq[:, -1] = 0
            T_qq[:, -1, -1] = deviation
        for column in [column for x in variables for column in self.columns[x]]:
            T_qq[:, column] = 0
            T_qq[:, column, column] = math.exp(LOG_SIZE_MAX)
            gain_left[..., column] = 0
        return self._assembled(T_qq, gain_left @ T_qq, blocks.T_pp)

    def factors(self, raw: Raw) -> Tensor:
        """Compute Cholesky factors from raw parameters, with rows sorted to (position, direction, time), [N, n, n]."""
        L = self.layout.factor(raw["log_diagonal"], raw)
        return L[:, self.rows["p"] + self.rows["d"] + self.rows["t"]]

    def offset(self, raw: Raw, query: CameraTime) -> Tensor:
        """Compute the offset q - mu_q of direction and time from their means, [N, k], ordered (direction, time)."""
        offsets = []
        if "direction" in self.observes:
            offsets.append(unit(raw["means"] - query.center) - self.mean_directions(raw))
        if query.time is not None and "time" in self.observes:
            offsets.append(query.time - self.mean_times(raw))
        return torch.cat(offsets, -1)

    def mean_directions(self, raw: Raw) -> Tensor:
        """Return the mean directions [N, 3], normalised if the option `unit_directions` is set."""
        return unit(raw["directions"]) if self.unit_directions else raw["directions"]

    def mean_times(self, raw: Raw) -> Tensor:
        """Return the mean times [N, 1]; with the option `bounded_times` they are sigmoids of the parameters."""
        return torch.sigmoid(raw["times"]) if self.bounded_times else raw["times"]

    def shifted_times(self, raw: Raw, shift: Tensor) -> tuple[Tensor, Tensor]:
        """Return the raw times of means that are moved by `shift` [N, 1] in time, and by how much they really moved.

        Bounded times (sigmoids) stay in (0, 1), so they may move by less. Rows with a shift of 0 keep their bits.
        """
        if not self.bounded_times:
            return raw["times"] + shift, shift
        times = self.mean_times(raw)
        inside = torch.where(shift == 0, times, times_inside(times + shift))
        return torch.where(shift == 0, raw["times"], logit(inside)), inside - times

    def exponents(self, T_qq: Tensor, delta: Tensor, white: Tensor) -> dict[str, Tensor]:
        """Compute -ln of the factor by which each variable dims a Gaussian, and of both (`static`), [N] each.

        For `direction` and `time` the factors are f_dir and f_temp (7DGS, eq. 11 and 12). T_qq is the triangular factor
        of the covariance of q = (direction, time), delta = q - mu_q, and white = T_qq^-1 delta.
        """
        exponents = {}
        if "direction" in self.observes:
            half = 0.5 if self.directional_half else 1.0
            exponents["direction"] = half * self.lambda_of("direction") * white[:, :3].square().sum(-1)
        if "time" in self.observes:
            distance = delta[:, -1] / T_qq[:, -1].norm(dim=-1)  # in standard deviations, sqrt(S_t)
            exponents["time"] = 0.5 * self.lambda_of("time") * distance.square()
        return exponents | {"static": torch.stack(list(exponents.values())).sum(0)}

    def moves_long(self, factor: Tensor) -> Tensor:
        """Return which Gaussians with covariance factors [N, n, n] move and are long in time (7DGS, section 4.4)."""
        if "time" not in self.observes or not self.split_in_time:
            return torch.zeros(len(factor), dtype=torch.bool, device=factor.device)
        S_pt = (factor[:, :3] @ factor[:, -1:].mT)[..., 0]
        return (S_pt.norm(dim=-1) > TIME_CORRELATION * self.extent) & (factor[:, -1].norm(dim=-1) > TIME_SCALE)

    @torch.no_grad()
    def long_in_time(self) -> Tensor:
        """Return which Gaussians move far and live long, and are split in time (7DGS, section 4.4).

        The conditions are |S_pt| > 0.05 extent and sqrt(S_t) > 0.25, with the covariance S_pt of position and time and
        the variance S_t of time.
        """
        return self.moves_long(self.factors(dict(self.splats.items())))


class TimedModel(CholeskyModel):
    """The base class of models whose Gaussians depend on time, such as 7DGS with or without direction."""

    def __init__(
        self,
        *,
        lambda_t: float,  # the initial coefficient in the exponent of f_temp, the factor of the opacity at a time
        bounded_times: bool = False,  # whether mean times are sigmoids of their parameters, in (0, 1) (N-DGS)
        **options: Any,
    ) -> None:
        super().__init__(**options)
        self.add_lambda("time", lambda_t)
        self.bounded_times = bounded_times

    def lifetimes(self) -> tuple[Tensor, Tensor]:
        times_and_lifetimes = super().lifetimes()
        assert times_and_lifetimes is not None
        _, lifetimes = times_and_lifetimes  # the times are raw
        return self.mean_times(dict(self.splats.items()))[:, 0], lifetimes

    def hold_lifetimes(self, least: float) -> None:
        """Raise the diagonal entry of time in each factor, a lower bound of sqrt(S_t), to `least` sqrt(lambda_t)."""
        least_entry = math.log(least) + 0.5 * self.log_lambda["time"].detach()
        self.splats["log_diagonal"].data[:, self.rows["t"][0]].clamp_(min=least_entry)


class DirectionalModel(CholeskyModel):
    """The base class of models whose Gaussians depend on view direction: 6DGS, and together with time 7DGS."""

    def __init__(
        self,
        *,
        lambda_d: float,  # the initial coefficient in the exponent of f_dir, the factor of the opacity in a direction
        directional_half: bool = True,  # whether f_dir has the 1/2 of 7DGS eq. 12; 6DGS does not have it
        unit_directions: bool = False,  # whether mean directions are normalised when a Gaussian is sliced (N-DGS)
        **options: Any,
    ) -> None:
        super().__init__(**options)
        self.add_lambda("direction", lambda_d)
        self.directional_half = directional_half
        self.unit_directions = unit_directions


@register("6dgs")
class Gaussians6DModel(DirectionalModel, gates=True):
    """6DGS: Gaussians over position and direction, conditioned on the direction from the camera (Gao et al. 2024)."""

    observes = ("direction",)
    centers = ("means", "directions")


@register("7dgs")
class Gaussians7DModel(TimedModel, DirectionalModel, gates=True):
    """7DGS: Gaussians over position, time and direction, conditioned on a time and a direction (Gao et al. 2025)."""

    observes = ("time", "direction")
    centers = ("means", "times", "directions")

    def __init__(self, *, joint_gate: bool = False, **options: Any) -> None:
        """Make a model without Gaussians.

        With `joint_gate`, direction and time q dim a Gaussian together, by exp(-lambda (q - mu_q)^T S_qq^-1 (q - mu_q))
        as in N-DGS, and not by f_dir f_temp. There is no 1/2, whatever directional_half says, and one lambda, which
        lambda_t and lambda_d must both be. No kernel has it: slices are computed in torch.
        """
        super().__init__(**options)
        self.joint_gate = joint_gate
        if joint_gate:
            if not torch.equal(self.log_lambda["time"], self.log_lambda["direction"]):
                raise InputError(
                    f"joint_gate: expected lambda_d equal to lambda_t, got {options['lambda_d']} and "
                    f"{options['lambda_t']}: a joint gate has one lambda"
                )
            del self.log_lambda["direction"]

    def uses_kernel(self, raw: Raw) -> bool:
        return not self.joint_gate and super().uses_kernel(raw)

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
            "time": scale * white[:, 3].square(),  # as the squares of the first three are the distance of d alone
            "static": scale * both,
        }

    def lifetimes(self) -> tuple[Tensor, Tensor]:
        """Return the mean time mu_t [N] and the lifetime s [N] of each Gaussian; see `GaussianModel.lifetimes`.

        With a joint gate, s is that of the direction which dims the Gaussian least at each time.
        """
        times, lifetimes = super().lifetimes()
        return times, lifetimes / math.sqrt(2) if self.joint_gate else lifetimes  # a joint gate has no 1/2

    def hold_lifetimes(self, least: float) -> None:
        super().hold_lifetimes(least * math.sqrt(2) if self.joint_gate else least)


@register("7dgs_nodir")
class Gaussians7DWithoutDirectionModel(TimedModel, gates=True):
    """7DGS without direction, to test direction: Gaussians over position and time, conditioned on a time.

    4DGS also has position and time, but another covariance factor, colours that change with time, and other rates.
    """

    observes = ("time",)
    centers = ("means", "times")
    geometry = ("log_diagonal", "shape", "motion")


@register("ndgs")
class NDGSModel(Gaussians7DModel, gates=True):
    """N-DGS, the later code of the authors of 7DGS: Gaussians over position, direction and time."""

    def __init__(
        self, *, unit_directions: bool = True, bounded_times: bool = True, joint_gate: bool = True, **options: Any
    ) -> None:
        super().__init__(unit_directions=unit_directions, bounded_times=bounded_times, joint_gate=joint_gate, **options)
