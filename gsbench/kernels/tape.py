"""Differentiate the operations of a rendered view without autograd: record them, then run them backwards.

A training step is a few dozen kernel calls on small tensors, for which autograd's overhead would exceed the time of the
kernels. Autograd still differentiates other code: if a tensor with a `grad_fn` enters an operation, the tape passes the
gradient on to autograd. So models written in torch also train.
"""

from collections import Counter
from collections.abc import Sequence
from types import TracebackType
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor

from gsbench.kernels.library import Slots
from gsbench.kernels.operation import Operation, Results, active


def add_to(sums: dict[int, Tensor], gradients: dict[int, Tensor]) -> None:
    """Add gradients in place to the entries of `sums` with their keys, or make them these entries."""
    both = [key for key in gradients if key in sums]
    if both:
        torch._foreach_add_([sums[key] for key in both], [gradients[key] for key in both])  # on a GPU in one launch
    sums.update({key: gradient for key, gradient in gradients.items() if key not in sums})


def collect_gradients(*tensors: Tensor) -> tuple[Tensor, ...]:
    """Return tensors, such as outputs of networks, of which a tape adds up all gradients before autograd runs once.

    Without this, autograd runs through the network once for each input of a kernel that is computed from them.
    """
    tape: Tape | None = getattr(active, "tape", None)
    return tensors if tape is None else tape.collect(tensors)


def stack(parts: Sequence[Sequence[Tensor]]) -> list[Tensor]:
    """Stack tensors: return one of shape [V, ...] for each of several lists of V tensors."""
    tape: Tape | None = getattr(active, "tape", None)
    return [torch.stack(list(x)) for x in parts] if tape is None else tape.stack(parts)


class _Call(NamedTuple):
    """A recorded call of an operation."""

    # None: `collect`, whose outputs are its inputs, or `stack`, whose outputs are as many inputs each, in order
    operation: Operation | None
    tensors: list[Tensor]
    wanted: list[bool]
    slots: Slots
    outputs: list[Tensor]


class Tape:
    """Records the kernels called inside `with Tape() as tape: ...`; `tape.backward` computes their gradients."""

    def __init__(self) -> None:
        """Create a tape without operations."""
        self._calls: list[_Call] = []

    def __enter__(self) -> Self:
        self._outer = getattr(active, "tape", None)
        active.tape = self
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        active.tape = self._outer

    def record(
        self, operation: Operation, tensors: list[Tensor], numbers: Sequence[Any], results: Results | None
    ) -> list[Tensor]:
        """Run a kernel if there are no `results` yet; record the call if it has a gradient that an input requires."""
        outputs, slots = results or operation.run(tensors, numbers)
        if not torch.is_grad_enabled():
            return outputs
        has_gradient = operation.differentiable(tensors)
        wanted = [has and x.requires_grad for x, has in zip(tensors, has_gradient, strict=True)]
        if any(wanted):
            for x, has in zip(outputs, operation.carries_gradient(outputs), strict=True):
                if has:
                    x.requires_grad_()  # so that autograd records what torch computes from this output
            self._calls.append(_Call(operation, tensors, wanted, slots, outputs))
        return outputs

    def collect(self, tensors: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """Return tensors that share the memory of `tensors` but have no `grad_fn`, see `collect_gradients`."""
        computed = [x for x in tensors if x.grad_fn is not None]
        leaves = [x.detach().requires_grad_() for x in computed]
        self._calls.append(_Call(None, computed, [True] * len(leaves), {}, leaves))
        rest = iter(leaves)
        return tuple([x if x.grad_fn is None else next(rest) for x in tensors])

    def stack(self, parts: Sequence[Sequence[Tensor]]) -> list[Tensor]:
        """Return each list of tensors as one; the parts of its gradient are those of the tensors, without a copy."""
        tensors = [x for part in parts for x in part]
        with torch.no_grad():
            stacked = [torch.stack(list(part)) for part in parts]
        wanted = [x.requires_grad for x in tensors]
        if torch.is_grad_enabled() and any(wanted):
            for x, part in zip(stacked, parts, strict=True):
                x.requires_grad_(any(y.requires_grad for y in part))
            self._calls.append(_Call(None, tensors, wanted, {}, stacked))
        return stacked

    def backward(self, loss: Tensor, seed: Tensor, sources: Sequence[Tensor], sums: dict[int, Tensor]) -> None:
        """Compute the gradients of `loss` with respect to the tensors `sources`, and add them to `sums`.

        The keys of `sums` are the ids of the tensors in `sources`.

        `seed` is the gradient of the loss itself, by which all gradients are multiplied. The added gradients are
        bitwise the same whether `sums` is empty or not. A tape may run backwards several times, with different seeds.
        """
        gradients = _Gradients(self._calls, sources, sums)
        gradients.propagate([loss], [seed])
        for call in reversed(self._calls):
            gradients.run_backward(call)
        add_to(sums, {key: gradients.by_id[key] for key in gradients.sources if key in gradients.by_id})


class _Gradients:
    """The gradients of tensors that one backward pass of a tape has computed so far."""

    def __init__(self, calls: list[_Call], sources: Sequence[Tensor], sums: dict[int, Tensor]) -> None:
        self.calls = calls
        self.sources = {id(x): x for x in sources}
        self.sums = sums
        self.by_id: dict[int, Tensor] = {}  # the gradient of each tensor
        self.uses = Counter([id(x) for call in calls for x in call.tensors])  # how often calls read each tensor

    def propagate(self, tensors: Sequence[Tensor], gradients: Sequence[Tensor]) -> None:
        """Add gradients to those of tensors; if these have a `grad_fn`, backpropagate them through autograd."""
        self._add(list(zip(tensors, gradients, strict=True)))
        if all(x.grad_fn is None for x in tensors):
            return
        outputs = [y for call in self.calls for y in call.outputs]
        starts = {id(x) for x in tensors}
        # Autograd stops at the sources and at outputs of recorded calls; a tape may run backwards again (retain_graph).
        ends = [y for y in (*self.sources.values(), *outputs) if y.requires_grad and id(y) not in starts]
        by_ends = torch.autograd.grad(tensors, ends, gradients, allow_unused=True, retain_graph=True)
        # torch may return two gradients that share memory, or one of a transposed layout.
        reached = [(x, g) for x, g in zip(ends, by_ends, strict=True) if g is not None]
        self._add([(x, g.clone(memory_format=torch.contiguous_format)) for x, g in reached])

    def _add(self, gradients: Sequence[tuple[Tensor, Tensor]]) -> None:
        """Add gradients to those of their tensors, in order; to those of different tensors together."""
        added: dict[int, Tensor] = {}
        for x, gradient in gradients:
            if id(x) in added:
                add_to(self.by_id, added)
                added = {}
            added[id(x)] = gradient
        add_to(self.by_id, added)

    def run_backward(self, call: _Call) -> None:
        """Run the backward kernel of one recorded call, if one of its outputs has a gradient."""
        upstream = [self.by_id.get(id(x)) for x in call.outputs]
        if all(g is None for g in upstream):
            return
        if call.operation is None:  # `collect` or `stack`
            size = len(call.tensors) // len(call.outputs)  # inputs of an output
            by_inputs: list[Tensor | None] = []
            for g in upstream:
                by_inputs += [g] if size == 1 else [None] * size if g is None else g.unbind()
            each = zip(call.tensors, by_inputs, call.wanted, strict=True)
            there = [(x, g) for x, g, wanted in each if g is not None and wanted]
            self.propagate(*zip(*there, strict=True))
            return
        # A gradient that is declared ADDED goes to memory that may have others. If later calls have read the input too,
        # these are theirs. If no other call reads it, it is the whole gradient of this tape, and is added at once to
        # `self.sums`, where those of other views are.
        whole, sums = {}, {}
        for i in call.operation.adds:
            key = id(call.tensors[i])
            if key in self.sources and key in self.by_id:
                sums[i] = self.by_id[key]
            elif key in self.sources and self.uses[key] == 1:
                whole[i] = key
                if key in self.sums:
                    sums[i] = self.sums[key]
        gradients = call.operation.backward(call.tensors, call.slots, call.outputs, upstream, call.wanted, sums)
        waiting: list[tuple[Tensor, Tensor]] = []  # what torch need not differentiate is added up together
        for i, (x, gradient, wanted) in enumerate(zip(call.tensors, gradients, call.wanted, strict=True)):
            if gradient is None or not wanted:
                continue
            if i in whole:
                self.sums[whole[i]] = gradient
            elif i not in sums:
                if x.grad_fn is not None:
                    self._add(waiting)
                    waiting = []
                    self.propagate([x], [gradient])
                else:
                    waiting.append((x, gradient))
        self._add(waiting)
