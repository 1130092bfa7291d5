"""Define the methods that a model needs for gates to simplify its Gaussians: frozen effects, fewer harmonics.

A model without gates derives from `GaussianModel` instead, and needs none of these methods.
"""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.models.base import Conditioned, GaussianModel, Geometry, Raw, joined_shapes
from gsbench.models.color_order import MOST_PACKED, ColorOrder, coefficients_within
from gsbench.models.effect_sets import DIRECTION, TIME, EffectSets
from gsbench.models.query import Query

OPACITY_MARGIN = 1e-6  # between a frozen Gaussian's opacity and 0 or 1, whose logits are infinite
_STATE = "effect_sets."  # in front of a name in a checkpoint


class GatedModel(GaussianModel):
    """N Gaussians, each of which may have only some effects; `effect_sets` says which."""

    # ---- what a subclass provides

    @abstractmethod
    def static(self, raw: Raw) -> Conditioned:
        """Return Gaussians that no query changes, with an opacity factor of one.

        They are the limit of `condition` for Gaussians that are long in all observed variables and move with none.
        """

    @abstractmethod
    def frozen(self, raw: Raw, queries: Sequence[Query], weights: Tensor) -> dict[str, Raw]:
        """Freeze effects at their weighted mean over queries; return the raw parameters that each changes.

        The last one, `static`, does not change with the query. A model whose slice never changes has nothing to freeze.

        Args:
            raw: parameters without AGR.
            queries: V of them.
            weights: [V, N]; those of each Gaussian sum to 1.
        """

    def lower_orders(self) -> list[int]:
        """List the packed orders of colour below the one in use."""
        return [ColorOrder(degree, 1).packed for degree in range(self.active.sh_degree)]

    def kept(self, effect_sets: EffectSets) -> dict[str, Tensor]:
        """Tell which entries of parameters matter to rows of these effect sets; parameters without a mask matter fully.

        The masks are bool, broadcastable to the parameters. Entries that do not matter have the constants of `fill`.
        """
        if effect_sets.orders is None:
            return {}
        return {"shN": coefficients_within(effect_sets.orders, self.sh_degree).flatten(1)[:, 1:, None]}

    def constant(self, name: str) -> float:
        """Return the constant of a parameter's entries that do not matter."""
        return 0.0

    @torch.no_grad()
    def fill(self, effect_sets: EffectSets) -> None:
        """Set the entries that do not matter to rows of these effect sets to constants."""
        for name, mask in self.kept(effect_sets).items():
            self.splats[name].data.masked_fill_(~mask, self.constant(name))

    # ---- what every such model does

    @property
    def conditioned(self) -> int | None:
        """Return how many of the first rows change with the query; None: all rows of the slice."""
        return None if self.effect_sets is None or not self.observes else self.effect_sets.conditioned

    def slice_geometry(self, raw: Raw, query: Query) -> Geometry:
        """Slice the rows that change with the query, and leave the others as they are."""
        if self.conditioned is None:
            return super().slice_geometry(raw, query)
        changing = {name: x[: self.conditioned] for name, x in raw.items()}
        others = {name: x[self.conditioned :] for name, x in raw.items()}
        first, rest = self.condition(changing, query), self.static(others)
        opacities = torch.sigmoid(raw["opacities"]) * torch.cat([first.opacity_factor, rest.opacity_factor])
        means, factors = torch.cat([first.means, rest.means]), torch.cat([first.factors, rest.factors])
        return Geometry(means, factors, opacities, joined_shapes(first.shapes, rest.shapes))

    def pack(self) -> dict[str, Tensor]:
        """Return the state for a checkpoint; with effect sets it has only the entries that matter, as [entries]."""
        state, effect_sets = super().pack(), self.effect_sets
        if effect_sets is None:
            return state
        assert effect_sets.orders is not None
        assert effect_sets.frozen is not None
        for name, mask in self.kept(effect_sets).items():
            value = state[f"splats.{name}"]
            state[f"splats.{name}"] = value[mask.expand_as(value)]
        counts = torch.tensor([effect_sets.refined, effect_sets.conditioned])
        intervals = {} if effect_sets.intervals is None else {f"{_STATE}intervals": effect_sets.intervals}
        return state | intervals | {f"{_STATE}counts": counts, f"{_STATE}orders": effect_sets.orders.to(torch.uint8),
                                f"{_STATE}frozen": effect_sets.frozen}  # fmt: skip

    def load_state(self, state: dict[str, Any]) -> None:
        """Load what `pack` returned, of any number of Gaussians.

        Raises:
            InputError: the state is of another model, or its effect sets do not fit this model.
        """
        effect_sets = effect_sets_in(state)
        super().load_state(state if effect_sets is None else self._unpacked(state, effect_sets))
        self.effect_sets = effect_sets
        if effect_sets is not None:
            self.fill(effect_sets)

    def _unpacked(self, state: dict[str, Any], effect_sets: EffectSets) -> dict[str, Any]:
        """Return the whole state from the entries that `pack` kept."""
        assert effect_sets.orders is not None
        whole = {key: value for key, value in state.items() if not key.startswith(_STATE)}
        for name, mask in self.kept(effect_sets).items():
            packed, key = state.get(f"splats.{name}"), f"splats.{name}"
            shape = (len(effect_sets.orders), *self.splats[name].shape[1:])
            there = mask.expand(shape)
            if not isinstance(packed, Tensor) or tuple(packed.shape) != (int(there.sum()),):
                raise InputError(f"checkpoint: expected {key} as the {int(there.sum())} entries that matter to its "
                                 f"effect sets")  # fmt: skip
            value = packed.new_full(shape, self.constant(name))
            value[there] = packed
            whole[key] = value
        return whole


def as_gated(model: GaussianModel) -> GatedModel:
    """Return the model as a `GatedModel`; raises InputError if gates cannot simplify it."""
    if not isinstance(model, GatedModel):
        raise InputError(f"effects.gate: expected a model that gates can simplify, {type(model).__name__} is no "
                         f"GatedModel: make it one (docs/adding_a_model.md), or use effects.gate=off")  # fmt: skip
    return model


def effect_sets_in(state: dict[str, Any]) -> EffectSets | None:
    """Return the effect sets of the rows in a checkpoint's state; None if it has none.

    Raises:
        InputError: they are damaged.
    """
    own = {key: value for key, value in state.items() if isinstance(key, str) and key.startswith(_STATE)}
    if not own:
        return None
    opacities = state.get("splats.opacities")
    N = len(opacities) if isinstance(opacities, Tensor) and opacities.dim() == 1 else 0

    def part(name: str, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
        value = own.pop(f"{_STATE}{name}", None)
        if not isinstance(value, Tensor) or tuple(value.shape) != shape or value.dtype != dtype:
            raise InputError(f"checkpoint: expected {_STATE}{name} as {dtype} of shape {list(shape)}")
        return value

    refined, conditioned = part("counts", (2,), torch.int64).tolist()
    orders, frozen = part("orders", (N,), torch.uint8).to(torch.int32), part("frozen", (N,), torch.uint8)
    intervals = part("intervals", (refined, 2), torch.float32) if f"{_STATE}intervals" in own else None
    known = bool((orders <= MOST_PACKED).all()) and bool((frozen <= TIME + DIRECTION).all())
    if own or not known or not 0 <= refined <= conditioned <= N:
        raise InputError(f"checkpoint: expected effect sets of {N} rows, got {refined}, {conditioned} and orders or "
                         f"frozen effects that there are not")  # fmt: skip
    return EffectSets(refined, conditioned, orders, frozen, intervals)
