"""Define the base class of models in which single Gaussians can be made independent of time, direction or AGR.

AGR is the neural refinement of 7DGS. `gsbench.gates.gate` chooses these Gaussians. A model that supports this says so
in its own class statement, `class Model(GatedModel, gates=True)`.
"""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, TypeGuard

import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.models.appearance import MOST_PACKED, ColorOrder, coefficients_within
from gsbench.models.base import GaussianModel, Raw
from gsbench.models.camera_time import CameraTime
from gsbench.models.effect_sets import EffectSets
from gsbench.models.gaussian_batch import Conditioned, Geometry, joined_exponents
from gsbench.models.portable_math import sqrt
from gsbench.models.slicing import reduce

OPACITY_MARGIN = 1e-6  # least distance of a frozen Gaussian's opacity from 0 and 1, whose logits are infinite
_STATE = "effect_sets."  # prefix of the names of these tensors in a checkpoint


class GatedModel(GaussianModel):
    """The base class of models in which single Gaussians can be made independent of time, direction or AGR.

    AGR is the neural refinement of 7DGS. `effect_sets` stores what each Gaussian still depends on.
    """

    gates: ClassVar[bool] = False  # whether gates may simplify the model

    def __init_subclass__(cls, *, gates: bool = False, **more: Any) -> None:
        """Set `gates`, which is not inherited: a subclass may have parameters that the methods below do not handle."""
        super().__init_subclass__(**more)
        cls.gates = gates

    # ---- what a subclass provides

    @abstractmethod
    def static(self, raw: Raw) -> Conditioned:
        """Return the 3D Gaussians of Gaussians that do not depend on time or direction; opacity factors are 1.

        They are the limit of `condition` for standard deviations of time and direction that go to infinity, and means
        that do not move.
        """

    @abstractmethod
    def frozen(self, raw: Raw, queries: Sequence[CameraTime], weights: Tensor) -> dict[str, Raw]:
        """Return raw parameters of Gaussians that no longer depend on time, on direction, or on both.

        Means and opacities become their weighted averages over V views; these are not those of an average time. The
        keys of the result are "time" and "direction", where the model can lose this variable alone, and always
        "static", which has lost both. Values are the raw parameters that change. The result is empty if the model
        depends on neither. `raw` is without AGR; `weights` are [V, N], with a sum of 1 for each Gaussian.
        """

    def lower_orders(self) -> list[int]:
        """List the lower SH degrees to which colours can be reduced, as degree + 4 (frequencies in time - 1)."""
        return [ColorOrder(degree, 1).packed for degree in range(self.active.sh_degree)]

    def used_entries(self, effect_sets: EffectSets) -> dict[str, Tensor]:
        """Return masks of the parameter entries that affect an image: a static Gaussian uses no parameters of motion.

        Masks can be broadcast to the parameters; without a mask, all entries are used. `fill` sets the others to
        constants, so that they need not be stored.
        """
        if effect_sets.orders is None:
            return {}
        return {"shN": coefficients_within(effect_sets.orders, self.sh_degree).flatten(1)[:, 1:, None]}

    def constant(self, name: str) -> float:
        """Return the constant to which `fill` sets the unused entries of a parameter, which change no image."""
        return 0.0

    @torch.no_grad()
    def fill(self, effect_sets: EffectSets) -> None:
        """Set parameter entries that change no image, such as the motion of static Gaussians, to constants."""
        for name, mask in self.used_entries(effect_sets).items():
            self.splats[name].data.masked_fill_(~mask, self.constant(name))

    # ---- what every such model does

    @property
    def conditioned(self) -> int | None:
        """The number of Gaussians, from the first row on, that change with time or direction; None: all of them."""
        return None if self.effect_sets is None or not self.observes else self.effect_sets.conditioned

    def kernel_arguments(self, raw: Raw, query: CameraTime) -> dict[str, Any]:
        return super().kernel_arguments(raw, query) | {"conditioned": self.conditioned}

    def slice_geometry(self, raw: Raw, query: CameraTime) -> Geometry:
        """Compute the 3D Gaussians for a camera and time; Gaussians that ignore both are copied, not conditioned."""
        if self.conditioned is None or self.uses_kernel(raw):
            return super().slice_geometry(raw, query)
        changing = {name: x[: self.conditioned] for name, x in raw.items()}
        others = {name: x[self.conditioned :] for name, x in raw.items()}
        first, rest = self.condition(changing, query), self.static(others)
        opacities = torch.sigmoid(raw["opacities"]) * torch.cat([first.opacity_factor, rest.opacity_factor])
        means, factors = torch.cat([first.means, rest.means]), torch.cat([first.factors, rest.factors])
        return Geometry(means, factors, opacities, joined_exponents(first.beta_exponents, rest.beta_exponents))

    def pack(self) -> dict[str, Tensor]:
        """Return the tensors for a checkpoint, without unused entries such as the motion of static Gaussians."""
        state, effect_sets = super().pack(), self.effect_sets
        if effect_sets is None:
            return state
        assert effect_sets.orders is not None  # a gate has set them
        for name, mask in self.used_entries(effect_sets).items():
            value = state[f"splats.{name}"]
            state[f"splats.{name}"] = value[mask.expand_as(value)]
        counts = torch.tensor([effect_sets.refined, effect_sets.conditioned])
        intervals = {} if effect_sets.intervals is None else {f"{_STATE}intervals": effect_sets.intervals}
        return state | intervals | {f"{_STATE}counts": counts, f"{_STATE}orders": effect_sets.orders.to(torch.uint8)}

    def load_state(self, state: dict[str, Any]) -> None:
        """Load the tensors that `pack` returned, for any number of Gaussians; see `GaussianModel.load_state`."""
        effect_sets = effect_sets_in(state)
        super().load_state(state if effect_sets is None else self._unpacked(state, effect_sets))
        self.effect_sets = effect_sets

    def _unpacked(self, state: dict[str, Any], effect_sets: EffectSets) -> dict[str, Any]:
        """Restore full parameter tensors from a checkpoint, which stores only the entries that change an image."""
        assert effect_sets.orders is not None  # a checkpoint always has them
        unpacked = {key: value for key, value in state.items() if not key.startswith(_STATE)}
        for name, mask in self.used_entries(effect_sets).items():
            key, shape = f"splats.{name}", (len(effect_sets.orders), *self.splats[name].shape[1:])
            packed, used = state.get(key), mask.expand(shape)
            if not isinstance(packed, Tensor) or tuple(packed.shape) != (int(used.sum()),):
                raise InputError(
                    f"checkpoint: expected {key} as the {int(used.sum())} entries that matter to its effect sets"
                )
            unpacked[key] = packed.new_full(shape, self.constant(name))
            unpacked[key][used] = packed
        return unpacked


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

    def lifetimes(self) -> tuple[Tensor, Tensor] | None:
        """Return mean times [N] and lifetimes [N], which are standard deviations in time divided by sqrt(lambda_t)."""
        if "time" not in self.observes:
            return None
        deviations = self.factors(dict(self.splats.items())).detach()[:, -1].norm(dim=-1)
        return self.splats["times"][:, 0], deviations / sqrt(self.lambda_of("time"))


def has_gates(model: GaussianModel) -> TypeGuard[GatedModel]:
    """Return whether single Gaussians of the model can be made independent of time or direction."""
    return isinstance(model, GatedModel) and model.gates


def as_gated(model: GaussianModel) -> GatedModel:
    """Return the model if its single Gaussians can be made independent of time or direction; else raise InputError."""
    name = type(model).__name__
    if model.decodes:
        problem = f"{name} decodes what is blended, so that its image is no sum over Gaussians: name another"
    elif has_gates(model):
        return model
    elif isinstance(model, GatedModel):
        problem = (
            f"{name} inherits its methods for gates: see that they know all of its parameters, and write class "
            f"{name}(.., gates=True)"
        )
    else:
        problem = f"{name} is no GatedModel: make it one"
    raise InputError(
        f"effects.gate: expected a model that gates can simplify, {problem}, or use effects.gate=off",
        docs="adding_a_model.md",
    )


def effect_sets_in(state: dict[str, Any]) -> EffectSets | None:
    """Read from a checkpoint which Gaussians depend on time, direction and AGR (a network); None if not stored."""
    unread = {key: value for key, value in state.items() if isinstance(key, str) and key.startswith(_STATE)}
    if not unread:
        return None
    opacities = state.get("splats.opacities")
    N = len(opacities) if isinstance(opacities, Tensor) and opacities.dim() == 1 else 0

    def part(name: str, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
        value = unread.pop(f"{_STATE}{name}", None)
        if not isinstance(value, Tensor) or tuple(value.shape) != shape or value.dtype != dtype:
            raise InputError(f"checkpoint: expected {_STATE}{name} as {dtype} of shape {list(shape)}")
        return value

    refined, conditioned = part("counts", (2,), torch.int64).tolist()
    orders = part("orders", (N,), torch.uint8).to(torch.int32)
    intervals = part("intervals", (refined, 2), torch.float32) if f"{_STATE}intervals" in unread else None
    if unread or not bool((orders <= MOST_PACKED).all()) or not 0 <= refined <= conditioned <= N:
        raise InputError(
            f"checkpoint: expected effect sets of {N} rows, got {refined}, {conditioned} and orders that there are not"
        )
    return EffectSets(refined, conditioned, orders, intervals)
