"""Move Gaussians by AGR's perceptrons: hidden layers stay in cache, and backward computes them again."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.headers import HIDDEN, MAX_NETWORKS, MAX_VALUES
from gsbench.kernels.library import Slots, allocate, library_of
from gsbench.kernels.operation import EVERY_ROW, Operation, Tensors, address, first_rows, in_rows
from gsbench.tensors import check_tensor


class _Inputs(NamedTuple):
    """The inputs of the operation, which is given one list of tensors."""

    values: Tensors
    weight_in: Tensor
    bias_in: Tensor
    weights_out: Tensors
    biases_out: Tensors
    units: Tensor
    gamma: Tensor
    spans: Tensor | None
    time: Tensor | None

    @classmethod
    def of(cls, tensors: Tensors, networks: int) -> "_Inputs":
        """Take the list apart; spans and time are empty where they are left out."""
        *values, weight_in, bias_in = tensors[: -4 - 2 * networks]
        weights_out, biases_out = tensors[-4 - 2 * networks : -4 - networks], tensors[-4 - networks : -4]
        units, gamma, spans, time = tensors[-4:]
        left_out = spans.dim() < 2
        return cls(values, weight_in, bias_in, weights_out, biases_out, units, gamma,
                   None if left_out else spans, None if left_out else time)  # fmt: skip

    def layers(self) -> dict[str, Tensor]:
        """The weights as the kernels take them: gamma(t) is in the biases, and the units are in the weights."""
        read = self.weight_in.shape[1] - self.gamma.shape[0]
        weight_in = self.weight_in.detach()
        weights = {
            "weight_in": weight_in[:, :read] / self.units[:read],
            "bias_in": F.linear(self.gamma, weight_in[:, read:], self.bias_in.detach()),
            "weight_out": torch.cat(self.weights_out).detach() * self.units[:, None],
            "bias_out": torch.cat(self.biases_out).detach() * self.units,
        }
        return dict(zip(weights, in_rows(list(weights.values())), strict=True))

    def of_layers(self, g: dict[str, Tensor]) -> Tensors:
        """The gradients of the layers' own weights, from those of `layers`."""
        widths = [x.shape[0] for x in self.biases_out]
        read = g["weight_in"].shape[1]
        g_in = torch.cat([g["weight_in"] / self.units[:read], torch.outer(g["bias_in"], self.gamma)], 1)
        g_out, g_bias = g["weight_out"] * self.units[:, None], g["bias_out"] * self.units
        return [g_in, g["bias_in"], *g_out.split(widths), *g_bias.split(widths)]


class _Refine(Operation):
    """The one operation on a list of tensors, the fields of `_Inputs` in their order.

    What all Gaussians have in common is done here, on the weights: gamma(t) is part of the first layers' biases, and
    the units are part of their columns and of the last layers' rows.
    """

    def __init__(self) -> None:
        super().__init__("refine", inputs={}, outputs={}, numbers={"networks": int, "refined": int},
                         memory="refinements")  # fmt: skip

    def split(self, arguments: Sequence[Any]) -> tuple[Tensors, tuple[Any, ...]]:
        *tensors, networks, refined = arguments
        return list(tensors), (networks, refined)

    def differentiable(self, tensors: Tensors) -> list[bool]:
        return [True] * (len(tensors) - 4) + [False] * 4

    def carries_gradient(self, outputs: Tensors) -> list[bool]:
        return [True] * len(outputs)

    def run(self, tensors: Tensors, numbers: Sequence[Any]) -> tuple[Tensors, Slots]:
        slots = self._slots(tensors, numbers)
        values = slots["rows"]
        out = [allocate(self._memory, x, x.shape) for x in values]
        library_of(values[0].device.type).call("refine", slots | {"out.values": _addresses(out)}, values[0])
        return out, slots

    def prepare(self, tensors: Tensors, numbers: Sequence[Any], outputs: Tensors) -> Slots:
        return self._slots(tensors, numbers)

    def backward(
        self, tensors: Tensors, slots: Slots, outputs: Tensors, given: Sequence[Tensor | None],
        wanted: Sequence[bool], sums: dict[int, Tensor] | None = None,
    ) -> list[Tensor | None]:  # fmt: skip
        values, weights = slots["rows"], slots["layers"]
        like, networks = values[0], slots["networks"]
        library, features = library_of(like.device.type), networks - 1
        dense = [torch.zeros_like(x) if g is None else g.contiguous() for g, x in zip(given, values, strict=True)]
        moved = [allocate("gradients of AGR's features", x, x.shape) for x in values[:features]]
        g_weights = {key: torch.zeros_like(x) for key, x in weights.items()}
        scratch = None
        if library.needs_scratch:
            shape = networks, slots["refined"], slots["features"]
            scratch = allocate("gradients of AGR's features", like, shape)
        slots |= {"given.values": _addresses(dense), "grad.values": _addresses(moved), "grad.scratch": address(scratch)}
        slots |= {f"grad.{key}": g.data_ptr() for key, g in g_weights.items()}
        library.call("refine_backward", slots, like)
        own = _Inputs.of(tensors, networks).of_layers(g_weights)
        return [*moved, *dense[features:], *own, None, None, None, None]

    def _slots(self, tensors: Tensors, numbers: Sequence[Any]) -> Slots:
        """What the kernels take, and what must live as long: the arrays, the layers and the spans."""
        networks, refined = numbers
        given = _Inputs.of(tensors, networks)
        values, weights = in_rows(given.values), given.layers()
        widths = tuple(x.shape[1] for x in values)
        own, moved = widths[: networks - 1], first_rows("refine: rows", refined, values[0])
        spans = None if given.spans is None else given.spans.contiguous()
        slots: Slots = {"N": values[0].shape[0], "refined": moved, "features": weights["weight_in"].shape[1],
                        "networks": networks, "arrays": len(values), "outputs": sum(widths),
                        "widths": (*own, sum(widths) - sum(own)), "value_widths": widths,
                        "values": _addresses(values), "spans": address(spans), "time": address(given.time),
                        "rows": values, "layers": weights, "kept": (spans, given.time)}  # fmt: skip
        return slots | {key: x.data_ptr() for key, x in weights.items()}

    def fake(self, tensors: Tensors, numbers: Sequence[Any]) -> Tensors:
        return [x.new_empty(x.shape) for x in tensors[: -6 - 2 * numbers[0]]]


def _addresses(tensors: Tensors) -> tuple[int, ...]:
    return tuple([x.data_ptr() for x in tensors])


_refine = _Refine()


def refine(
    values: Tensors,  # of [N, c]; those of the first P - 1 are the features, F numbers in all
    weight_in: Tensor,  # [P * 64, F + G]
    bias_in: Tensor,  # [P * 64]
    weights_out: Tensors,  # P of [c, 64]
    biases_out: Tensors,  # P of [c]
    units: Tensor,  # [sum of c]
    gamma: Tensor,  # [G]
    *,
    rows: int | None = None,
    spans: Tensor | None = None,  # [rows, 2] clips
    time: Tensor | None = None,  # []
) -> Tensors:  # of [N, c], as `values`
    """Values moved by P perceptrons (F + G) x 64 x c with ReLU, x + phi(features, gamma) (7DGS eq. 14 and 15).

    Perceptron i moves values i; the last one all that are left, in their order.

    Args:
        values: raw parameters, those that are read first.
        weight_in: the first layers of all perceptrons, 64 rows each.
        bias_in: theirs.
        weights_out: the second layers.
        biases_out: theirs.
        units: what the perceptrons measure each number in.
        gamma: what is the same for all Gaussians, the encoded time.
        rows: how many of the first are moved, all by default; the others are copied.
        spans: the first and the last time at which each of these rows is moved; always, by default.
        time: needed with spans.

    Raises:
        InputError: not float32 on one device, shapes that do not fit, or there are not so many rows.
    """
    refined = EVERY_ROW if rows is None else rows
    given = {"values": values, "weight_in": [weight_in], "bias_in": [bias_in], "weights_out": weights_out,
             "biases_out": biases_out, "units": [units], "gamma": [gamma],
             "spans": [] if spans is None else [spans], "time": [] if time is None else [time]}  # fmt: skip
    for name, listed in given.items():
        for x in listed:
            check_tensor(x, f"refine: {name}", (torch.float32,))
            if x.dim() == 0 and name != "time":
                raise InputError(f"refine: {name}: expected at least one dimension, got none")
    widths, moved = [w.shape[0] for w in weights_out], [x.shape[-1] for x in values]
    last, hidden = len(widths) - 1, HIDDEN * len(widths)
    if last < 1 or [*moved[:last], sum(moved[last:])] != widths:
        raise InputError(f"refine: expected a perceptron for each feature and one for all other values, got outputs "
                         f"of {widths} numbers for values of {moved}")  # fmt: skip
    if len(widths) > MAX_NETWORKS or len(values) > MAX_VALUES:
        raise InputError(f"refine: expected at most {MAX_NETWORKS} perceptrons and {MAX_VALUES} arrays of values, got "
                         f"{len(widths)} and {len(values)}")  # fmt: skip
    N, G = values[0].shape[0], gamma.shape[0]
    shapes: list[tuple[str, Tensor, tuple[int, ...]]] = []
    shapes += [("values", x, (N, c)) for x, c in zip(values, moved, strict=True)]
    shapes += [("weight_in", weight_in, (hidden, sum(widths[:last]) + G)), ("bias_in", bias_in, (hidden,))]
    shapes += [("weights_out", w, (c, HIDDEN)) for w, c in zip(weights_out, widths, strict=True)]
    shapes += [("biases_out", b, (c,)) for b, c in zip(biases_out, widths, strict=True)]
    shapes += [("units", units, (sum(widths),)), ("gamma", gamma, (G,))]
    if (spans is None) != (time is None):
        raise InputError("refine: expected spans and time together, got one of them")
    if spans is not None and time is not None:
        shapes += [("spans", spans, (first_rows("refine: rows", refined, values[0]), 2)), ("time", time, ())]
    for name, x, shape in shapes:
        if tuple(x.shape) != shape or x.device != values[0].device:
            raise InputError(f"refine: expected {name} of shape {list(shape)} on {values[0].device}, got "
                             f"{list(x.shape)} on {x.device}")  # fmt: skip
    nothing = gamma.new_empty(0)
    when = (nothing, nothing) if spans is None else (spans, time)
    return _refine(*values, weight_in, bias_in, *weights_out, *biases_out, units, gamma, *when, len(widths), refined)
