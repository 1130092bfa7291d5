"""Apply AGR, the neural refinement of 7DGS: small MLPs that change the parameters of Gaussians over time.

The kernels keep hidden layers in cache only, and the backward pass computes them again. On a GPU, one call changes the
parameters for the times of several views.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from gsbench.errors import InputError
from gsbench.kernels.headers import HIDDEN, MAX_NETWORKS, MAX_VALUES
from gsbench.kernels.library import Slots, allocate, library_of
from gsbench.kernels.operation import (
    EVERY_ROW,
    Operation,
    Sums,
    Tensors,
    Upstream,
    address,
    addresses,
    first_rows,
    in_rows,
)
from gsbench.kernels.tensors import check_tensor


class _Inputs(NamedTuple):
    """The inputs of AGR (neural refinement) by name; the kernels take them as one list of tensors."""

    values: Tensors
    weight_in: Tensor
    bias_in: Tensor
    weight_out: Tensor
    bias_out: Tensor
    units: Tensor
    gamma: Tensor
    intervals: Tensor | None
    time: Tensor | None

    @classmethod
    def of(cls, tensors: Tensors) -> "_Inputs":
        """Return the inputs by name from the list of tensors; `intervals` and `time` are None if both are empty."""
        *values, weight_in, bias_in, weight_out, bias_out, units, gamma, intervals, time = tensors
        when = (None, None) if intervals.shape == time.shape == (0,) else (intervals, time)
        return cls(values, weight_in, bias_in, weight_out, bias_out, units, gamma, *when)

    def named(self) -> list[tuple[str, Tensor]]:
        """Return all tensors in order, each with its name for error messages."""
        each = [(name, x if isinstance(x, list) else [x]) for name, x in self._asdict().items() if x is not None]
        return [(name, x) for name, listed in each for x in listed]

    @property
    def views(self) -> int | None:
        """The number of views whose times are encoded; None: a single one, without a dimension."""
        return len(self.gamma) if self.gamma.dim() > 1 else None

    def weights(self) -> dict[str, Tensor]:
        """Return the weights of the MLPs as they are, which the kernels of a GPU take."""
        return {key: getattr(self, key).detach() for key in ("weight_in", "bias_in", "weight_out", "bias_out")}

    def layers(self) -> dict[str, Tensor]:
        """Return the weights of the MLPs in the form that the kernels of the CPU take.

        The encoded time gamma(t) is merged into the biases of the first layers, and the scales u (`units`) into the
        weights, because both are equal for all Gaussians. With W_in = [A B] for features f and gamma:
        W_in [f / u, gamma] + b = (A / u) f + (B gamma + b), and u (W_out h + b) = (u W_out) h + u b.
        """
        features = self.weight_in.shape[1] - self.gamma.shape[0]
        weight_in = self.weight_in.detach()
        return {
            "weight_in": weight_in[:, :features] / self.units[:features],
            "bias_in": F.linear(self.gamma, weight_in[:, features:], self.bias_in.detach()),
            "weight_out": self.weight_out.detach() * self.units[:, None],
            "bias_out": self.bias_out.detach() * self.units,
        }

    def of_layers(self, g: dict[str, Tensor]) -> Tensors:
        """Return the gradients of the original weights from those of the weights that `layers` returns."""
        features = g["weight_in"].shape[1]
        g_in = g["bias_in"].new_empty(self.weight_in.shape)
        torch.div(g["weight_in"], self.units[:features], out=g_in[:, :features])
        torch.outer(g["bias_in"], self.gamma.detach(), out=g_in[:, features:])
        return [g_in, g["bias_in"], g["weight_out"] * self.units[:, None], g["bias_out"] * self.units]


class _Refine(Operation):
    """The kernels of AGR (neural refinement), whose inputs are the fields of `_Inputs` in order."""

    def __init__(self) -> None:
        super().__init__("refine", inputs={}, outputs={}, numbers={"refined": int}, memory="refinements")

    def split(self, arguments: Sequence[Any]) -> tuple[Tensors, tuple[Any, ...]]:
        *tensors, refined = arguments
        if not all(isinstance(x, Tensor) for x in tensors):
            kinds = ", ".join(sorted({type(x).__name__ for x in tensors if not isinstance(x, Tensor)}))
            raise InputError(f"refine: expected tensors, got {kinds}")
        if not isinstance(refined, int):
            raise InputError(f"refine: expected rows as int, got {type(refined).__name__}")
        return tensors, (refined,)

    def differentiable(self, tensors: Tensors) -> list[bool]:
        return [True] * (len(tensors) - 4) + [False] * 4  # not: units, gamma, intervals, time

    def carries_gradient(self, outputs: Tensors) -> list[bool]:
        return [True] * len(outputs)

    def run(self, tensors: Tensors, numbers: Sequence[Any]) -> tuple[Tensors, Slots]:
        slots = self.prepare(tensors, numbers)
        values = slots["rows"]
        out = [allocate(self._memory, x, _shape_of(_Inputs.of(tensors), x)) for x in values]
        library_of(values[0].device.type).call("refine", slots | {"out.values": addresses(out)}, values[0])
        return out, slots

    def backward(
        self, tensors: Tensors, slots: Slots, outputs: Tensors, upstream: Upstream, wanted: Sequence[bool], sums: Sums
    ) -> list[Tensor | None]:
        """Run the backward kernel, as `Operation.backward`; return gradients of the values and the MLPs' weights."""
        values, weights = slots["rows"], slots["weights"]
        like, networks, inputs = values[0], slots["networks"], _Inputs.of(tensors)
        library = library_of(like.device.type)
        dense = [torch.zeros_like(x) if g is None else g.contiguous() for g, x in zip(upstream, outputs, strict=True)]
        # MLPs read the first networks - 1 arrays. The gradient by any other is that by its output, which needs a kernel
        # only to be added up over views.
        computed = values if inputs.views else values[: networks - 1]
        g_values = [allocate("gradients of AGR's features", x, x.shape) for x in computed]
        g_weights = {key: torch.empty_like(x) for key, x in weights.items()}
        scratch = biases = None
        if library.needs_scratch:
            shape = networks, slots["V"], slots["refined"], slots["features"]
            scratch = allocate("gradients of AGR's features", like, shape)
            biases = allocate("gradients of AGR's biases", like, (slots["V"], len(inputs.bias_in)))
        zeroed = [*g_weights.values(), *([] if biases is None else [biases])]
        torch._foreach_zero_(zeroed)  # on a GPU in one launch
        slots |= {"given.values": addresses(dense), "grad.values": addresses(g_values)}
        slots |= {"grad.scratch": address(scratch), "grad.biases": address(biases)}
        slots |= {f"grad.{key}": g.data_ptr() for key, g in g_weights.items()}
        library.call("refine_backward", slots, like)
        of_weights = list(g_weights.values()) if library.takes_views else inputs.of_layers(g_weights)
        return [*g_values, *dense[len(g_values) :], *of_weights, None, None, None, None]

    def prepare(self, tensors: Tensors, numbers: Sequence[Any], outputs: Sequence[Tensor] = ()) -> Slots:
        """Return the kernel arguments by name, and the tensors that must not be freed before the kernels have run."""
        slots = self.match(tensors, numbers).copy()
        inputs = _Inputs.of(tensors)
        values, units, gamma = in_rows(inputs.values), None, None
        if library_of(values[0].device.type).takes_views:
            weights, (units, gamma) = inputs.weights(), in_rows([inputs.units, inputs.gamma])
        else:  # units and gamma are merged into the weights
            weights = inputs.layers()
        weights = dict(zip(weights, in_rows(list(weights.values())), strict=True))
        intervals, time = inputs.intervals, inputs.time
        if intervals is not None and time is not None:
            intervals, time = in_rows([intervals, time])
        slots |= {
            "values": addresses(values),
            "units": address(units),
            "gamma": address(gamma),
            "encoded": 0 if gamma is None else gamma.shape[-1],
            "intervals": address(intervals),
            "time": address(time),
            "rows": values,
            "weights": weights,
            "kept": (intervals, time, units, gamma),
        }
        return slots | {key: x.data_ptr() for key, x in weights.items()}

    def _match(self, tensors: Tensors, numbers: Sequence[Any]) -> Slots:
        """Return the sizes of a call; raise InputError if tensors are not as `refine` says."""
        inputs = _Inputs.of(tensors)
        listed = inputs.named()
        for name, x in listed:
            check_tensor(x, f"refine: {name}", (torch.float32,))
            if x.dim() == 0 and name != "time":
                raise InputError(f"refine: {name}: expected at least one dimension, got none")
        value_widths = [x.shape[-1] for x in inputs.values]
        networks, rest = divmod(len(inputs.weight_in), HIDDEN)
        last = networks - 1
        if rest or not 1 <= last < len(value_widths):
            raise InputError(
                f"refine: expected {HIDDEN} rows of weight_in for each feature and {HIDDEN} for all other "
                f"values, got {len(inputs.weight_in)} for {len(value_widths)} values"
            )
        if networks > MAX_NETWORKS or len(value_widths) > MAX_VALUES:
            raise InputError(
                f"refine: expected at most {MAX_NETWORKS} perceptrons and {MAX_VALUES} arrays of values, "
                f"got {networks} and {len(value_widths)}"
            )
        widths = [*value_widths[:last], sum(value_widths[last:])]  # of the outputs of each MLP
        like, features, outputs, hidden = inputs.values[0], sum(widths[:last]), sum(widths), HIDDEN * networks
        rows = first_rows("refine: rows", numbers[0], like)
        # The shapes of `listed`, in the order of `_Inputs`.
        shapes: list[tuple[int, ...]] = [(len(like), width) for width in value_widths]
        views = () if inputs.views is None else (inputs.views,)
        encoded = inputs.gamma.shape[-1]
        shapes += [(hidden, features + encoded), (hidden,), (outputs, HIDDEN), (outputs,)]
        shapes += [(outputs,), (*views, encoded)]
        if inputs.intervals is not None:
            shapes += [(rows, 2), views]
        for (name, x), shape in zip(listed, shapes, strict=True):
            if tuple(x.shape) != shape or x.device != like.device:
                raise InputError(
                    f"refine: expected {name} of shape {list(shape)} on {like.device}, got "
                    f"{list(x.shape)} on {x.device}"
                )
        sizes = {} if inputs.views is None else {"views": inputs.views}
        return sizes | {
            "N": len(like),
            "V": inputs.views or 1,
            "refined": rows,
            "features": features,
            "networks": networks,
            "arrays": len(value_widths),
            "outputs": outputs,
            "widths": tuple(widths),
            "value_widths": tuple(value_widths),
        }


def _shape_of(inputs: _Inputs, values: Tensor) -> tuple[int, ...]:
    """Return the shape of values that AGR has changed: [N, c], or [V, N, c] for several views."""
    return tuple(values.shape) if inputs.views is None else (inputs.views, *values.shape)


_refine = _Refine()


def refine(
    values: Tensors,  # of [N, c]: raw parameters; the first P - 1 tensors, of F numbers in all, are also the features
    weight_in: Tensor,  # [P * 64, F + G] the first layers of all MLPs
    bias_in: Tensor,  # [P * 64]
    weight_out: Tensor,  # [sum of c, 64] the second layers, a row for each output
    bias_out: Tensor,  # [sum of c]
    units: Tensor,  # [sum of c] the scales of inputs and outputs: MLPs read and give numbers in these units
    gamma: Tensor,  # [G] the encoded time, or on a GPU [V, G] those of V views
    *,
    rows: int | None = None,  # only the first `rows` Gaussians change, the others are copied; None: all
    intervals: Tensor | None = None,  # [rows, 2] the first and last time at which each of these changes; None: always
    time: Tensor | None = None,  # [] or [V] of the views, required with `intervals`
) -> Tensors:  # of [N, c], as `values`, or [V, N, c]
    """Change raw parameters of Gaussians by P small MLPs with ReLU, as AGR of 7DGS does (eq. 14 and 15).

    MLP number i adds its output to `values[i]`, the last one to all remaining tensors.

    Raises:
        InputError: tensors are not float32 on one device, their shapes do not match, or there are fewer than `rows`
            rows.
    """
    if (intervals is None) != (time is None):
        raise InputError("refine: expected intervals and time together, got one of them")
    nothing = gamma.new_empty(0) if isinstance(gamma, Tensor) else gamma  # another type is refused with the others
    when = (nothing, nothing) if intervals is None else (intervals, time)
    return _refine(
        *values, weight_in, bias_in, weight_out, bias_out, units, gamma, *when, EVERY_ROW if rows is None else rows
    )
