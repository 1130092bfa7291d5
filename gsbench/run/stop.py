"""Stop a run after the current step when the process gets a signal: SIGINT, SIGTERM or Slurm's SIGUSR2."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR2)


class Stopped(BaseException):  # like KeyboardInterrupt, so that `except Exception` does not catch it
    """A signal asked the process to end, and the run has saved its state."""

    def __init__(self, number: int, message: str) -> None:
        super().__init__(message)
        self.code = 128 + number  # the exit status of a process that a signal ended


def stop_at_once(number: int, _: FrameType | None) -> None:
    """Handle a signal outside of training, when nothing has to be saved, by raising Stopped."""
    raise Stopped(number, f"stopped by {signal.Signals(number).name}")


class Request:
    """The signal, if any, that asks the run to end."""

    def __init__(self) -> None:
        self.signal: int | None = None
        self._before: dict[int, Any] = {}

    def _ask(self, number: int, frame: FrameType | None) -> None:
        if self.signal is not None:  # a second signal goes to the earlier handler, which usually ends the process
            self.hand_on(number, frame)
        self.signal = number

    def hand_on(self, number: int, frame: FrameType | None = None) -> None:
        """Call the signal handler that was installed before; submitit's handler requeues a Slurm job at SIGUSR2."""
        before = self._before.get(number)
        if callable(before):
            before(number, frame)
        elif before == signal.SIG_DFL:
            signal.signal(number, signal.SIG_DFL)
            signal.raise_signal(number)


@contextmanager
def requested() -> Iterator[Request]:
    """Record signals while the block runs, and restore the earlier handlers afterwards.

    The training reads the recorded signal between two steps. Only the main thread may set handlers; in other threads no
    signal is recorded.
    """
    request = Request()
    if threading.current_thread() is not threading.main_thread():
        yield request
        return
    for number in SIGNALS:
        before = signal.getsignal(number)
        if before == signal.SIG_IGN or (number == signal.SIGUSR2 and before == signal.SIG_DFL):
            continue  # background processes ignore SIGINT; SIGUSR2 matters only if submitit has a handler
        request._before[number] = signal.signal(number, request._ask)
    try:
        yield request
    finally:
        for noted, before in request._before.items():
            signal.signal(noted, before)
