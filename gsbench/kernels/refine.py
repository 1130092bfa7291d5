"""Move Gaussians by AGR's perceptrons: hidden layers stay in cache, and backward computes them again."""

from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.library import Slots, allocate, library_of
from gsbench.kernels.operation import EVERY_ROW, Operation, Tensors, address, first_rows, in_rows
from gsbench.tensors import check_tensor

HIDDEN = 64
MAX_NETWORKS, MAX_VALUES = 4, 12  # as arguments.h has them


class _Refine(Operation):
    """The one operation on a list of arrays: values, then weight_in, bias_in, weights_out, biases_out, units, gamma.

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
        return [True] * (len(tensors) - 2) + [False] * 2

    def carries_gradient(self, outputs: Tensors) -> list[bool]:
        return [True] * len(outputs)

    def run(self, tensors: Tensors, numbers: Sequence[Any]) -> tuple[Tensors, Slots]:
        values, weights = self._layers(tensors, numbers[0])
        out = [allocate(self._memory, x, x.shape) for x in values]
        slots = self._slots(values, weights, numbers[1])
        slots["rows"] = values, weights
        library_of(values[0].device.type).call("refine", slots | {"out.values": _addresses(out)}, values[0])
        return out, slots

    def prepare(self, tensors: Tensors, numbers: Sequence[Any], outputs: Tensors) -> Slots:
        values, weights = self._layers(tensors, numbers[0])
        return self._slots(values, weights, numbers[1]) | {"rows": (values, weights)}

    def backward(
        self, tensors: Tensors, slots: Slots, outputs: Tensors, given: Sequence[Tensor | None],
        wanted: Sequence[bool], sums: dict[int, Tensor] | None = None,
    ) -> list[Tensor | None]:  # fmt: skip
        values, weights = slots["rows"]
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
        return [*moved, *dense[features:], *self._of_layers(tensors, networks, g_weights), None, None]

    def _layers(self, tensors: Tensors, networks: int) -> tuple[Tensors, dict[str, Tensor]]:
        """The arrays, and the weights as the kernels take them."""
        *values, weight_in, bias_in = tensors[: -2 - 2 * networks]
        weights_out, biases_out = tensors[-2 - 2 * networks : -2 - networks], tensors[-2 - networks : -2]
        units, gamma = tensors[-2:]
        read = weight_in.shape[1] - gamma.shape[0]
        weights = {
            "weight_in": weight_in.detach()[:, :read] / units[:read],
            "bias_in": F.linear(gamma, weight_in.detach()[:, read:], bias_in.detach()),
            "weight_out": torch.cat(weights_out).detach() * units[:, None],
            "bias_out": torch.cat(biases_out).detach() * units,
        }
        return in_rows(values), dict(zip(weights, in_rows(list(weights.values())), strict=True))

    def _of_layers(self, tensors: Tensors, networks: int, g: dict[str, Tensor]) -> Tensors:
        """The gradients of the layers' own weights."""
        *_, units, gamma = tensors
        widths = [x.shape[0] for x in tensors[-2 - networks : -2]]
        read = g["weight_in"].shape[1]
        g_in = torch.cat([g["weight_in"] / units[:read], torch.outer(g["bias_in"], gamma)], 1)
        g_out, g_bias = g["weight_out"] * units[:, None], g["bias_out"] * units
        return [g_in, g["bias_in"], *g_out.split(widths), *g_bias.split(widths)]

    def _slots(self, values: Tensors, weights: dict[str, Tensor], refined: int) -> Slots:
        widths = tuple(x.shape[1] for x in values)
        networks, features = weights["bias_in"].shape[0] // HIDDEN, weights["weight_in"].shape[1]
        own = widths[: networks - 1]
        moved = first_rows("refine: rows", refined, values[0])
        sizes: Slots = {"N": values[0].shape[0], "refined": moved, "features": features, "networks": networks,
                        "arrays": len(values), "outputs": sum(widths), "widths": (*own, sum(widths) - sum(own)),
                        "value_widths": widths, "values": _addresses(values)}  # fmt: skip
        return sizes | {key: x.data_ptr() for key, x in weights.items()}

    def fake(self, tensors: Tensors, numbers: Sequence[Any]) -> Tensors:
        return [x.new_empty(x.shape) for x in tensors[: -4 - 2 * numbers[0]]]


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

    Raises:
        InputError: not float32 on one device, shapes that do not fit, or there are not so many rows.
    """
    given = {"values": values, "weight_in": [weight_in], "bias_in": [bias_in], "weights_out": weights_out,
             "biases_out": biases_out, "units": [units], "gamma": [gamma]}  # fmt: skip
    for name, listed in given.items():
        for x in listed:
            check_tensor(x, f"refine: {name}", (torch.float32,))
            if x.dim() == 0:
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
    for name, x, shape in shapes:
        if tuple(x.shape) != shape or x.device != values[0].device:
            raise InputError(f"refine: expected {name} of shape {list(shape)} on {values[0].device}, got "
                             f"{list(x.shape)} on {x.device}")  # fmt: skip
    return _refine(*values, weight_in, bias_in, *weights_out, *biases_out, units, gamma, len(widths),
                   EVERY_ROW if rows is None else rows)  # fmt: skip
