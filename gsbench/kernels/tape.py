"""Differentiate a chain of operations without autograd: record operations as they run, then run them backwards.

A training step is a few dozen calls of kernels on small tensors. Autograd's graph and torch's dispatch would cost more
than the kernels. Autograd differentiates everything else: if a tensor of its graph enters an operation, the tape gives
it the gradient. So the same code trains a model that is written in torch.
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
    """Return the tape that records in this thread, if there is one."""
    return getattr(_in_charge, "tape", None)


def add_to(sums: dict[int, Tensor], key: int, gradient: Tensor) -> None:
    """Add a gradient to the sum of a key, in place; the first one becomes the sum."""
    if key in sums:
        sums[key] += gradient
    else:
        sums[key] = gradient


class Differentiable(Protocol):
    """What a tape needs of an operation: to run it forward and backward (`gsbench.kernels.operation.Operation`)."""

    name: str
    adds: set[int]  # inputs to whose gradient the backward kernel adds

    def run(self, tensors: list[Tensor], numbers: Sequence[Any]) -> tuple[list[Tensor], dict[str, Any]]:
        """Return the outputs, and the slots that backward needs."""

    def differentiable(self, tensors: list[Tensor]) -> list[bool]:
        """Tell for each input whether it has a gradient."""

    def carries_gradient(self, outputs: list[Tensor]) -> list[bool]:
        """Tell for each output whether a gradient goes through it."""

    def backward(
        self,
        tensors: list[Tensor],
        slots: dict[str, Any],
        outputs: list[Tensor],
        given: Sequence[Tensor | None],
        wanted: Sequence[bool],
        sums: dict[int, Tensor] | None = None,
    ) -> list[Tensor | None]:
        """Return the gradients of the inputs, given those of the outputs."""


class _Note(NamedTuple):
    operation: Differentiable
    tensors: list[Tensor]
    wanted: list[bool]
    slots: dict[str, Any]
    outputs: list[Tensor]


class Tape:
    """Records the operations that run in ``with Tape() as tape: ...``, for ``tape.backward(loss, ...)``."""

    def __init__(self) -> None:
        """Start without operations."""
        self._notes: list[_Note] = []

    def __enter__(self) -> Self:
        self._outer = current()
        _in_charge.tape = self
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        _in_charge.tape = self._outer

    def record(self, operation: Differentiable, tensors: list[Tensor], numbers: Sequence[Any]) -> list[Tensor]:
        """Run an operation, and record it if a gradient goes through it."""
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
        """Add the gradients of `seed` times `loss` by `sources` to `sums`, whose keys are the ids of the sources.

        What is added has the same bits whether `sums` already holds a gradient or not. The tape may run backwards
        again, for another seed.
        """
        at = _Gradients(self._notes, sources, sums)
        at.give(loss, seed)
        for note in reversed(self._notes):
            at.through(note)
        at.finish()


class _Gradients:
    """The gradients that one backward pass has computed so far, by tensor."""

    def __init__(self, notes: list[_Note], sources: Sequence[Tensor], sums: dict[int, Tensor]) -> None:
        self.notes = notes
        self.sources = {id(x): x for x in sources}
        self.sums = sums
        self.found: dict[int, Tensor] = {}
        self.uses = Counter([id(x) for note in notes for x in note.tensors])

    def give(self, x: Tensor, gradient: Tensor) -> None:
        """Accumulate the gradient dL/dx of a tensor x; if x has a `grad_fn`, backpropagate through autograd."""
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
        """Add the gradient of each source to the sums."""
        for key in self.sources:
            gradient = self.found.get(key)
            if gradient is not None:
                add_to(self.sums, key, gradient)
