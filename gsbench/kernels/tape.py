"""Differentiate the operations of a rendered view without autograd: record them, then run them backwards.

A training step is a few dozen kernel calls on small tensors, for which autograd's overhead would exceed the time of the
kernels. Autograd still differentiates other code: if a tensor with a `grad_fn` enters an operation, the tape passes the
gradient on to autograd. So models written in torch also train.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Sequence
from types import TracebackType
from typing import Any, NamedTuple, Protocol, Self

import torch
from torch import Tensor

_in_charge = threading.local()  # each thread has its own


def current() -> Tape | None:
    """Return the tape (list of kernel calls for a backward pass) that is active in this thread, or None."""
    return getattr(_in_charge, "tape", None)


def add_to(sums: dict[int, Tensor], key: int, gradient: Tensor) -> None:
    """Add a gradient in place to `sums[key]`; if there is none yet, the gradient becomes this entry."""
    if key in sums:
        sums[key] += gradient
    else:
        sums[key] = gradient


class Differentiable(Protocol):
    """The interface of a function that a tape can record and run backwards, such as a pair of kernels (`Operation`)."""

    name: str
    adds: set[int]  # the indices of inputs whose gradients the backward kernel adds to given memory

    def run(self, tensors: list[Tensor], numbers: Sequence[Any]) -> tuple[list[Tensor], dict[str, Any]]:
        """Run the forward kernel; return the outputs, and the kernel arguments that the backward pass needs."""

    def differentiable(self, tensors: list[Tensor]) -> list[bool]:
        """Return for each input whether the operation computes its gradient."""

    def carries_gradient(self, outputs: list[Tensor]) -> list[bool]:
        """Return for each output whether it has a gradient."""

    def backward(
        self,
        tensors: list[Tensor],
        slots: dict[str, Any],
        outputs: list[Tensor],
        upstream: Sequence[Tensor | None],
        wanted: Sequence[bool],
        sums: dict[int, Tensor] | None = None,
    ) -> list[Tensor | None]:
        """Return the gradients of the inputs, given the gradients of the outputs."""


class _Note(NamedTuple):
    operation: Differentiable
    tensors: list[Tensor]
    wanted: list[bool]
    slots: dict[str, Any]
    outputs: list[Tensor]


class Tape:
    """Records the kernels called inside `with Tape() as tape: ...`; `tape.backward` computes their gradients."""

    def __init__(self) -> None:
        """Create a tape without operations."""
        self._notes: list[_Note] = []

    def __enter__(self) -> Self:
        self._outer = current()
        _in_charge.tape = self
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        _in_charge.tape = self._outer

    def record(self, operation: Differentiable, tensors: list[Tensor], numbers: Sequence[Any]) -> list[Tensor]:
        """Run a kernel, and record the call if an input requires a gradient that the backward kernel computes."""
        outputs, slots = operation.run(tensors, numbers)
        if not torch.is_grad_enabled():
            return outputs
        differentiable = operation.differentiable(tensors)
        wanted = [through and x.requires_grad for x, through in zip(tensors, differentiable, strict=True)]
        if any(wanted):
            for x, through in zip(outputs, operation.carries_gradient(outputs), strict=True):
                if through:
                    x.requires_grad_()  # so that autograd records what torch computes from this output
            self._notes.append(_Note(operation, tensors, wanted, slots, outputs))
        return outputs

    def backward(self, loss: Tensor, seed: Tensor, sources: Sequence[Tensor], sums: dict[int, Tensor]) -> None:
        """Compute the gradients of `loss` with respect to the tensors `sources`, and add them to `sums`.

        The keys of `sums` are the ids of the tensors in `sources`.

        `seed` is the gradient of the loss itself, by which all gradients are multiplied. The added gradients are
        bitwise the same whether `sums` is empty or not. A tape may run backwards several times, with different seeds.
        """
        at = _Gradients(self._notes, sources, sums)
        at.give(loss, seed)
        for note in reversed(self._notes):
            at.through(note)
        at.finish()


class _Gradients:
    """The gradients of tensors that one backward pass of a tape has computed so far."""

    def __init__(self, notes: list[_Note], sources: Sequence[Tensor], sums: dict[int, Tensor]) -> None:
        self.notes = notes
        self.sources = {id(x): x for x in sources}
        self.sums = sums
        self.gradients: dict[int, Tensor] = {}
        self.uses = Counter([id(x) for note in notes for x in note.tensors])

    def give(self, x: Tensor, gradient: Tensor) -> None:
        """Add a gradient to that of the tensor `x`; if `x` has a `grad_fn`, backpropagate it through autograd."""
        self._add(x, gradient)
        if x.grad_fn is None:
            return
        outputs = [y for note in self.notes for y in note.outputs if y.requires_grad]
        ends = [y for y in (*self.sources.values(), *outputs) if y.requires_grad and y is not x]
        gradients = torch.autograd.grad(x, ends, gradient, allow_unused=True, retain_graph=True)
        for end, of_end in zip(ends, gradients, strict=True):
            if of_end is not None:
                self._add(end, of_end.clone())  # torch may return two gradients that share memory

    def _add(self, x: Tensor, gradient: Tensor) -> None:
        before = self.gradients.get(id(x))
        self.gradients[id(x)] = gradient if before is None else before + gradient

    def through(self, note: _Note) -> None:
        """Run the backward kernel of one recorded call, if one of its outputs has a gradient."""
        upstream = [self.gradients.get(id(x)) for x in note.outputs]
        if all(g is None for g in upstream):
            return
        # If only this operation reads an input, this is its whole gradient, which may be added to that of other views.
        whole, there = {}, {}
        for i in note.operation.adds:
            key = id(note.tensors[i])
            if key in self.sources and self.uses[key] == 1 and key not in self.gradients:
                whole[i] = key
                if key in self.sums:
                    there[i] = self.sums[key]
        gradients = note.operation.backward(note.tensors, note.slots, note.outputs, upstream, note.wanted, there)
        for i, (x, gradient, wanted) in enumerate(zip(note.tensors, gradients, note.wanted, strict=True)):
            if gradient is None or not wanted:
                continue
            if i in whole:
                self.sums[whole[i]] = gradient
            else:
                self.give(x, gradient)

    def finish(self) -> None:
        """Add the gradients of all source tensors to the caller's sums of gradients."""
        for key in self.sources:
            gradient = self.gradients.get(key)
            if gradient is not None:
                add_to(self.sums, key, gradient)
