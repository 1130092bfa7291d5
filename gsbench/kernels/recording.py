"""Record the kernel calls and torch operations of a function, and repeat them in the same memory.

A training step of a small model is a few dozen kernel calls, which take some microseconds each. The Python code around
them, which checks, allocates and differentiates, takes longer, and does the same for every view. A repetition runs only
the recorded calls, with the present values of their tensors. On a GPU, CUDA graphs make the calls.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from types import TracebackType
from typing import Any, Self

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes

# A recording that would keep more memory is given up, because Python code is then a small share of the work. A network
# of eight layers of 256 units needs 0.1 GB for 1,000 Gaussians.
MOST_BYTES = 1 << 28

_in_charge = threading.local()  # each thread has its own
_ONE_AT_A_TIME = threading.RLock()  # torch has global variables that say whether a thread records

_VARYING = {torch.Tag.data_dependent_output, torch.Tag.dynamic_output_shape, torch.Tag.nondeterministic_seeded}
_aten = torch.ops.aten
_ALLOCATE = {_aten.empty.memory_format, _aten.empty_strided.default, _aten.empty_like.default, _aten.new_empty.default}
_ALLOCATE_ZEROS = {_aten.zeros.default, _aten.zeros_like.default, _aten.new_zeros.default}
_COPY = {_aten.clone.default, _aten._to_copy.default}


class OutdatedError(Exception):
    """A recording cannot be repeated for the present values of its tensors."""


def current() -> Recording | None:
    """Return the recording that is active in this thread, or None."""
    return getattr(_in_charge, "recording", None)


@contextmanager
def paused() -> Iterator[None]:
    """In a `with` block, record nothing; what the block calls is not repeated."""
    recording, _in_charge.recording = current(), None
    try:
        with _disable_current_modes():
            yield
    finally:
        _in_charge.recording = recording


def read(numbers: Tensor, holds: Callable[[list[int]], bool]) -> list[int]:
    """Return the values of an integer tensor [n].

    An active recording reads the tensor again in every repetition, and raises OutdatedError unless `holds(values)` is
    true.
    """
    if (recording := current()) is None:
        values: list[int] = numbers.tolist()
        return values
    recording.add(partial(_check, numbers, holds))
    with _disable_current_modes():  # a repetition need not copy what it reads from a GPU twice
        values = numbers.tolist()
    return values


class Recording(TorchDispatchMode):
    """Records what is called in `with Recording() as recording: ...`; `recording.repeat()` calls it again.

    All tensors that are made in the block stay in memory. A repetition writes new values to them.
    """

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        """Return False: nothing here is compiled, and torch would import its compiler, which takes a second."""
        return False

    def __init__(self) -> None:
        """Create a recording without calls."""
        super().__init__()
        self._calls: list[Callable[[], Any]] = []
        self._kept: list[Any] = []  # so that no two results of the block share memory by chance
        self._bytes = 0  # of the results
        # False if an operation of the block gives other results each time, or if the results are too large.
        self.is_repeatable = True

    def __enter__(self) -> Self:
        _ONE_AT_A_TIME.acquire()
        self._outer = current()
        _in_charge.recording = self
        super().__enter__()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        super().__exit__(kind, error, at)
        _in_charge.recording = self._outer
        _ONE_AT_A_TIME.release()

    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Run a torch operation and record it."""
        kwargs = kwargs or {}
        result = operation(*args, **kwargs)
        if isinstance(result, Tensor) and not (operation.is_view or operation._schema.is_mutable):  # in new memory
            self._bytes += result.nbytes
        if self._bytes > MOST_BYTES or _varies(operation, args):
            self.is_repeatable = False
        if not self.is_repeatable:
            self._calls.clear()
            self._kept.clear()
            return result
        self._kept.append(result)
        if operation._schema.is_mutable:
            self._calls.append(partial(operation, *args, **kwargs))
        elif operation in _ALLOCATE_ZEROS:
            self._calls.append(result.zero_)
        elif operation in _COPY:
            self._calls.append(partial(result.copy_, args[0]))
        elif not operation.is_view and operation not in _ALLOCATE:  # these two compute nothing
            self._calls.append(_over(result, operation, args, kwargs))
        return result

    def add(self, call: Callable[[], Any]) -> None:
        """Record a call, such as that of a kernel, that is no torch operation and writes to the same memory again."""
        self._calls.append(call)

    @torch.no_grad()
    def capture(self) -> None:
        """Make a CUDA graph of all calls, so that Python launches them as one.

        Raises:
            RuntimeError: CUDA cannot capture a call, such as a read or a copy from the CPU; `repeat` works as before.
        """
        self._calls = [graph_of(self._calls)]

    def repeat(self) -> None:
        """Call everything that was recorded again, in the same order; to be called without gradients.

        Raises:
            OutdatedError: a number that the block read has a value for which other calls are needed.
        """
        for call in self._calls:
            call()


def graph_of(calls: list[Callable[[], Any]]) -> Callable[[], None]:
    """Capture calls as a CUDA graph without running them, and return a function that replays it.

    The calls have run before, so that all modules are loaded. They leave no memory behind, so all graphs share a pool.
    The context manager `torch.cuda.graph` would also collect garbage, which takes longer than the capture.
    """
    graph = torch.cuda.CUDAGraph()
    torch.cuda.synchronize()
    with torch.cuda.stream(torch.cuda.Stream()):
        graph.capture_begin(pool=_pool_of_graphs())
        try:
            for call in calls:
                call()
        finally:
            graph.capture_end()
    return graph.replay


@functools.cache
def _pool_of_graphs() -> Any:
    return torch.cuda.graph_pool_handle()


def _varies(operation: Any, args: Any) -> bool:
    """Return whether an operation gives a number, a random result, or a result of another shape for other values."""
    if operation is _aten.index.Tensor:  # x[i] has a fixed shape, unless an index is a mask
        return any(index is not None and index.dtype in (torch.bool, torch.uint8) for index in args[1])
    return not _VARYING.isdisjoint(operation.tags)


def _over(result: Any, operation: Any, args: Any, kwargs: Any) -> Callable[[], Any]:
    """Return a call that writes the result of an operation over its earlier result, a tensor or several tensors."""
    if (variant := _variant_over(operation)) is None:
        return partial(_copy_over, result, partial(operation, *args, **kwargs))
    call, names = variant
    results = result if isinstance(result, tuple) else (result,)
    return partial(call, *args, **kwargs, **dict(zip(names, results, strict=True)))


@functools.cache
def _variant_over(operation: Any) -> tuple[Any, list[str]] | None:
    """Return torch's variant of an operation that writes over tensors, and the names of these; None: it has none.

    For add.Tensor this is add.out, with the name "out".
    """
    arguments = [(x.name, str(x.type)) for x in operation._schema.arguments]
    for name in operation.overloadpacket.overloads():
        variant = getattr(operation.overloadpacket, name)
        listed = variant._schema.arguments
        if [(x.name, str(x.type)) for x in listed if not x.is_out] == arguments and any(x.is_out for x in listed):
            return variant, [x.name for x in listed if x.is_out]
    return None


def _copy_over(result: Any, operation: Callable[[], Any]) -> None:
    """Call an operation, and copy its result over an earlier one, a tensor or several tensors."""
    new = operation()
    if isinstance(result, Tensor):
        result.copy_(new)
        return
    for x, y in zip(result, new, strict=True):
        x.copy_(y)


def _check(numbers: Tensor, holds: Callable[[list[int]], bool]) -> None:
    if not holds(numbers.tolist()):
        raise OutdatedError
