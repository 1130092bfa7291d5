"""Sort the Gaussians of a model into classes, by the effects that each pays for, and store what matters to them.

A Gaussian of a class without an effect has entries among its parameters that change no image: the motion of one that is
still, the harmonics above its level. They are constant, learn nothing, and are not stored.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.models.color_order import MOST_PACKED

if TYPE_CHECKING:
    from gsbench.models.base import GaussianModel

TIME, DIRECTION = 1, 2  # in Classes.frozen
NAMES = ("refined", "sliced", "time", "direction", "still")  # of classes, by what AGR, slicing or freezing does to them
_STATE = "classes."


class Classes(NamedTuple):
    """Which rows of a model pay for which effect: rows are ordered refined (AGR) | sliced | still."""

    refined: int  # this many first rows are moved by AGR
    sliced: int  # this many first rows (refined <= sliced) change with the query; the others are still
    levels: Tensor | None  # [N] int32: the order of a row's colours, packed as by `ColorOrder`; None: the whole
    frozen: Tensor | None = None  # [N] uint8: TIME + DIRECTION, what a sliced row does not change with; None: nothing
    spans: Tensor | None = None  # [refined, 2] clips: AGR moves a row only from a first to a last time; None: always


def count(model: GaussianModel) -> dict[str, int]:
    """Count the Gaussians of each class, by the names of NAMES."""
    N, classes = len(model), model.classes
    if classes is None:
        refined, sliced = N if model.refines else 0, N if model.observes else 0
        return dict(
            zip(NAMES, (refined, sliced - refined if sliced else 0, 0, 0, N - max(refined, sliced)), strict=True)
        )
    frozen = [0, 0] if classes.frozen is None else [int((classes.frozen == bit).sum()) for bit in (TIME, DIRECTION)]
    sliced = classes.sliced - classes.refined - sum(frozen)
    return dict(zip(NAMES, (classes.refined, sliced, *frozen, N - classes.sliced), strict=True))


def pack(model: GaussianModel) -> dict[str, Tensor]:
    """Return the state of a model for a checkpoint: of rows with classes only the entries that matter, as [entries]."""
    state: dict[str, Tensor] = model.state_dict()
    classes = model.classes
    if classes is None:
        return state
    assert classes.levels is not None
    assert classes.frozen is not None
    for name, mask in model.kept(classes).items():
        value = state[f"splats.{name}"]
        state[f"splats.{name}"] = value[mask.expand_as(value)]
    counts = torch.tensor([classes.refined, classes.sliced])
    spans = {} if classes.spans is None else {f"{_STATE}spans": classes.spans}
    return state | spans | {f"{_STATE}counts": counts, f"{_STATE}levels": classes.levels.to(torch.uint8),
                            f"{_STATE}frozen": classes.frozen}  # fmt: skip


def unpack(model: GaussianModel, state: dict[str, Any]) -> tuple[dict[str, Any], Classes | None]:
    """Return the whole state that `pack` made smaller, and the classes of its rows.

    Raises:
        InputError: the classes or the entries are not those of this model; what else is wrong `load_state` says.
    """
    own = {key: value for key, value in state.items() if isinstance(key, str) and key.startswith(_STATE)}
    if not own:
        return state, None
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
    classes = Classes(refined, sliced, levels, frozen, spans)
    whole = {key: value for key, value in state.items() if not key.startswith(_STATE)}
    for name, mask in model.kept(classes).items():
        packed, key = state.get(f"splats.{name}"), f"splats.{name}"
        shape = (N, *model.splats[name].shape[1:])
        there = mask.expand(shape)
        if not isinstance(packed, Tensor) or tuple(packed.shape) != (int(there.sum()),):
            raise InputError(f"checkpoint: expected {key} as the {int(there.sum())} entries that matter to its classes")
        value = packed.new_full(shape, model.constant(name))
        value[there] = packed
        whole[key] = value
    return whole, classes


def packed_bytes(model: GaussianModel) -> int:
    """Return the bytes of the parameters that matter to their rows, as a checkpoint holds them."""
    parameters = dict(model.named_parameters())
    return sum(x.numel() * x.element_size() for key, x in pack(model).items()
               if key in parameters or key.startswith(_STATE))  # fmt: skip
