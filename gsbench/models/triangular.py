"""Slice Gaussians over position and direction, time or both, by their triangular factor (6DGS and 7DGS)."""

import math
from collections.abc import Sequence
from typing import Any, ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor

from gsbench.errors import InputError, did_you_mean
from gsbench.kernels.headers import EXPONENT_MAX, LOG_SIZE_MAX
from gsbench.kernels.slices import slice_triangular
from gsbench.models.base import SHRINK, Conditioned, Geometry, Raw
from gsbench.models.effect_sets import DIRECTION, TIME, EffectSets
from gsbench.models.factors import KINDS, OFF_DIAGONALS, Triangle, rotation, sizes
from gsbench.models.gated import OPACITY_MARGIN, GatedModel
from gsbench.models.query import Query, unit
from gsbench.models.slicing import Reduced, check_scheme, gain_of, reduce, slice_gaussians, whiten
from gsbench.scenes.scene import Points
from gsbench.scenes.trained import TrainedGaussians

# The order of position, time and direction among the rows of the triangular factor.
FACTOR_ORDERS = {"paper": "ptd", "conditioned_first": "dtp"}
WIDTH = {"p": 3, "t": 1, "d": 3}
CENTERS = {"time": "times", "direction": "directions"}  # the raw parameters that are means of variables
LETTERS = {"time": "t", "direction": "d"}
FLATTEST = 1e-9  # thinnest side of a trained Gaussian in units of its widest
TIME_CORRELATION = 0.05  # split in time where |S_pt| is above this part of the scene's extent ..
TIME_SCALE = 0.25  # .. and sqrt(S_t) above this part of the clip (7DGS, section 4.4)


class TriangularModel(GatedModel):
    """Gaussians over p and d, t or both, with a lower triangular factor of their covariance.

    For slicing, the rows of a factor are ordered (p, d, t): with d before t, the leading block of the reduced factor is
    the marginal of d.
    """

    geometry: ClassVar[tuple[str, ...]] = ("log_diagonal", *KINDS)
    lengths = ("means", "motion")
    directional_half = True  # whether f_dir has the 1/2 of 7DGS eq. 12

    def __init__(
        self,
        *,
        factor_order: str = "conditioned_first",
        scheme: str = "square_root",
        off_diagonal: str = "relative",
        split_in_time: bool = True,
        **options: Any,
    ) -> None:
        """Make an empty model.

        Args:
            factor_order: `paper`, the factor triangular over (p, t, d), or `conditioned_first`, over (d, t, p).
            scheme: of `slice_gaussians`.
            off_diagonal: the `form` of `Triangle`, which says what the parameters below the diagonal mean.
            split_in_time: whether Gaussians that move are also split because of their extent in time.
            options: as `GatedModel`.

        Raises:
            InputError: an option is out of its range.
        """
        super().__init__(**options)
        if factor_order not in FACTOR_ORDERS:
            raise InputError(f"factor_order '{factor_order}' is not known. {did_you_mean(factor_order, FACTOR_ORDERS)}")
        check_scheme(scheme)
        self.factor_order = factor_order
        self.scheme = scheme
        self.split_in_time = split_in_time
        # Row numbers of p, d and t in the triangular factor; and of t and d in q, which is ordered (d, t).
        there = "p" + "".join(LETTERS[x] for x in self.observes)
        letters = "".join(x * WIDTH[x] for x in FACTOR_ORDERS[factor_order] if x in there)
        self.rows = {x: [i for i, letter in enumerate(letters) if letter == x] for x in "pdt"}
        own = {"time": [len(letters) - 4], "direction": [0, 1, 2]}
        self.columns = {x: own[x] for x in own if x in self.observes}
        self.triangle = Triangle(letters, off_diagonal)
        self.is_reduced = factor_order == "conditioned_first" and scheme == "square_root"

    def initial_geometry(self, points: Points, distances: Tensor, generator: torch.Generator) -> Raw:
        """Start with spheres, directions uniform on the unit sphere of scale 1, and a time scale of sqrt(T / 10)."""
        N = len(distances)
        log_diagonal = torch.zeros(N, sum(map(len, self.rows.values())))
        log_diagonal[:, self.rows["p"]] = distances.log()[:, None]
        log_diagonal[:, self.rows["t"]] = 0.5 * math.log(1 / 10)
        raw = {"log_diagonal": log_diagonal}
        raw |= {kind: torch.zeros(N, len(self.triangle.places[kind])) for kind in self.triangle.kinds}
        if "direction" in self.observes:
            raw["directions"] = F.normalize(torch.randn(N, 3, generator=generator), dim=-1)
        if "time" in self.observes:
            raw["times"] = torch.rand(N, 1, generator=generator) * 1.2 - 0.1
        return raw

    def condition(self, raw: Raw, query: Query) -> Conditioned:
        """Slice at d = the unit vector from the camera to mu_p, and t (7DGS, algorithm 1)."""
        factor, offset = self.factors(raw), self.offset(raw, query)
        reduced = self._blocks(factor) if self.is_reduced else reduce(factor)
        # A Gaussian so far from the query that its opacity is zero is replaced by a unit Gaussian at the query, and its
        # opacity factor is zero. Otherwise its huge numbers would reach a gradient as 0 x inf.
        with torch.no_grad():
            seen = self._exponent(reduced.T_qq, offset, whiten(reduced.T_qq, offset)) < EXPONENT_MAX
        delta = torch.where(seen[:, None], offset, 0.0)
        T_qq = torch.where(seen[:, None, None], reduced.T_qq, torch.eye(delta.shape[1]).to(delta))
        white = whiten(T_qq, delta)
        opacity_factor = torch.where(seen, torch.exp(-self._exponent(T_qq, delta, white)), 0.0)
        if self.scheme == "square_root":
            means, factors = raw["means"] + (reduced.T_pq * white[:, None]).sum(-1), reduced.T_pp
        else:
            mean = F.pad(raw["means"], (0, offset.shape[1]))  # q is measured from mu_q
            means, factors, _ = slice_gaussians(mean, factor, offset, scheme=self.scheme)
        return Conditioned(means, factors, opacity_factor)

    def static(self, raw: Raw) -> Conditioned:
        """Return Gaussians of the block L_pp alone."""
        space = self.rows["p"]
        factors = Triangle("ppp", self.triangle.form).factor(raw["log_diagonal"][:, space], raw)
        return Conditioned(raw["means"], factors, torch.ones_like(raw["opacities"]))

    def slice_geometry(self, raw: Raw, query: Query) -> Geometry:
        """Slice by the kernel where there is one: in the square-root scheme, and on the CPU also for `cholesky`."""
        has_kernel = self.scheme == "square_root" or (self.scheme == "cholesky" and raw["means"].device.type == "cpu")
        if not has_kernel or not self.backend.serves(raw["means"]):
            return super().slice_geometry(raw, query)
        geometry = slice_triangular(
            raw["means"],
            raw["directions"] if "direction" in self.observes else None,
            raw["times"] if "time" in self.observes else None,
            raw["log_diagonal"],
            raw["shape"],
            raw["motion"],
            raw["coupling"] if "coupling" in raw else raw["motion"].detach()[:, :0],
            raw["opacities"],
            query.center,
            query.time,
            self.log_lambda["direction"] if "direction" in self.observes else None,
            self.log_lambda["time"] if "time" in self.observes else None,
            conditioned_first=self.factor_order == "conditioned_first",
            form=OFF_DIAGONALS.index(self.triangle.form),
            directional_half=self.directional_half,
            subtracts=self.scheme == "cholesky",
            conditioned=self.conditioned,
        )
        return Geometry(*geometry)

    def scales(self) -> Tensor:
        """Return the largest standard deviation of the slice, which is the same at every t and d."""
        T_pp = reduce(self.factors(dict(self.splats.items())).detach()).T_pp
        return torch.linalg.matrix_norm(T_pp, ord=2)

    def log_sizes(self, index: int) -> Tensor:
        """Return the log diagonal of the factor."""
        return self.splats["log_diagonal"].detach()[index]

    def log_duration(self, index: int) -> float | None:
        """Return the log diagonal at t, for a model that has time."""
        return float(self.log_sizes(index)[self.rows["t"][0]]) if "time" in self.observes else None

    def durations(self) -> Tensor | None:
        """Return sqrt(S_t), the norm of the factor's row of t."""
        return self.factors(dict(self.splats.items())).detach()[:, -1].norm(dim=-1) if "time" in self.observes else None

    def hold_sizes(self, least: Tensor) -> None:
        """Raise the diagonal of L_pp."""
        space = self.rows["p"]
        self.splats["log_diagonal"].data[:, space[0] : space[-1] + 1].clamp_(min=least.log()[:, None])

    def split(self, raw: Raw, generator: torch.Generator) -> Raw:
        """Sample children along the parent's path if the parent is long in time, else from its 3D Gaussian.

        In the reduced factor [T_qq 0; K T_qq T_pp] a child's shape is T_pp / 1.6 (space), or T_qq with its last row,
        that of t, divided by 1.6 (time). K does not change: a child moves as its parent did.
        """
        factor = self.factors(raw)
        T_qq, T_pq, T_pp = reduce(factor)
        gain = gain_of(T_pq, T_qq)
        in_time = self.moves_long(factor)[:, None]
        z = torch.randn(raw["means"].shape, generator=generator).to(factor)
        children = {"means": raw["means"] + torch.where(in_time, 0, (T_pp @ z[..., None])[..., 0])}
        T_pp = torch.where(in_time[..., None], T_pp, T_pp / SHRINK)
        if "time" in self.observes:
            # A child is z standard deviations along t from its parent, at most z clips. At any (t, d) it is where its
            # parent was, since K (q - mu_q) loses K_t dt and mu_p gains it.
            sigma = factor[:, -1].norm(dim=-1, keepdim=True).clamp(max=1)
            dt = torch.where(in_time, z[:, :1] * sigma, 0)
            children["means"] = children["means"] + gain[..., -1] * dt
            children["times"] = raw["times"] + dt
            T_qq = torch.cat([T_qq[:, :-1], torch.where(in_time[..., None], T_qq[:, -1:] / SHRINK, T_qq[:, -1:])], 1)
        p_rows = torch.cat([gain @ T_qq, T_pp], -1)
        q_rows = torch.cat([T_qq, T_pp.new_zeros(len(T_qq), T_qq.shape[1], 3)], -1)
        factor = torch.cat([p_rows, q_rows], 1)[:, self.own_order()]
        return children | self.triangle.parameters(factor)

    def kept(self, effect_sets: EffectSets) -> dict[str, Tensor]:
        """Tell which entries matter: none of a frozen variable, and none of t and d in a static row."""
        masks = super().kept(effect_sets)
        if effect_sets.frozen is None:
            return masks
        static = torch.arange(len(effect_sets.frozen), device=effect_sets.frozen.device) >= effect_sets.conditioned
        gone = {"p": torch.zeros_like(static), "t": static | (effect_sets.frozen & TIME > 0),
                "d": static | (effect_sets.frozen & DIRECTION > 0)}  # fmt: skip
        masks["log_diagonal"] = ~torch.stack([gone[x] for x in self.triangle.letters], -1)
        for kind in self.triangle.kinds[1:]:  # all but shape
            pairs = [self.triangle.pair(place) for place in self.triangle.places[kind]]
            masks[kind] = ~torch.stack([gone[a] | gone[b] for a, b in pairs], -1)
        if "direction" in self.observes:
            masks["directions"] = ~gone["d"][:, None]
        if "time" in self.observes:
            masks["times"] = ~gone["t"][:, None]
        return masks

    def constant(self, name: str) -> float:
        """Return constants of a frozen variable: the largest size, and no motion."""
        return LOG_SIZE_MAX if name == "log_diagonal" else 0.0

    def shaped_as(self, trained: TrainedGaussians, raw: Raw) -> Raw:
        """Return the initial factor with the block of position replaced by the trained one."""
        space = torch.tensor(self.rows["p"])
        double = {name: value.double() for name, value in raw.items()}
        factor = self.triangle.factor(double["log_diagonal"], double)  # diagonal: the model starts without coupling
        # The thinnest side of a flat Gaussian becomes a difference of numbers as large as its widest side.
        log_scales = trained.log_scales.double()
        log_scales = log_scales.clamp(min=log_scales.amax(1, keepdim=True) + math.log(FLATTEST))
        factor[:, space[:, None], space] = rotation(trained.quats.double()) * sizes(log_scales)[:, None, :]
        return self.triangle.parameters(factor)

    @torch.no_grad()
    def frozen(self, raw: Raw, queries: Sequence[Query], weights: Tensor) -> dict[str, Raw]:
        """Freeze t, d and both, if they are observed, at their weighted means over queries.

        The slice of (T_qq, K, T_pp) is mu_p + K (q - mu_q) with the factor T_pp. Freezing a variable zeroes its column
        of K; the mean keeps what the column did to it on average, and the opacity what f_temp or f_dir did. Its
        standard deviation becomes exp(LOG_SIZE_MAX), so that no query is far from its mean.
        """
        blocks = Reduced(*(block.double() for block in reduce(self.factors(raw))))
        gain = gain_of(blocks.T_pq, blocks.T_qq)
        by_name = {name: [name] for name in self.columns} if len(self.columns) > 1 else {}
        by_name["static"] = list(self.columns)
        shift = torch.zeros_like(gain[:, 0])
        opacity_factors = {name: torch.zeros_like(gain[:, 0, 0]) for name in by_name}
        for query, weight in zip(queries, weights.double(), strict=True):
            delta = self.offset(raw, query).double()
            shift += weight[:, None] * delta
            exponents = self.exponents(blocks.T_qq, delta, whiten(blocks.T_qq, delta))
            for name, variables in by_name.items():
                opacity_factors[name] += weight * torch.exp(-torch.stack([exponents[x] for x in variables]).sum(0))
        changed = {}
        for name, variables in by_name.items():
            columns = [column for x in variables for column in self.columns[x]]
            moved = raw["means"] + (gain[..., columns] @ shift[:, columns, None])[..., 0]
            opacity = torch.sigmoid(raw["opacities"].double()) * opacity_factors[name]
            new = self.triangle.parameters(self._without(blocks, gain, variables)) | {"means": moved}
            new["opacities"] = torch.logit(opacity.clamp(OPACITY_MARGIN, 1 - OPACITY_MARGIN))
            new |= {center: torch.zeros_like(raw[center]) for x in variables for center in [CENTERS[x]]}
            changed[name] = {key: value.to(raw["means"].dtype) for key, value in new.items()}
        return changed

    def _without(self, blocks: Reduced, gain: Tensor, variables: list[str]) -> Tensor:
        """Compute the factor [N, n, n] in the model's own order whose slices depend on no frozen variable."""
        T_qq, kept = blocks.T_qq.clone(), gain.clone()
        if "direction" in variables and "time" in self.observes:
            # t is no longer measured by d: its own deviation becomes its whole one
            deviation = T_qq[:, -1].norm(dim=-1)
            T_qq[:, -1] = 0
            T_qq[:, -1, -1] = deviation
        for column in [column for x in variables for column in self.columns[x]]:
            T_qq[:, column] = 0
            T_qq[:, column, column] = math.exp(LOG_SIZE_MAX)
            kept[..., column] = 0
        p_rows = torch.cat([kept @ T_qq, blocks.T_pp], -1)
        q_rows = torch.cat([T_qq, T_qq.new_zeros(*T_qq.shape[:2], 3)], -1)
        return torch.cat([p_rows, q_rows], 1)[:, self.own_order()]

    def factors(self, raw: Raw) -> Tensor:
        """Compute the triangular factor with its rows sorted to (p, d, t), [N, n, n]."""
        L = self.triangle.factor(raw["log_diagonal"], raw)
        return L[:, self.rows["p"] + self.rows["d"] + self.rows["t"]]

    def offset(self, raw: Raw, query: Query) -> Tensor:
        """Compute q - mu_q, [N, k], ordered (d, t)."""
        parts = []
        if "direction" in self.observes:
            parts.append(unit(raw["means"] - query.center) - raw["directions"])
        if query.time is not None and "time" in self.observes:
            parts.append(query.time - raw["times"])
        return torch.cat(parts, -1)

    def exponents(self, T_qq: Tensor, delta: Tensor, white: Tensor) -> dict[str, Tensor]:
        """Compute lambda_d |white_d|^2 / 2 = -ln f_dir and lambda_t (t - mu_t)^2 / (2 S_t) = -ln f_temp, [N] each.

        The keys are the names of the variables (7DGS eq. 11 and 12); delta = q - mu_q and white = T_qq^-1 delta.
        """
        found = {}
        if "direction" in self.observes:
            half = 0.5 if self.directional_half else 1.0
            found["direction"] = half * self.lambda_of("direction") * white[:, :3].square().sum(-1)
        if "time" in self.observes:
            distance = delta[:, -1] / T_qq[:, -1].norm(dim=-1)  # in standard deviations, sqrt(S_t)
            found["time"] = 0.5 * self.lambda_of("time") * distance.square()
        return found

    def _exponent(self, T_qq: Tensor, delta: Tensor, white: Tensor) -> Tensor:
        """Compute -ln(f_dir f_temp), [N]."""
        return torch.stack(list(self.exponents(T_qq, delta, white).values())).sum(0)

    def _blocks(self, factor: Tensor) -> Reduced:
        """Split a factor of `conditioned_first` into its blocks; it is already reduced, with the columns of q first."""
        k = factor.shape[-1] - 3
        return Reduced(factor[:, 3:, :k], factor[:, :3, :k], factor[:, :3, k:])

    def own_order(self) -> list[int]:
        """Return the place in (p, d, t) of each row of the triangular factor."""
        sorted_rows = self.rows["p"] + self.rows["d"] + self.rows["t"]
        return sorted(range(len(sorted_rows)), key=sorted_rows.__getitem__)

    def moves_long(self, factor: Tensor) -> Tensor:
        """Tell whether Gaussians move with time and are long in it, [N, n, n] -> [N] bool (7DGS, section 4.4)."""
        if "time" not in self.observes or not self.split_in_time:
            return torch.zeros(len(factor), dtype=torch.bool, device=factor.device)
        S_pt = (factor[:, :3] @ factor[:, -1:].mT)[..., 0]
        return (S_pt.norm(dim=-1) > TIME_CORRELATION * self.extent) & (factor[:, -1].norm(dim=-1) > TIME_SCALE)

    @torch.no_grad()
    def long_in_time(self) -> Tensor:
        """Tell whether |S_pt| > 0.05 extent and sqrt(S_t) > 0.25 T (7DGS, section 4.4)."""
        return self.moves_long(self.factors(dict(self.splats.items())))


class TimedModel(TriangularModel):
    """Gaussians conditioned on t, and maybe on d."""

    def __init__(self, *, lambda_t: float, **options: Any) -> None:
        """Make an empty model.

        Args:
            lambda_t: initial coefficient of f_temp.
            options: as `TriangularModel`.

        Raises:
            InputError: an option is out of its range.
        """
        super().__init__(**options)
        self.add_lambda("time", lambda_t)


class DirectionalModel(TriangularModel):
    """Gaussians conditioned on d, and maybe on t."""

    def __init__(self, *, lambda_d: float, directional_half: bool = True, **options: Any) -> None:
        """Make an empty model.

        Args:
            lambda_d: initial coefficient of f_dir.
            directional_half: whether f_dir has the 1/2 of 7DGS eq. 12, which 6DGS lacks.
            options: as `TriangularModel`.

        Raises:
            InputError: an option is out of its range.
        """
        super().__init__(**options)
        self.add_lambda("direction", lambda_d)
        self.directional_half = directional_half
