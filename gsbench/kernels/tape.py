"""Differentiate a chain of operations without autograd: they are noted as they run, and run backwards in turn.

A training step is a few dozen calls of kernels on small tensors; autograd's graph and torch's dispatch cost more than
they do. What is no operation of the kernels stays autograd's: where a tensor of its graph enters an operation, the tape
hands the gradient over. So a model written in torch is trained by the same code.
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
    """Return the tape in charge of this thread."""
    return getattr(_in_charge, "tape", None)


def add_to(sums: dict[int, Tensor], key: int, gradient: Tensor) -> None:
    """Add a gradient to the sum of a key, in place; the first one becomes the sum."""
    if key in sums:
        sums[key] += gradient
    else:
        sums[key] = gradient


class Differentiable(Protocol):
    """What a tape asks of an operation: to run, and to run backwards; `gsbench.kernels.operation.Operation` does."""

    name: str
    adds: set[int]  # inputs to whose gradient the backward kernel adds

    def run(self, tensors: list[Tensor], numbers: Sequence[Any]) -> tuple[list[Tensor], dict[str, Any]]:
        """Return the outputs, and what backward can use again."""

    def differentiable(self, tensors: list[Tensor]) -> list[bool]:
        """Tell by which inputs there is a gradient."""

    def carries_gradient(self, outputs: list[Tensor]) -> list[bool]:
        """Tell through which outputs there is one."""

    def backward(
        self,
        tensors: list[Tensor],
        slots: dict[str, Any],
        outputs: list[Tensor],
        given: Sequence[Tensor | None],
        wanted: Sequence[bool],
        sums: dict[int, Tensor] | None = None,
    ) -> list[Tensor | None]:
        """Return the gradients by the inputs, of those by the outputs."""


class _Note(NamedTuple):
    operation: Differentiable
    tensors: list[Tensor]
    wanted: list[bool]
    slots: dict[str, Any]
    outputs: list[Tensor]


class Tape:
    """Notes the operations that run in ``with Tape() as tape: ...``, for ``tape.backward(loss, ...)``."""

    def __init__(self) -> None:
        """An empty one."""
        self._notes: list[_Note] = []

    def __enter__(self) -> Self:
        self._outer = current()
        _in_charge.tape = self
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        _in_charge.tape = self._outer

    def record(self, operation: Differentiable, tensors: list[Tensor], numbers: Sequence[Any]) -> list[Tensor]:
        """Run an operation, and note it where a gradient goes through it."""
        outputs, slots = operation.run(tensors, numbers)
        if not torch.is_grad_enabled():
            return outputs
        own = operation.differentiable(tensors)
        wanted = [through and x.requires_grad for x, through in zip(tensors, own, strict=True)]
        if any(wanted):
            for x, through in zip(outputs, operation.carries_gradient(outputs), strict=True):
                if through:
                    x.requires_grad_()  # so that what torch makes of it has a graph that begins here
            self._notes.append(_Note(operation, tensors, wanted, slots, outputs))
        return outputs

    def backward(self, loss: Tensor, seed: Tensor, sources: Sequence[Tensor], sums: dict[int, Tensor]) -> None:
        """Add the gradients of `loss` times `seed` by `sources` to `sums`, which holds them by the tensors' id.

        What is added is the same to the last bit whether `sums` holds other views' already or not. The tape may run
        backwards again, for another seed.
        """
        at = _Gradients(self._notes, sources, sums)
        at.give(loss, seed)
        for note in reversed(self._notes):
            at.through(note)
        at.finish()


class _Gradients:
    """The gradients of one pass backwards."""

    def __init__(self, notes: list[_Note], sources: Sequence[Tensor], sums: dict[int, Tensor]) -> None:
        self.notes = notes
        self.sources = {id(x): x for x in sources}
        self.sums = sums
        self.found: dict[int, Tensor] = {}
        self.uses = Counter([id(x) for note in notes for x in note.tensors])

    def give(self, x: Tensor, gradient: Tensor) -> None:
        """Accumulate dL/dx; if x has a `grad_fn`, backpropagate through autograd."""
        self._add(x, gradient)
        if x.grad_fn is None:
            return
        own = [y for note in self.notes for y in note.outputs if y.requires_grad]
        ends = [y for y in (*self.sources.values(), *own) if y.requires_grad and y is not x]
        gradients = torch.autograd.grad(x, ends, gradient, allow_unused=True, retain_graph=True)
        for end, found in zip(ends, gradients, strict=True):
            if found is not None:
                self._add(end, found.clone())  # torch may give two tensors one memory

    def _add(self, x: Tensor, gradient: Tensor) -> None:
        before = self.found.get(id(x))
        self.found[id(x)] = gradient if before is None else before + gradient

    def through(self, note: _Note) -> None:
        """Run one operation backwards, if its outputs have a gradient."""
        given = [self.found.get(id(x)) for x in note.outputs]
        if all(g is None for g in given):
            return
        # An input that only this operation reads has its whole gradient here: it may be added to that of other views.
        whole, there = {}, {}
        for i in note.operation.adds:
            key = id(note.tensors[i])
            if key in self.sources and self.uses[key] == 1 and key not in self.found:
                whole[i] = key
                if key in self.sums:
                    there[i] = self.sums[key]
        gradients = note.operation.backward(note.tensors, note.slots, note.outputs, given, note.wanted, there)
        for i, (x, gradient, wanted) in enumerate(zip(note.tensors, gradients, note.wanted, strict=True)):
            if gradient is None or not wanted:
                continue
            if i in whole:
                self.sums[whole[i]] = gradient
            else:
                self.give(x, gradient)

    def finish(self) -> None:
        """Add what was found by each source."""
        for key in self.sources:
            gradient = self.found.get(key)
            if gradient is not None:
                add_to(self.sums, key, gradient)
