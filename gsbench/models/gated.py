"""Define what a model needs so that gates can simplify its Gaussians: frozen effects, fewer harmonics.

A model that gates shall not touch derives from `GaussianModel` instead, and does without all of this.
"""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.models.base import Conditioned, GaussianModel, Raw
from gsbench.models.color_order import MOST_PACKED, ColorOrder, coefficients_within
from gsbench.models.effect_sets import DIRECTION, TIME, Classes
from gsbench.models.query import Query

OPACITY_MARGIN = 1e-6  # between a frozen Gaussian's opacity and 0 or 1, whose logits are infinite
_STATE = "classes."  # in front of a name in a checkpoint


class GatedModel(GaussianModel):
    """N Gaussians of which each may pay for a part of the effects: `classes` says which rows pay for what."""

    # ---- what a subclass provides

    @abstractmethod
    def still(self, raw: Raw) -> Conditioned:
        """Return Gaussians that no query changes, with a gate of one.

        They are what `condition` tends to where Gaussians grow long in all that is observed, and move with none of it.
        """

    @abstractmethod
    def frozen(self, raw: Raw, queries: Sequence[Query], weights: Tensor) -> dict[str, Raw]:
        """Freeze effects at their weighted mean over queries; return the raw parameters that each changes.

        The last, `still`, changes with no query. A model whose slice never changes has nothing to freeze.

        Args:
            raw: parameters without AGR.
            queries: V of them.
            weights: [V, N], of which each Gaussian's sum to 1.
        """

    def lower_levels(self) -> list[int]:
        """List the orders of colour below the one in use, packed."""
        return [ColorOrder(degree, 1).packed for degree in range(self.active.sh_degree)]

    def kept(self, classes: Classes) -> dict[str, Tensor]:
        """Tell which entries of the parameters matter to rows of these classes; those not named matter all.

        The masks are bool, broadcastable to the parameters. Entries that do not matter have the constants of `fill`.
        """
        if classes.levels is None:
            return {}
        return {"shN": coefficients_within(classes.levels, self.sh_degree).flatten(1)[:, 1:, None]}

    def constant(self, name: str) -> float:
        """Return what the entries of a parameter are that do not matter."""
        return 0.0

    @torch.no_grad()
    def fill(self, classes: Classes) -> None:
        """Set the entries that do not matter to rows of these classes to constants."""
        for name, mask in self.kept(classes).items():
            self.splats[name].data.masked_fill_(~mask, self.constant(name))

    # ---- what every such model does

    @property
    def sliced(self) -> int | None:
        """How many of the first rows change with the query; None: all that a slice is made of."""
        return None if self.classes is None or not self.observes else self.classes.sliced

    def observe(self, raw: Raw, query: Query) -> tuple[Tensor, Tensor, Tensor]:
        """Slice the rows that change with the query, and leave the others as they are."""
        if self.sliced is None:
            return super().observe(raw, query)
        changing = {name: x[: self.sliced] for name, x in raw.items()}
        others = {name: x[self.sliced :] for name, x in raw.items()}
        parts = zip(self.condition(changing, query), self.still(others), strict=True)
        means, factors, gate = map(torch.cat, parts)
        return means, factors, torch.sigmoid(raw["opacities"]) * gate

    def pack(self) -> dict[str, Tensor]:
        """Return the state for a checkpoint: of rows with classes only the entries that matter, as [entries]."""
        state, classes = super().pack(), self.classes
        if classes is None:
            return state
        assert classes.levels is not None
        assert classes.frozen is not None
        for name, mask in self.kept(classes).items():
            value = state[f"splats.{name}"]
            state[f"splats.{name}"] = value[mask.expand_as(value)]
        counts = torch.tensor([classes.refined, classes.sliced])
        spans = {} if classes.spans is None else {f"{_STATE}spans": classes.spans}
        return state | spans | {f"{_STATE}counts": counts, f"{_STATE}levels": classes.levels.to(torch.uint8),
                                f"{_STATE}frozen": classes.frozen}  # fmt: skip

    def load_state(self, state: dict[str, Any]) -> None:
        """Load what `pack` returned, of any number of Gaussians.

        Raises:
            InputError: the state is that of another model, or the classes are none of this one.
        """
        classes = classes_in(state)
        super().load_state(state if classes is None else self._unpacked(state, classes))
        self.classes = classes
        if classes is not None:
            self.fill(classes)

    def _unpacked(self, state: dict[str, Any], classes: Classes) -> dict[str, Any]:
        """Return the whole state that `pack` made smaller."""
        assert classes.levels is not None
        whole = {key: value for key, value in state.items() if not key.startswith(_STATE)}
        for name, mask in self.kept(classes).items():
            packed, key = state.get(f"splats.{name}"), f"splats.{name}"
            shape = (len(classes.levels), *self.splats[name].shape[1:])
            there = mask.expand(shape)
            if not isinstance(packed, Tensor) or tuple(packed.shape) != (int(there.sum()),):
                raise InputError(f"checkpoint: expected {key} as the {int(there.sum())} entries that matter to its "
                                 f"classes")  # fmt: skip
            value = packed.new_full(shape, self.constant(name))
            value[there] = packed
            whole[key] = value
        return whole


def as_gated(model: GaussianModel) -> GatedModel:
    """Return the model as one that gates can simplify; raises InputError where it is none."""
    if not isinstance(model, GatedModel):
        raise InputError(f"effects.gate: expected a model that gates can simplify, {type(model).__name__} is no "
                         f"GatedModel: make it one (docs/adding_a_model.md), or use effects.gate=off")  # fmt: skip
    return model


def classes_in(state: dict[str, Any]) -> Classes | None:
    """Return the classes of the rows in a checkpoint's state; None where it has none.

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

    refined, sliced = part("counts", (2,), torch.int64).tolist()
    levels, frozen = part("levels", (N,), torch.uint8).to(torch.int32), part("frozen", (N,), torch.uint8)
    spans = part("spans", (refined, 2), torch.float32) if f"{_STATE}spans" in own else None
    known = bool((levels <= MOST_PACKED).all()) and bool((frozen <= TIME + DIRECTION).all())
    if own or not known or not 0 <= refined <= sliced <= N:
        raise InputError(f"checkpoint: expected classes of {N} rows, got {refined}, {sliced} and levels or frozen "
                         f"effects that there are not")  # fmt: skip
    return Classes(refined, sliced, levels, frozen, spans)
