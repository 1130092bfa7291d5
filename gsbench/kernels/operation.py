"""Declare a differentiable operation by its kernels; checks, calls and the gradient follow from the declaration.

An operation is a pair of compiled kernels, forward and backward. An active tape, which is a list of kernel calls
(`gsbench.kernels.tape`), records each call for the backward pass. Without a tape torch's autograd records the call.
"""

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum, auto
from types import NoneType
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from gsbench.errors import InputError
from gsbench.kernels.library import Slots, allocate, library_of
from gsbench.kernels.tensors import check_tensor

Tensors = list[Tensor]  # an input that is left out is an empty 1D tensor
Sizes = dict[str, int]
Results = tuple[Tensors, Slots]  # outputs of a call, and the kernel arguments that its backward pass needs
Shape = tuple[int | str, ...]
Upstream = Sequence[Tensor | None]  # the gradient of the loss by each output of an operation; None: zero
Sums = dict[int, Tensor]  # by the number of an input, the tensor to which its gradient is added

_KINDS: dict[type, tuple[type, ...]] = {int: (int,), float: (float, int), bool: (bool,)}  # accepted Python types
_NOTHING = torch.Size([0])
_MAY_BE_NULL = frozenset({"given.depths", "given.alpha"})  # gradients of outputs of which a null address means zero

active = threading.local()  # active.tape records the calls of this thread, if it is there and not None
EVERY_ROW = 2**62  # stands for all rows
MOST_KNOWN = 64  # the most calls whose shapes are cached; densification makes new shapes all the time


class Gradient(Enum):
    """How a backward kernel returns the gradient of an input: by overwriting memory, by adding to it, or not at all."""

    WRITTEN = auto()  # overwrites every entry
    ADDED = auto()  # adds to every entry, so that all views of a batch share one gradient
    SUMMED = auto()  # a sum over all Gaussians: each GPU block adds its part, to memory that is zero at first
    ON_REQUEST = auto()  # as SUMMED, but computed only if the caller needs it
    NONE = auto()  # no gradient is computed; inputs may require one
    REFUSED = auto()  # there is no gradient; an input that requires one is an error


_STARTS_AT_ZERO = (Gradient.ADDED, Gradient.SUMMED, Gradient.ON_REQUEST)


@dataclass(frozen=True)
class Input:
    """A tensor that an operation (a pair of forward and backward kernels) reads.

    Args:
        shape: dimensions such as "N 3" or "C height width D". A dimension is a number or a name; equal names in one
            operation mean equal sizes. A first dimension that may be missing starts with a question mark; `?views` is
            there only on a GPU, whose kernels compute several views at once.
        gradient: how the backward kernel returns the gradient.
        dtypes: the accepted types: float32, or int32 for indices.
        left_out_with: makes the input optional; inputs with the same value here are left out together.
        is_list: the tensor has one dimension, whose size changes from call to call and is used for no other tensor.
    """

    shape: str
    gradient: Gradient = Gradient.WRITTEN
    dtypes: tuple[torch.dtype, ...] = (torch.float32,)
    left_out_with: str | None = None
    is_list: bool = False


@dataclass(frozen=True)
class Output:
    """A tensor that an operation returns: its shape as in `Input`, and whether it has a gradient.

    A first dimension that may be missing is there if an input has it.
    """

    shape: str
    gradient: bool = True


def sizes_of(shape: str) -> Shape:
    """Split a shape such as "N 3" into its dimensions; numbers become integers."""
    return tuple(int(size) if size.isdigit() else size for size in shape.split())


class Operation:
    """A differentiable operation with a forward kernel NAME and a backward kernel NAME_backward."""

    def __init__(
        self,
        name: str,
        *,
        inputs: dict[str, Input],
        outputs: dict[str, Output],
        numbers: dict[str, type] | None = None,
        defaults: dict[str, Any] | None = None,
        derive: Callable[[dict[str, Tensor], Slots], Sizes] | None = None,
        scratch: str | None = None,
        memory: str = "results",
    ) -> None:
        """Declare the operation.

        Args:
            name: the name of the operation and of its forward kernel.
            inputs: the input tensors, by the argument names of the kernel.
            outputs: the output tensors, by the argument names of the kernel.
            numbers: the type of each argument that is not a tensor; an int may also be a dimension of a tensor.
            defaults: the values of numbers that a call may leave out.
            derive: computes dimensions that are not dimensions of an input, from the present tensors and the numbers.
            scratch: the shape of memory, initialised to zero, that the backward kernel needs on a GPU.
            memory: the name of the outputs in the error message if memory does not suffice.
        """
        self.name = name
        self.inputs, self.outputs = inputs, outputs
        self.numbers, self.defaults = numbers or {}, defaults or {}
        # What is declared of each input, by its number or as a set of numbers, and of each output.
        kinds = [x.gradient for x in inputs.values()]
        self.adds = {i for i, kind in enumerate(kinds) if kind is Gradient.ADDED}
        self._differentiable = [kind not in (Gradient.NONE, Gradient.REFUSED) for kind in kinds]
        self._on_request = {i for i, kind in enumerate(kinds) if kind is Gradient.ON_REQUEST}
        self._zeroed = {i for i, kind in enumerate(kinds) if kind in _STARTS_AT_ZERO}
        self._carries = [x.gradient for x in outputs.values()]
        self._optional = {i for i, x in enumerate(inputs.values()) if x.left_out_with}
        self._shapes = [sizes_of(x.shape) for x in inputs.values()]
        self._lists = {i: x.shape for i, x in enumerate(inputs.values()) if x.is_list}  # names of their sizes
        self._derive = derive
        self._scratch = sizes_of(scratch) if scratch is not None else None
        self._memory = memory
        # The argument names of the kernels; None if an input has no gradient.
        self._out = [(f"out.{key}", sizes_of(x.shape)) for key, x in outputs.items()]
        self._grad_out = [f"given.{key}" for key in outputs]
        self._needed = {f"given.{key}" for key, x in outputs.items() if x.gradient} - _MAY_BE_NULL
        self._grad = [f"grad.{key}" if has else None for key, has in zip(inputs, self._differentiable, strict=True)]
        self._kinds: list[tuple[type, ...]] = [
            (Tensor, NoneType) if i in self._optional else (Tensor,) for i in range(len(inputs))
        ]
        self._kinds += [_KINDS[kind] for kind in self.numbers.values()]
        self._known: dict[tuple[Any, ...], Slots] = {}  # results of `match` by numbers, shapes and types
        self._backward_kernel = f"{name}_backward"

    def __call__(self, *arguments: Any, **by_name: Any) -> Tensors:
        """Run the kernel with tensors and then numbers, in the order of the declaration or by name.

        An optional tensor may be left out or None, and so may a number that has a default.

        Raises:
            InputError: shapes do not match, tensors are not float32 on one device, or an input requires a gradient that
                the operation does not compute.
        """
        if len(arguments) < len(self._kinds):
            arguments = self._in_order(arguments, by_name)
        tensors, numbers = self.split(arguments)
        for (key, declared), x in zip(self.inputs.items(), tensors, strict=False):
            if declared.gradient is Gradient.REFUSED and x.requires_grad:
                raise InputError(f"{self.name} has no gradient by {key}: detach it")
        return self.record(tensors, numbers)

    def record(self, tensors: Tensors, numbers: tuple[Any, ...], results: Results | None = None) -> Tensors:
        """Return the outputs of a call, recorded for the backward pass.

        The forward kernel runs unless another kernel has computed the `results` of `allocate_results`.
        """
        if (recording := getattr(active, "tape", None)) is not None:
            return recording.record(self, tensors, numbers, results)
        if torch.is_grad_enabled() and any(x.requires_grad for x in tensors):
            return list(_Differentiated.apply(self, numbers, results, *tensors))
        return (results or self.run(tensors, numbers))[0]

    def _in_order(self, arguments: tuple[Any, ...], by_name: dict[str, Any]) -> tuple[Any, ...]:
        """Return the arguments of a call in the order of the declaration; None has become the default."""
        names = [*self.inputs, *self.numbers]
        known = dict(zip(names, arguments, strict=False)) | by_name
        if unknown := sorted(known.keys() - names):
            raise InputError(f"{self.name}: expected {', '.join(names)}, got {unknown[0]} too")
        return tuple([self.defaults.get(name) if known.get(name) is None else known[name] for name in names])

    def split(self, arguments: Sequence[Any]) -> tuple[Tensors, tuple[Any, ...]]:
        """Split the arguments of a call into tensors and numbers."""
        if not all(map(isinstance, arguments, self._kinds)):
            raise self._wrong_kind(arguments)
        count = len(self.inputs)
        like = arguments[0]
        return [like.new_empty(0) if x is None else x for x in arguments[:count]], tuple(arguments[count:])

    def differentiable(self, tensors: Tensors) -> list[bool]:
        """Return for each input whether the operation computes its gradient."""
        return self._differentiable

    def carries_gradient(self, outputs: Tensors) -> list[bool]:
        """Return for each output whether it has a gradient."""
        return self._carries

    # ---- forward and backward

    def run(self, tensors: Tensors, numbers: Sequence[Any]) -> Results:
        """Run the forward kernel. The call is not recorded for the backward pass."""
        outputs, slots = self.allocate_results(tensors, numbers)
        library_of(tensors[0].device.type).call(self.name, slots, tensors[0])
        return outputs, slots

    def allocate_results(self, tensors: Tensors, numbers: Sequence[Any]) -> Results:
        """Allocate the outputs of a call, and return them with the arguments of the forward kernel."""
        slots, outputs = self.prepare(tensors, numbers), []
        for key, shape in self._out:
            outputs.append(allocate(self._memory, tensors[0], _filled(shape, slots)))
            slots[key] = outputs[-1].data_ptr()
        return outputs, slots

    def prepare(self, tensors: Tensors, numbers: Sequence[Any], outputs: Sequence[Tensor] = ()) -> Slots:
        """Return the kernel arguments of a call by name: sizes, numbers, and addresses of inputs and `outputs`.

        Outputs are passed for a backward pass only; `run` allocates those of a forward pass itself. The entry `rows`
        holds the tensors, so that their memory is not freed.
        """
        slots = self.match(tensors, numbers).copy()
        rows = slots["rows"] = in_rows(tensors)
        for key, x in zip(self.inputs, rows, strict=True):
            slots[key] = x.data_ptr()
        for (key, _), x in zip(self._out, outputs, strict=False):
            slots[key] = x.data_ptr()
        return slots

    def backward(
        self, tensors: Tensors, slots: Slots, outputs: Tensors, upstream: Upstream, wanted: Sequence[bool], sums: Sums
    ) -> list[Tensor | None]:
        """Run the backward kernel and return the gradients of the inputs.

        Args:
            tensors: the inputs of `run`.
            slots: the kernel arguments that `run` returned.
            outputs: the outputs that `run` returned.
            upstream: the gradient of the loss by each output.
            wanted: whether the caller needs the gradient of each input; a gradient that is declared ON_REQUEST is
                computed only if the caller needs it.
            sums: where to add gradients that are declared ADDED; those that have no place there get new memory.
        """
        like = tensors[0]
        library = library_of(like.device.type)
        # The gradients by the outputs, as a kernel reads them; they must not be freed before it has run.
        kept: list[Tensor | None] = []
        for name, g, x in zip(self._grad_out, upstream, outputs, strict=True):
            if g is None and name in self._needed:
                g = torch.zeros_like(x)
            kept.append(None if g is None else g if g.is_contiguous() else g.contiguous())
            slots[name] = address(kept[-1])
        gradients: list[Tensor | None] = []
        zeroed: list[Tensor] = []  # what must be zero before the kernel runs
        for i, (key, x) in enumerate(zip(self._grad, tensors, strict=True)):
            if key is None:
                gradients.append(None)
                continue
            if (i in self._on_request and not wanted[i]) or self._is_left_out(i, x):
                gradients.append(None)
                slots[key] = 0
                continue
            if i in sums:
                gradient = sums[i]
            else:
                gradient = allocate("gradients", like, x.shape)
                if i in self._zeroed:
                    zeroed.append(gradient)
            gradients.append(gradient)
            slots[key] = gradient.data_ptr()
        if self._scratch is not None:
            if library.needs_scratch:
                zeroed.append(allocate("scratch space of gradients", like, _filled(self._scratch, slots)))
                slots["grad.scratch"] = address(zeroed[-1])
            else:
                slots["grad.scratch"] = 0
        if zeroed:
            library.zero(zeroed)
        library.call(self._backward_kernel, slots, like)
        return gradients

    # ---- what follows from the declaration

    def match(self, tensors: Tensors, numbers: Sequence[Any]) -> Slots:
        """Return the named dimensions of the tensors of a call, and its arguments that are numbers.

        Raises:
            InputError: an argument does not match the declaration.
        """
        call = (
            *numbers,
            *[(x.dim() if i in self._lists else x.shape, x.dtype, x.device, x.layout) for i, x in enumerate(tensors)],
        )
        slots = self._known.get(call)  # training calls an operation with few different shapes
        if slots is None:
            slots = self._match(tensors, numbers)
            device = tensors[0].device
            if "views" in slots and not library_of(device.type).takes_views:
                raise InputError(f"{self.name}: expected one view on {device}, got {slots['views']} in one call")
            for length in self._lists.values():  # calls with lists of other lengths share the entry
                del slots[length]
            if len(self._known) >= MOST_KNOWN:
                self._known.clear()
            self._known[call] = slots
        return slots

    def _match(self, tensors: Tensors, numbers: Sequence[Any]) -> Slots:
        """Do what `match` does, without its cache."""
        slots: Slots = dict(zip(self.numbers, numbers, strict=True))
        listed = list(zip(self.inputs.items(), self._shapes, tensors, strict=True))  # ((key, Input), shape, tensor)
        present = [part for i, part in enumerate(listed) if not self._is_left_out(i, part[2])]
        names = {key for (key, _), _, _ in present}
        for group in {x.left_out_with for x in self.inputs.values()} - {None}:
            together = [key for key, x in self.inputs.items() if x.left_out_with == group]
            if 0 < len(names.intersection(together)) < len(together):  # kernels expect all addresses of a group
                raise InputError(f"{self.name}: expected all of {', '.join(together)}, or none of them")
        for (key, declared), _, x in present:
            check_tensor(x, f"{self.name}: {key}", declared.dtypes)
        if self._derive is not None:
            slots.update(self._derive({key: x for (key, _), _, x in present}, slots))
        device = tensors[0].device
        for (key, _), shape, x in present:
            actual, expected = list(x.shape), list(shape)
            if expected and isinstance(first := expected[0], str) and first.startswith("?"):  # it may be left out
                expected = expected[1:] if len(actual) < len(expected) else [first[1:], *expected[1:]]
            fits = len(actual) == len(expected)
            for size, length in zip(expected, actual, strict=False):  # the first length of a named size defines it
                fits = fits and length == (slots.setdefault(size, length) if isinstance(size, str) else size)
            if not fits:
                known = [slots.get(size, size) if isinstance(size, str) else size for size in expected]
                raise InputError(f"{self.name}: expected {key} of shape {known}, got {actual}")
            if x.device != device:
                raise InputError(
                    f"{self.name}: expected {key} on {device}, as {next(iter(self.inputs))} is, got it on {x.device}"
                )
        return slots

    def _wrong_kind(self, arguments: Sequence[Any]) -> InputError:
        """Return an InputError that names the argument with the wrong type."""
        named = zip([*self.inputs, *self.numbers], arguments, self._kinds, strict=True)
        key, x, kinds = next((key, x, kinds) for key, x, kinds in named if not isinstance(x, kinds))
        expected = "a tensor" if Tensor in kinds else kinds[0].__name__
        return InputError(f"{self.name}: expected {key} as {expected}, got {type(x).__name__}")

    def _is_left_out(self, i: int, x: Tensor) -> bool:
        """Return whether input number `i` is optional and left out."""
        return i in self._optional and x.shape == _NOTHING


class _Differentiated(torch.autograd.Function):
    """A call of an operation that autograd records."""

    @staticmethod
    def forward(
        ctx: Any, operation: Operation, numbers: tuple[Any, ...], results: Results | None, *tensors: Tensor
    ) -> tuple[Tensor, ...]:
        outputs, _ = results or operation.run(list(tensors), numbers)
        ctx.operation, ctx.numbers, ctx.inputs = operation, numbers, len(tensors)
        ctx.save_for_backward(*tensors, *outputs)
        carries = operation.carries_gradient(outputs)
        ctx.mark_non_differentiable(*[x for x, has in zip(outputs, carries, strict=True) if not has])
        ctx.set_materialize_grads(False)  # a gradient that is zero comes as None
        return tuple(outputs)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor | None) -> tuple[Any, ...]:
        tensors, outputs = list(ctx.saved_tensors[: ctx.inputs]), list(ctx.saved_tensors[ctx.inputs :])
        operation, wanted = ctx.operation, ctx.needs_input_grad[3:]
        slots = operation.prepare(tensors, ctx.numbers, outputs)  # autograd saves only tensors, no addresses
        gradients = operation.backward(tensors, slots, outputs, upstream, wanted, {})
        return (
            *[None] * 3,  # for operation, numbers and results
            *[
                (torch.zeros_like(x) if g is None else g) if asked else None
                for x, g, asked in zip(tensors, gradients, wanted, strict=True)
            ],
        )


def _filled(shape: Shape, slots: Slots) -> tuple[int, ...]:
    """Return a declared shape with the sizes of a call in the place of their names."""
    first = shape[0] if shape else 0
    if isinstance(first, str) and first.startswith("?"):
        shape = (first[1:], *shape[1:]) if first[1:] in slots else shape[1:]
    return tuple([slots[x] if isinstance(x, str) else x for x in shape])


def has_leading(name: str, tensors: dict[str, Tensor], dims: dict[str, int]) -> bool:
    """Return whether tensors have a dimension of cameras (views) before their `dims` dimensions.

    Raises:
        InputError: some of those that are there have it, and others do not.
    """
    there = {key: tensors[key].dim() > count for key, count in dims.items() if key in tensors}
    if len(set(there.values())) > 1:
        raise InputError(f"{name}: expected {', '.join(there)} of each camera, or all for all cameras")
    return any(there.values())


def address(x: Tensor | None) -> int:
    """Return the memory address of a tensor's first element, or 0 for None; the caller must keep the tensor alive."""
    return 0 if x is None else x.data_ptr()


def addresses(tensors: Sequence[Tensor]) -> tuple[int, ...]:
    """Return the memory address of each tensor's first element; the caller must keep the tensors alive."""
    return tuple([x.data_ptr() for x in tensors])


def first_rows(name: str, count: int, x: Tensor) -> int:
    """Return how many rows of a tensor a kernel changes: `count`, or all for EVERY_ROW; InputError if it has fewer."""
    N = x.shape[0] if x.dim() else 0
    if count != EVERY_ROW and not 0 <= count <= N:
        raise InputError(f"{name}: expected a number of rows from 0 to {N}, as there are, got {count}")
    return min(count, N)


def in_rows(tensors: Tensors) -> Tensors:
    """Return the tensors as contiguous ones, with torch's lazy negation applied."""
    return [x if x.is_contiguous() and not x.is_neg() else x.resolve_neg().contiguous() for x in tensors]
