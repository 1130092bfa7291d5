"""Define the base class of models: their parameters, the 3D Gaussians at a camera and time, and density control.

`gsbench.models.gated` adds optional methods that make single Gaussians independent of time, direction or AGR (the
neural refinement).
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from gsbench.errors import InputError
from gsbench.kernels.backends import AUTO, Backend
from gsbench.kernels.colors import show_colors
from gsbench.kernels.headers import ALPHA_MIN
from gsbench.kernels.operation import Operation
from gsbench.kernels.tensors import check_positive, check_whole
from gsbench.models.appearance import ColorOrder, sh_colors
from gsbench.models.camera_time import CameraTime, together, unit
from gsbench.models.effect_sets import NAMES, EffectSets
from gsbench.models.gaussian_batch import Conditioned, Gaussians3D, Geometry, stacked
from gsbench.models.portable_math import exp, log, sqrt
from gsbench.models.refinement import OCTAVES, Changes, DeepRefinement, Refinement
from gsbench.scenes.gaussian_ply import TrainedGaussians
from gsbench.scenes.points import SH_C0, nearest_distances, size_of
from gsbench.scenes.scene import Camera, Points
from gsbench.schedule import ActiveComponents

Raw = dict[str, Tensor]  # raw parameters (before exp, sigmoid and normalisation) by name, N rows each
CHILDREN = 2  # a split replaces a Gaussian by two ..
SHRINK = 0.8 * CHILDREN  # .. that are 1.6 times smaller (3DGS, gaussian_model.py)


class GaussianModel(nn.Module, ABC):
    """The base class of models.

    A subclass defines its parameters, how they give 3D Gaussians for a camera and a time, and how Gaussians are split.
    """

    observes: ClassVar[tuple[str, ...]] = ()  # of "time", "direction"
    centers: ClassVar[tuple[str, ...]] = ("means",)  # the raw parameters that are means: AGR reads and changes them
    geometry: ClassVar[tuple[str, ...]]  # the raw parameters of the covariance: AGR changes them
    lengths: ClassVar[tuple[str, ...]] = ("means",)  # the raw parameters of both kinds that are in world units
    initial_opacity: ClassVar[float] = 0.1
    kernel: Operation | None = None  # the kernel that computes slices as `condition` does; None: torch does
    warm_up: float = 0.0  # share of a training in which `active.warms_up`; a model with a static first stage sets it
    shared: Sequence[Tensor] = ()  # in a training step: what `shared_by_views` has returned, without its `grad_fn`
    # Whether the methods that take a query can be given the centres [V, 3] and times [V] of several views, if kernels
    # compute slices and colours. A class that has its own kernel, or overrides one of these methods, says so itself.
    takes_views: bool = False

    def __init_subclass__(cls, **more: Any) -> None:
        """Reset what the methods of a subclass make untrue: `takes_views`, and the kernel of another `condition`."""
        super().__init_subclass__(**more)
        methods = ("slice", "refined", "slice_geometry", "kernel_arguments", "colored", "shade")
        if not vars(cls).keys().isdisjoint(("kernel", *methods)):
            cls.takes_views = vars(cls).get("takes_views", False)
        order = cls.__mro__
        condition, kernel = (next(base for base in order if name in vars(base)) for name in ("condition", "kernel"))
        if order.index(condition) < order.index(kernel):  # `condition` is of a later class, so torch slices
            cls.kernel = None

    def __init__(
        self,
        *,
        agr: bool = False,  # whether AGR, the adaptive Gaussian refinement of 7DGS, changes the Gaussians over time
        agr_octaves: int = OCTAVES,  # frequencies of AGR's time encoding
        agr_depth: int | None = None,  # of one deeper network in the place of AGR's; None: AGR as published
        agr_width: int | None = None,  # of that network's hidden layers; None: 64
        agr_mean_octaves: int | None = None,  # of its encoding of means; None: they are read as they are
        sh_degree: int = 3,  # of the colours, 0 to 3
        backend: Backend = AUTO,  # the implementation that computes conditional 3D Gaussians, colours and AGR
    ) -> None:
        """Make a model without Gaussians; `initialise`, `start_from` or `load_state` adds them."""
        super().__init__()
        if sh_degree not in range(4):
            raise InputError(f"sh_degree: expected 0, 1, 2 or 3, got {sh_degree}")
        self.splats = nn.ParameterDict()
        self.log_lambda = nn.ParameterDict()  # ln lambda_t, ln lambda_d of the models that have them
        self.refinement: Changes | None = None
        check_whole(agr_octaves, "agr_octaves", 0, 32)
        self.new_refinement: Callable[..., Changes] = Refinement
        if agr_depth is not None:
            if not agr:
                raise InputError("agr_depth: expected agr=true too, as it describes AGR's network")
            width, octaves = 64 if agr_width is None else agr_width, agr_mean_octaves or 0
            check_whole(agr_depth, "agr_depth", 1, 64)
            check_whole(width, "agr_width", 1, 4096)
            check_whole(octaves, "agr_mean_octaves", 0, 32)
            self.new_refinement = partial(DeepRefinement, width=width, depth=agr_depth, mean_octaves=octaves)
        elif (agr_width, agr_mean_octaves) != (None, None):
            raise InputError("agr_width, agr_mean_octaves: expected agr_depth too, as they describe its network")
        self.agr = agr
        self.agr_octaves = agr_octaves
        self.sh_degree = sh_degree
        self.backend = backend
        self.effect_sets: EffectSets | None = None  # None: every row has every effect; a GatedModel may have them
        self.extent = 1.0  # of the scene, world units
        self.active = ActiveComponents(sh_degree, refine=agr, tunes_lambda=False)

    # ---- what a subclass provides

    @abstractmethod
    def initial_geometry(
        self,
        points: Points,  # at which the Gaussians start
        distances: Tensor,  # [N] of each point to its neighbours, world units
        generator: torch.Generator,
    ) -> Raw:
        """Return the initial raw parameters of the covariances, and of the means in time and direction."""

    @abstractmethod
    def condition(self, raw: Raw, query: CameraTime) -> Conditioned:
        """Condition Gaussians with raw parameters (before exp and sigmoid) on a camera centre and time."""

    @abstractmethod
    def spatial_scales(self) -> Tensor:
        """Return the scales of each Gaussian in space, [N, 3] or [N, 1] for spheres, world units, with gradients."""

    @abstractmethod
    def split(self, raw: Raw, generator: torch.Generator) -> Raw:
        """Return means and covariance parameters of the children of split Gaussians: two adjacent rows each."""

    def clone(self, raw: Raw, generator: torch.Generator) -> Raw:
        """Return the raw parameters in which clones of Gaussians differ from these; by default none."""
        return {}

    def before_density(self, centers: Tensor, drawn: Tensor) -> None:
        """Change raw parameters before a round of density control; by default do nothing.

        Args:
            centers: of the cameras of the step's views, [V, 3].
            drawn: which Gaussians these views see, [V, N] bool.
        """

    def shared_by_views(self) -> list[Tensor]:
        """Return what slices read and no camera or time changes; a training step computes it once, as `shared`."""
        return []

    def penalty(self) -> Tensor | None:
        """Return a term of the loss that depends on the parameters alone, [], or None.

        A step adds its gradient once to the mean of those of the views.
        """
        return None

    def scales(self) -> Tensor:
        """Return the largest spatial standard deviation of each Gaussian, [N], world units, without a gradient."""
        return self.spatial_scales().detach().amax(-1)

    def shrink_rows(self, rows: Tensor, factors: Tensor) -> None:
        """Multiply the sizes of the conditional 3D Gaussians `rows` [M] by `factors` [M] <= 1; by default do nothing.

        Positions, velocities and lifetimes do not change. The relocation of 3DGS-MCMC calls this method.
        """

    def spread(self, rows: Tensor) -> Tensor:
        """Return factors F of the conditional covariances F F^T of the Gaussians `rows` [M], [M, 3, 3].

        By default they are those of spheres of size `scales`.
        """
        return torch.diag_embed(self.scales()[rows, None].expand(-1, 3))

    def lifetimes(self) -> tuple[Tensor, Tensor] | None:
        """Return the mean time mu_t [N] and the lifetime s [N] of each Gaussian; None without time.

        The opacity is proportional to exp(-1/2 ((t - mu_t) / s)^2).
        """
        return None

    @torch.no_grad()
    def visible_intervals(self) -> Tensor | None:
        """Return the first and the last time at which each Gaussian can be visible, [N, 2]; None without time.

        A Gaussian with opacity o, mean time mu_t and lifetime s is visible at time t if o exp(-((t - mu_t) / s)^2 / 2)
        is at least 1/255, unless `fading_times` says otherwise. Times are in [0, 1]; (inf, inf) marks a Gaussian that
        is never visible. The intervals only serve to sort the Gaussians: they ignore AGR, the neural refinement.
        """
        times_and_lifetimes = self.lifetimes()
        if times_and_lifetimes is None:
            return None
        times, lifetimes = times_and_lifetimes
        opacities = torch.sigmoid(self.splats["opacities"])
        half = self.fading_times(log(opacities / ALPHA_MIN).clamp(min=0), lifetimes)  # 0: too faint at all times
        interval = torch.stack([times - half, times + half], 1)
        never = (half == 0) | (interval[:, 1] < 0) | (interval[:, 0] > 1)
        return torch.where(never[:, None], math.inf, interval.clamp(0, 1))

    def fading_times(self, fading: Tensor, lifetimes: Tensor) -> Tensor:
        """Return how far from the mean time the opacity of each Gaussian falls to a share exp(-fading), [N].

        Args:
            fading: at least 0, [N].
            lifetimes: s as `lifetimes` returns it, [N].
        """
        return sqrt(2 * fading) * lifetimes

    def hold_sizes(self, least: Tensor) -> None:
        """Raise the spatial sizes of each Gaussian to at least `least` [N], world units; by default do nothing."""

    def hold_lifetimes(self, least: float) -> None:
        """Raise the lifetime s (see `lifetimes`) of each Gaussian to at least `least`; by default do nothing."""

    def shaped_as(self, trained: TrainedGaussians, raw: Raw) -> Raw:
        """Return covariance parameters for which the spatial covariance is that of trained 3D Gaussians.

        `raw` are the initial parameters. By default the Gaussians become spheres of the same volume.
        """
        points, radii = Points(trained.means, colors=trained.means), exp(trained.log_scales.mean(1))  # colours: unused
        spheres = self.initial_geometry(points, radii, torch.Generator().manual_seed(0))
        return {name: spheres[name] for name in self.geometry}  # not the random means

    def long_in_time(self) -> Tensor:
        """Return which Gaussians must be split because they are long in time, [N] bool (7DGS, section 4.4)."""
        return torch.zeros(len(self), dtype=torch.bool, device=self.splats["means"].device)

    def initial_colors(self, dc: Tensor) -> Raw:
        """Return SH coefficients of one colour for all directions and times; `dc` [N, 3] is that of degree 0."""
        rest = dc.new_zeros(len(dc), (self.sh_degree + 1) ** 2 - 1, 3)
        return {"sh0": dc[:, None], "shN": rest}

    def full_order(self) -> int:
        """Return the SH degree in use and the number of frequencies in time, as degree + 4 (frequencies - 1)."""
        return ColorOrder(self.active.sh_degree, 1).packed

    def shade(self, raw: Raw, means: Tensor, opacities: Tensor, query: CameraTime) -> Tensor:
        """Compute the SH colours [N, 3] of 3D Gaussians as seen from `query.center`, the camera's centre.

        `means` [N, 3] and `opacities` [N] are those of the slice, and `self.orders` has the SH degree of each Gaussian.
        The kernel leaves the colours of Gaussians 0 that are culled because of their opacity. A model with other
        colours overrides this method.
        """
        degree = self.active.sh_degree
        if self.backend.serves(means):
            return show_colors(
                raw["sh0"], raw["shN"], means, opacities, center=query.center, degree=degree, orders=self.orders
            )[0]
        return sh_colors(torch.cat([raw["sh0"], raw["shN"]], 1), unit(means - query.center), degree, self.orders)

    def decode(
        self,
        blended: Tensor,  # [C, H, W, D]
        camera: Camera,
    ) -> Tensor:
        """Turn what the rasterizer has blended of D numbers a Gaussian into images [C, H, W, 3]; here they are colours.

        A model whose `shade` returns features [N, D], of which the first three are blended over the background and the
        others over 0, overrides this method.
        """
        return blended

    @property
    def decodes(self) -> bool:
        """Whether `decode` stands between the rasterizer and the image."""
        return type(self).decode is not GaussianModel.decode

    # ---- what every model does

    def __len__(self) -> int:
        return len(self.splats["means"]) if "means" in self.splats else 0

    def raw_of(self, rows: Tensor) -> Raw:
        """Return the raw parameters of the Gaussians `rows` [M], without gradients."""
        return {name: value.detach()[rows] for name, value in self.splats.items()}

    @torch.no_grad()
    def initialise(self, points: Points, extent: float, generator: torch.Generator) -> None:
        """Place an isotropic Gaussian of opacity 0.1, or `initial_opacity`, at each point (3DGS, section 5.1).

        The standard deviation of a Gaussian is the root mean square distance to its three nearest neighbours. Density
        control and learning rates are relative to `extent`, the radius of the scene in world units.
        """
        self.extent = extent
        distances = nearest_distances(points.means)
        raw = {"means": points.means, **self.initial_geometry(points, distances, generator)}
        raw["opacities"] = torch.full((len(points.means),), math.log(self.initial_opacity / (1 - self.initial_opacity)))
        raw |= self.initial_colors((points.colors - 0.5) / SH_C0)
        self.splats = nn.ParameterDict({name: nn.Parameter(value.clone()) for name, value in raw.items()})
        if self.agr:
            # AGR has a network for each mean, and one for the covariance.
            widths = {name: raw[name].shape[-1] for name in (*self.centers, *self.geometry)}
            outputs = [*(widths[name] for name in self.centers), sum(widths[name] for name in self.geometry)]
            size = size_of(points)
            units = torch.cat([torch.full((n,), size if name in self.lengths else 1.0) for name, n in widths.items()])
            self.refinement = self.new_refinement(outputs, generator, octaves=self.agr_octaves, units=units)
        self.set_active(self.active)

    @torch.no_grad()
    def start_from(self, trained: TrainedGaussians, extent: float, generator: torch.Generator) -> None:
        """Initialise with the means, covariances, opacities and colours of at least four trained 3D Gaussians.

        Other parameters, such as mean times and directions, start as in `initialise`. SH coefficients above the model's
        degree are left out.
        """
        self.initialise(Points(trained.means, (0.5 + SH_C0 * trained.dc).clamp(0, 1)), extent, generator)
        raw = {name: parameter.data for name, parameter in self.splats.items()}
        raw["opacities"].copy_(trained.logits)
        raw["sh0"].view(-1, 3).copy_(trained.dc)
        terms = min(trained.rest.shape[1], (self.sh_degree + 1) ** 2 - 1)
        raw["shN"][:, :terms] = trained.rest[:, :terms]  # in 4DGS these are the coefficients that are constant in time
        for name, value in self.shaped_as(trained, raw).items():
            raw[name].copy_(value)

    def slice(self, query: CameraTime) -> Gaussians3D:
        """Slice the model at the camera centre and time of `query`: return 3D Gaussians for the rasterizer."""
        if query.time is None and ("time" in self.observes or self.agr):
            raise InputError(f"{type(self).__name__}: expected a time in [0, 1], got none: this model observes time")
        raw = self.refined(query)
        return self.colored(self.slice_geometry(raw, query), raw, query)

    def slices(self, queries: Sequence[CameraTime]) -> Gaussians3D:
        """Slice the model for V views: the tensors are [V, N, ..], or [N, ..] if equal for all views or V is 1.

        On a GPU, a kernel computes all views in one call if the model has one.
        """
        raw: Raw = dict(self.splats.items())
        if len(queries) > 1 and self.takes_views and self.uses_kernel(raw) and self.backend.takes_views(raw["means"]):
            return self.slice(together(queries))
        return stacked([self.slice(query) for query in queries])

    def colored(self, geometry: Geometry, raw: Raw, query: CameraTime) -> Gaussians3D:
        """Compute the colours of 3D Gaussians, and return them together with means, factors and opacities."""
        means, factors, opacities, beta_exponents = geometry
        return Gaussians3D(means, factors, opacities, self.shade(raw, means, opacities, query), beta_exponents)

    def slice_geometry(self, raw: Raw, query: CameraTime) -> Geometry:
        """Compute means, covariance factors and opacities of the 3D Gaussians for a camera and a time.

        The model's kernel does this in one call where it can; elsewhere `condition` does the same in torch.
        """
        if not self.uses_kernel(raw):
            means, factors, opacity_factor, beta_exponents = self.condition(raw, query)
            return Geometry(means, factors, torch.sigmoid(raw["opacities"]) * opacity_factor, beta_exponents)
        assert self.kernel is not None
        arguments, names = self.kernel_arguments(raw, query), (*self.kernel.inputs, *self.kernel.numbers)
        outputs = self.kernel(**{name: arguments[name] for name in names if name in arguments})
        sliced = dict(zip(self.kernel.outputs, outputs, strict=True))
        means = sliced.get("means", raw["means"])  # a static kernel returns none, because they do not move
        return Geometry(means, sliced["factors"], sliced["opacities"], beta_exponents=sliced.get("shapes"))

    def uses_kernel(self, raw: Raw) -> bool:
        """Return whether `kernel` computes the slice of these parameters, on their device and in their type."""
        return self.kernel is not None and self.backend.serves(raw["means"])

    def kernel_arguments(self, raw: Raw, query: CameraTime) -> dict[str, Any]:
        """Return what `kernel` may take, by the names of its inputs and numbers; it takes those that it declares."""
        lambdas = {f"log_lambda_{name[0]}": value for name, value in self.log_lambda.items()}
        return raw | lambdas | {"center": query.center, "time": query.time if "time" in self.observes else None}

    @property
    def orders(self) -> Tensor | None:
        """The SH degree and number of frequencies of each colour, [N], as in `ColorOrder.packed`; None: all."""
        return None if self.effect_sets is None else self.effect_sets.orders

    def count_by_effects(self) -> dict[str, int]:
        """Count Gaussians by what they depend on: AGR (a network), time or direction, nothing."""
        N, effect_sets = len(self), self.effect_sets
        if effect_sets is not None:
            return effect_sets.by_name(N)
        refined, conditioned = N if self.refines else 0, N if self.observes else 0
        counts = refined, max(conditioned - refined, 0), N - max(refined, conditioned)
        return dict(zip(NAMES, counts, strict=True))

    @property
    def refines(self) -> bool:
        """Whether the model has AGR, the neural refinement, and AGR is switched on."""
        return self.refinement is not None and self.active.refine

    def refined(self, query: CameraTime) -> Raw:
        """Return the raw parameters after AGR, the neural refinement, has added its output (7DGS eq. 15)."""
        raw: Raw = dict(self.splats.items())
        rows = None if self.effect_sets is None else self.effect_sets.refined
        if self.refinement is None or not self.active.refine or query.time is None or rows == 0:
            return raw
        names = (*self.centers, *self.geometry)
        by_kernel = self.backend.serves(raw["means"])
        intervals = None if self.effect_sets is None else self.effect_sets.intervals
        values = [raw[name] for name in names]
        moved = self.refinement(values, query.time, by_kernel=by_kernel, rows=rows, intervals=intervals)
        return raw | dict(zip(names, moved, strict=True))

    def add_lambda(self, name: str, value: float) -> None:
        """Add lambda_t or lambda_d (of `time` or `direction`), the coefficient in the exponent of an opacity factor."""
        check_positive(value, f"lambda_{name[0]}")
        self.log_lambda[name] = nn.Parameter(torch.tensor(math.log(value)))

    def lambda_of(self, name: str) -> Tensor:
        """Return lambda_t (for `time`) or lambda_d (for `direction`), a tensor []; the model stores its logarithm."""
        return exp(self.log_lambda[name])

    def set_active(self, active: ActiveComponents) -> None:
        """Set the SH degree, whether AGR (a network) is active, and whether lambda_t and lambda_d are trained."""
        self.active = active
        for parameter in self.log_lambda.parameters():
            parameter.requires_grad_(active.tunes_lambda)
        if self.refinement is not None:
            self.refinement.requires_grad_(active.refine)

    def groups(self) -> dict[str, list[nn.Parameter]]:
        """Return the parameters of the model by the name of their group, each with a learning rate in `model.lr`.

        A model with a network of its own adds a group: `super().groups() | {"field": list(self.field.parameters())}`.
        """
        groups = {name: [parameter] for name, parameter in self.splats.items()}
        if self.refinement is not None:
            groups["refinement"] = list(self.refinement.parameters())
        if len(self.log_lambda):
            groups["lambda"] = list(self.log_lambda.parameters())
        return groups

    # ---- density control: keep, copy and split rows

    @torch.no_grad()
    def select(self, rows: Tensor) -> None:
        """Keep the Gaussians with the indices `rows`, in this order; an index that occurs twice copies a Gaussian."""
        for parameter in self.splats.values():
            parameter.data = parameter.data[rows]
            parameter.grad = None

    @torch.no_grad()
    def split_rows(self, rows: Tensor, generator: torch.Generator) -> None:
        """Replace the copies `rows` [M] of split Gaussians by their children; two copies are next to each other."""
        for name, value in self.split(self.raw_of(rows), generator).items():
            self.splats[name].data[rows] = value

    @torch.no_grad()
    def clone_rows(self, rows: Tensor, generator: torch.Generator) -> None:
        """Change the copies `rows` [M] of cloned Gaussians where the model's clones differ from their originals."""
        for name, value in self.clone(self.raw_of(rows), generator).items():
            self.splats[name].data[rows] = value

    @torch.no_grad()
    def reset_opacities(self, ceiling: float) -> None:
        """Lower every opacity to at most `ceiling` (3DGS, section 5.2)."""
        self.splats["opacities"].data.clamp_(max=math.log(ceiling / (1 - ceiling)))

    # ---- what a checkpoint holds

    def pack(self) -> dict[str, Tensor]:
        """Return the tensors of the model for a checkpoint, by name."""
        state: dict[str, Tensor] = self.state_dict()
        return state

    def stored_bytes(self) -> int:
        """Return the number of bytes that the parameters need in a checkpoint."""
        constants = {name for name, _ in self.named_buffers()}
        return sum(x.numel() * x.element_size() for name, x in self.pack().items() if name not in constants)

    def load_state(self, state: dict[str, Any]) -> None:
        """Load what `pack` returned, of any number of Gaussians; raises InputError if it is of another model."""
        means = state.get("splats.means")
        N = len(means) if isinstance(means, Tensor) and means.dim() else 0
        present = self.state_dict()
        shapes = {name: list(value.shape) for name, value in present.items()}
        expected = {name: [N, *shape[1:]] if name.startswith("splats.") else shape for name, shape in shapes.items()}
        got = {name: list(value.shape) if isinstance(value, Tensor) else value for name, value in state.items()}
        for name in sorted(expected.keys() | got.keys()):
            if name not in expected or expected[name] != got.get(name):
                raise InputError(
                    f"checkpoint: not of this model: expected {name} of shape "
                    f"{expected.get(name, 'none')}, got {got.get(name, 'none')!s:.60}"
                )
            if state[name].dtype != present[name].dtype or state[name].layout != torch.strided:
                raise InputError(
                    f"checkpoint: not of this model: expected {name} of {present[name].dtype}, "
                    f"got {state[name].dtype}, {state[name].layout}"
                )
        for name, parameter in self.splats.items():
            parameter.data = torch.empty(state[f"splats.{name}"].shape, dtype=parameter.dtype, device=parameter.device)
        self.load_state_dict(state)
